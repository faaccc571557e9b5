"""Singular values and improvement potential with closed-form gradients in the centers; blocks are recomputed.

With Phi = Q T^T, y = Q^T g and U^T U = V diag(sigma^2) V^T, everything but two passes over the vertices is m x m:
d log sigma_i = (Phi z_i)^T dPhi z_i / sigma_i^2 - v_i^T dPsi z_i with z_i = v_i (indirect) or Psi^-1 v_i (direct), and
dP = 2 <(g - Phi w) w^T, dPhi> with w = T^-T y. Ill-conditioned setups use the factor of their further passes, so that
gradients stay as accurate as the scores.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.scoring.matrices import all_finite, gram, left_spectrum, product, solve_lower
from rbfevo.scoring.representations import Pull
from rbfevo.scoring.threads import coarse

if TYPE_CHECKING:
    from rbfevo.scoring.evaluator import Evaluator  # which makes these spectra


class Spectrum:
    """Singular values of U and improvement potential of setups, ready for gradients.

    Attributes:
        sigma: [p, m], falling; ones where a setup has no regularity (rank below m, singular Psi, not finite).
        regular: [p] whether it has one; potential: [p] P, maximized, 0 where a setup is not finite.
        potentials: [p, J] P of each objective, of which `potential` is the mean or the least; the same of one.
        improvable: [p] whether P has a gradient (the setup is finite and not numerically rank-deficient).
        near: what a spectrum of similar setups can start from, or None.
    """

    near: Tensor | None = None

    @torch.no_grad()
    @coarse()
    def __init__(self, evaluator: Evaluator, centers: Tensor) -> None:
        """Take centers [p, m, d]; any values."""
        finite = all_finite(centers)
        self.evaluator = evaluator
        self.centers = torch.where(finite.view(-1, *(1,) * (centers.ndim - 1)), centers.detach(), 0.0)
        T, y, potentials, rank, usable, deficient = evaluator.factors(self.centers, finite)
        self._y = torch.where(deficient[:, None, None], 0.0, y)
        m = T.shape[1]
        evaluator.count(evaluations=len(centers), failed_evaluations=int((~usable).sum()))
        self._T, self._inverse = T, None
        self.improvable = usable & ~deficient
        self.potentials = torch.where(usable[:, None], potentials.clamp(0.0, 1.0), 0.0)
        self.potential = evaluator.combination(self.potentials)
        self.regular = self.improvable & (rank == m)
        self._phi: tuple[Tensor, Tensor, Tensor] | None = None
        if evaluator.deformation.manipulation != "indirect":
            reduced = evaluator.representation.reduce(self.centers, T, evaluator.deformation.manipulation)
            if reduced.weights is not None and evaluator.representation.narrows:
                sound = usable & (deficient | (rank == m)) & ~reduced.singular
                T = self._narrowed((T, y, reduced.weights), reduced.factor, sound)
                m = T.shape[1]
            else:
                T, self._inverse, lost = reduced
                self.regular &= ~lost
                if T.shape[1] != T.shape[2]:
                    raise UserError(
                        f"representation={evaluator.representation.name} has no gradients under direct manipulation"
                    )
        identity = torch.eye(m, dtype=T.dtype, device=T.device)
        self._V, self.sigma = left_spectrum(torch.where(self.regular[:, None, None], T, identity))

    def _narrowed(self, phi: tuple[Tensor, Tensor, Tensor], factor: Tensor, sound: Tensor) -> Tensor:
        """The triangular factor T' [p, m, m] of U = Q T^T W, whose columns reach less than those of Phi.

        With T^T W = Q' T'^T it takes the place of T, and Q'^T y that of y. `phi` is T, y and W, factor W^T T.
        """
        evaluator = self.evaluator
        found = evaluator.narrow(factor, phi[1], ~sound, sound)
        self.potentials = torch.where(sound[:, None], found.potentials.clamp(0.0, 1.0), 0.0)
        self.potential = evaluator.combination(self.potentials)
        self.regular = self.improvable = sound & ~found.lost
        self._phi = phi
        parts = [torch.linalg.qr(one.mT) for one in factor]  # one at a time: in a batch LAPACK may round otherwise
        Q, R = (torch.stack(part) for part in zip(*parts, strict=True))
        self._y = product(Q.mT, phi[1])
        self._T = torch.where(self.regular[:, None, None], R.mT, torch.eye(R.shape[-1], dtype=R.dtype, device=R.device))
        return self._T

    @property
    def regularity(self) -> Tensor:
        """R [p], maximized; 0 where there is none."""
        return torch.where(self.regular, self.sigma[:, -1] / self.sigma[:, 0], 0.0)

    @torch.no_grad()
    @coarse()
    def backward(self, dlog_sigma: Tensor, dpotential: Tensor) -> Tensor:
        """Gradient [p, m, d] in the centers of a function with gradients [p, m] in log sigma and [p] in P.

        Of several objectives the latter may be those [p, J] in P of each. Finite for every setup; 0 where the setup has
        no regularity or is not improvable.
        """
        m, k = self._y.shape[1:]
        self.evaluator.count(gradients=len(self.centers))
        dlog_sigma = torch.where(self.regular[:, None], dlog_sigma, 0.0)
        w = solve_lower(self._T, self._y, transposed=True)
        Z = self._V if self._inverse is None else product(self._inverse, self._V)
        dM = torch.zeros(len(Z), m + k, m + k, dtype=Z.dtype, device=Z.device)
        scaled = 0.5 * Z * (dlog_sigma / self.sigma.square())[:, None, :]
        squares, moments = self._through_potentials(dpotential, w)
        dM[:, :m, :m] = product(scaled, Z.mT) - squares
        dM[:, :m, m:] = moments
        through = None
        if self._phi is not None:
            dM, through = self._of_columns(dM)
        gradient = self.evaluator.gram.backward(self.centers, dM)
        if self._inverse is not None:
            representation = self.evaluator.representation
            found = representation.pull_reduction(self.centers, Pull(self._V * dlog_sigma[:, None, :], Z))
            if found is None:
                raise UserError(f"representation={representation.name} has no gradients under direct manipulation")
            gradient += found
        if through is not None:
            found = self.evaluator.representation.pull_weights(self.centers, through)
            if found is None:
                name = self.evaluator.representation.name
                raise UserError(f"representation={name} has no gradients under direct manipulation")
            gradient += found
        sound = all_finite(gradient)
        return torch.where(sound.view(-1, *(1,) * (gradient.ndim - 1)), gradient, 0.0)

    def _of_columns(self, dM: Tensor) -> tuple[Tensor, Tensor]:
        """Of a gradient in W^T G W and W^T b of U: that in G and b of Phi, and that in W [p, r, m]."""
        if self._phi is None:
            raise UserError("the columns of U are those of Phi")
        T, y, W = self._phi
        m, k = W.shape[2], y.shape[2]
        dG, db = dM[:, :m, :m], dM[:, :m, m:]
        r = W.shape[1]
        whole = torch.zeros(len(W), r + k, r + k, dtype=W.dtype, device=W.device)
        whole[:, :r, :r] = product(product(W, dG), W.mT.contiguous())
        whole[:, :r, r:] = product(W, db)
        b = product(T, y)
        dW = product(T, product(T.mT, product(W, dG + dG.mT))) + product(b, db.mT)
        dW = torch.where(self.improvable[:, None, None], dW, 0.0)
        return whole, dW

    def _through_potentials(self, dpotential: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """What gradients [p] in P, or [p, J] in P of each objective, add to those in G (taken off there) and in b."""
        combination = self.evaluator.combination
        if combination.count == 1:
            share = torch.where(self.improvable, dpotential.reshape(-1), 0.0)[:, None, None]
            return share * gram(w), 2.0 * share * w
        if dpotential.ndim == 1:
            dpotential = dpotential[:, None] * combination.slopes(self.potentials)
        slopes = torch.where(self.improvable[:, None], dpotential, 0.0)
        weighted = combination.spread(slopes, w.shape[2])[:, None, :] * w
        return product(weighted, w.mT), 2.0 * weighted


class _Scores(torch.autograd.Function):
    """R and P [p] of centers [p, m, d]."""

    @staticmethod
    def forward(ctx: Any, centers: Tensor, evaluator: Evaluator) -> tuple[Tensor, Tensor]:
        """R and P [p] of centers [p, m, d]."""
        ctx.spectrum = evaluator.spectrum(centers)
        return ctx.spectrum.regularity, ctx.spectrum.potential

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        """The gradient [p, m, d] in the centers, from those [p] in R and in P."""
        spectrum: Spectrum = ctx.spectrum
        sigma, slope = spectrum.sigma, (grads[0] * spectrum.regularity)[:, None]
        dlog_sigma = torch.zeros_like(sigma)
        dlog_sigma.scatter_add_(1, sigma.argmin(1, keepdim=True), slope)  # sigma may come in no order
        dlog_sigma.scatter_add_(1, sigma.argmax(1, keepdim=True), -slope)
        return spectrum.backward(dlog_sigma, grads[1]), None


def differentiable_scores(evaluator: Evaluator, centers: Tensor) -> tuple[Tensor, Tensor]:
    """Regularity and improvement potential [*pop] of centers [*pop, m, d], both maximized and differentiable in them.

    The values are the evaluator's. A setup has value 0 and gradient 0 where a score does not exist (not finite, no
    regularity), and no gradient of P where it is numerically rank-deficient. Where sigma_min or sigma_max is multiple,
    R has no gradient; one of its generalized gradients is returned (`Spectrum` allows smooth functions of all sigma).
    """
    dims = evaluator.representation.dims
    regularity, potential = _Scores.apply(centers.reshape(-1, *centers.shape[-dims:]), evaluator)
    return regularity.reshape(centers.shape[:-dims]), potential.reshape(centers.shape[:-dims])
