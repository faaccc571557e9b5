"""Gradients in the centers: custom backward passes that recompute the blocks instead of storing them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rbfevo.evaluator import Evaluator, cholesky, decoupled
from rbfevo.evolvability import singular
from rbfevo.gram import GramAccumulator
from rbfevo.kernels import Kernel, distances


class _Gram(torch.autograd.Function):
    """M [p, m+k, m+k] of `GramAccumulator`, differentiable in the centers at about three times the forward cost."""

    @staticmethod
    def forward(ctx: Any, centers: Tensor, gram: GramAccumulator) -> Tensor:
        ctx.save_for_backward(centers)
        ctx.gram = gram
        return gram(centers)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (centers,) = ctx.saved_tensors
        return ctx.gram.backward(centers, grads[0]), None


class _Psi(torch.autograd.Function):
    """Psi [p, m, m]; autograd through the square root of a zero distance would give NaN on the diagonal."""

    @staticmethod
    def forward(ctx: Any, centers: Tensor, kernel: Kernel) -> Tensor:
        ctx.save_for_backward(centers)
        ctx.kernel = kernel
        return kernel(distances(centers, centers))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (centers,) = ctx.saved_tensors
        H = (grads[0] + grads[0].mT) * ctx.kernel.slope(distances(centers, centers))
        return H.sum(2, keepdim=True) * centers - H @ centers, None


def differentiable_scores(evaluator: Evaluator, centers: Tensor) -> tuple[Tensor, Tensor]:
    """Regularity and improvement potential [*pop] of centers [*pop, m, d], both maximized and differentiable in them.

    One pass without refinement: where R(Phi) is below `rbfevo.evaluator.TRIGGER` the values carry an error of about
    eps / R(Phi)^2, so score what a search returns with the evaluator itself. Setups whose Gram matrix has no Cholesky
    factor, or whose Psi is singular, have value 0 and gradient 0 where the score does not exist.
    """
    flat = centers.reshape(-1, *centers.shape[-2:])
    m = flat.shape[1]
    fine = torch.isfinite(flat).flatten(1).all(1)
    flat = torch.where(fine[:, None, None], flat, 0.0)
    M = torch.where(fine[:, None, None], _Gram.apply(flat, evaluator.gram), 0.0)
    G, empty = decoupled(M[:, :m, :m])
    identity = torch.eye(m, dtype=G.dtype, device=G.device)
    with torch.no_grad():  # what has no factor must not even reach the factorization: its gradient would be NaN
        sound = cholesky(G)[1] & fine
    L = torch.linalg.cholesky(torch.where(sound[:, None, None], G, identity))
    potential = torch.linalg.solve_triangular(L, M[:, :m, m:], upper=False).square().sum((1, 2))
    factor, regular = L, sound & ~empty.any(1)
    if evaluator.deformation.manipulation == "direct":
        Psi = _Psi.apply(flat, evaluator.deformation.kernel)
        with torch.no_grad():
            lost = singular(Psi, torch.linalg.inv_ex(Psi)[0])
        factor = torch.linalg.solve(torch.where(lost[:, None, None], identity, Psi), L)
        regular = regular & ~lost
    sigma = torch.linalg.svdvals(torch.where(regular[:, None, None], factor, identity))
    regularity = torch.where(regular, sigma[:, -1] / sigma[:, 0], 0.0)
    potential = torch.where(sound, potential, 0.0)
    return regularity.reshape(centers.shape[:-2]), potential.reshape(centers.shape[:-2])
