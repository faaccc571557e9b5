"""Evolvability of a deformation: variability, regularity and improvement potential, by definition.

    @inproceedings{richter2017multi,
      author = {Richter, Andreas and Achenbach, Jascha and Menzel, Stefan and Botsch, Mario},
      title = {Multi-objective Representation Setups for Deformation-based Design Optimization},
      booktitle = {Evolutionary Multi-Criterion Optimization (EMO)}, year = {2017}}

This is the reference that the fast path (`rbfevo.scoring.evaluator`) is tested against, and what scores the rows of a
result.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.scoring.combination import ONE, Combination
from rbfevo.scoring.deformation import Deformation
from rbfevo.scoring.threads import coarse, run_in_slices

EPS = torch.finfo(torch.float64).eps


class Scores(NamedTuple):
    """Scores of setups; the first three are maximized, each [*pop] float64, and `failed` [*pop] is bool.

    A failed setup (non-finite centers or scores) has regularity, improvement potential and variability 0.
    """

    regularity: Tensor
    improvement_potential: Tensor
    variability: Tensor
    failed: Tensor

    @property
    def objectives(self) -> Tensor:
        """[*pop, 2]: (regularity, improvement potential), both maximized."""
        return torch.stack((self.regularity, self.improvement_potential), dim=-1)


def cutoff(n: int, m: int) -> float:
    """Singular values below this fraction of the largest count as zero, in V, P and R alike."""
    return max(n, m) * EPS


def evolvability(U: Tensor, gradient: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Regularity, improvement potential and variability of finite deformation matrices (paper, eqs. 6 to 8).

    Args:
        U: [*pop, n, m], finite.
        gradient: g [n, k], of unit (weighted) Frobenius norm.
        weights: [n] or None: rows of U and g count with sqrt(weights).

    Returns:
        R = sigma_min/sigma_max, 0 if the rank is below m; P = 1 - |(I - U U^+) g|_F^2; V = rank/n; each [*pop],
        maximized.
    """
    regularity, potentials, variability = _evolvability(U, gradient, weights, ONE)
    return regularity, potentials[..., 0], variability


def _evolvability(
    U: Tensor, gradient: Tensor, weights: Tensor | None, combination: Combination
) -> tuple[Tensor, Tensor, Tensor]:
    """R and V [*pop], and P [*pop, J] of each objective whose gradients are stacked."""
    n, m = U.shape[-2:]
    sigma, kept, residuals = projection(U, gradient, weights, combination)
    rank = kept.sum(-1)
    largest = sigma[..., 0]
    regularity = torch.where(
        (rank == m) & (largest > 0), sigma[..., -1] / largest.clamp(min=torch.finfo(U.dtype).tiny), 0.0
    )
    return regularity, (1.0 - residuals).clamp(0.0, 1.0), rank.to(U.dtype) / n


def projection(
    U: Tensor, gradient: Tensor, weights: Tensor | None = None, combination: Combination = ONE
) -> tuple[Tensor, Tensor, Tensor]:
    """Singular values [*pop, m] of U [*pop, n, m], which of them count, and |(I - U U^+) g_j|_F^2 [*pop, J]."""
    n, m = U.shape[-2:]
    if weights is not None:
        U, gradient = weights.sqrt()[:, None] * U, weights.sqrt()[:, None] * gradient
    if U.ndim > 2:  # one at a time: in a batch LAPACK may round by where a matrix lies
        found = [projection(one, gradient, None, combination) for one in U.reshape(-1, n, m)]
        sigma, kept, residuals = (torch.stack(part) for part in zip(*found, strict=True))
        each = U.shape[:-2]
        return sigma.reshape(*each, -1), kept.reshape(*each, -1), residuals.reshape(*each, -1)
    with coarse():
        left, sigma, _ = torch.linalg.svd(U, full_matrices=False)
        kept = sigma > cutoff(n, m) * sigma[:1]
        # U U^+ g = left left^T g over the singular values that count; the residual is formed before it is squared.
        coordinates = torch.where(kept[:, None], left.mT @ gradient, 0.0)
        return sigma, kept, combination.norms(gradient - left @ coordinates)


def singular(Psi: Tensor, inverse: Tensor) -> Tensor:
    """Whether Psi [*pop, m, m] is numerically singular: condition number (1-norm, by `inverse`) above 1/(m eps)."""
    norm = torch.linalg.matrix_norm
    condition = norm(Psi, 1) * norm(inverse, 1)
    return ~(condition < 1.0 / (Psi.shape[-1] * EPS))


def score(deformation: Deformation, centers: Tensor, gradient: Tensor, weights: Tensor | None = None) -> Scores:
    """Score setups by definition, one at a time so that no stored U is larger than n x m.

    Args:
        deformation: vertices, representation and manipulation.
        centers: setups [*pop, *setup], of RBFs [*pop, m, d]; any values, NaN and infinity too.
        gradient, weights: as for `evolvability`.

    Non-finite setups fail; a rank below m has R = 0; a direct setup with singular Psi has R = 0, and V and P of Phi.
    """
    return score_each(deformation, centers, gradient, weights, ONE)[0]


def score_each(
    deformation: Deformation, centers: Tensor, gradient: Tensor, weights: Tensor | None, combination: Combination
) -> tuple[Scores, Tensor]:
    """`score` of several objectives, whose gradients are stacked, and P [*pop, J] of each of them."""
    dims = deformation.representation.dims
    flat = centers.detach().reshape(-1, *centers.shape[-dims:])
    columns = torch.zeros(3 + combination.count, flat.shape[0], dtype=centers.dtype, device=centers.device)

    def work(begin: int, end: int) -> None:
        for i in range(begin, end):
            columns[:, i] = torch.stack(_score_one(deformation, flat[i], gradient, weights, combination))

    run_in_slices(work, len(flat))
    regularity, variability, failed, *each = columns.reshape(len(columns), *centers.shape[:-dims])
    potentials = torch.stack(each, dim=-1)
    return Scores(regularity, combination(potentials), variability, failed > 0), potentials


def _score_one(
    deformation: Deformation, setup: Tensor, gradient: Tensor, weights: Tensor | None, combination: Combination
) -> list[Tensor]:
    """R, V, whether the setup has failed, and P of each objective."""
    zero = torch.zeros((), dtype=setup.dtype, device=setup.device)
    failure = [zero, zero, zero + 1, *[zero] * combination.count]
    Phi = deformation.phi(setup)
    if not (torch.isfinite(setup).all() and torch.isfinite(Phi).all()):
        return failure
    regularity, potentials, variability = _evolvability(Phi, gradient, weights, combination)
    if deformation.manipulation != "indirect":
        U = deformation.representation.matrix(Phi, setup, deformation.manipulation)
        narrows = deformation.representation.narrows
        if U is not None and (narrows or U.shape != Phi.shape):  # they reach less than the columns of Phi
            regularity, potentials, variability = _evolvability(U, gradient, weights, combination)
        elif U is None:
            regularity = zero
        elif regularity > 0:
            U = U if weights is None else weights.sqrt()[:, None] * U
            sigma = torch.linalg.svdvals(U)
            regularity = sigma[-1] / sigma[0]
    scores = [regularity, variability, zero, *potentials]
    return scores if torch.isfinite(torch.stack(scores)).all() else failure
