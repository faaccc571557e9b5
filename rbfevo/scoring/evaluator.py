"""The evaluator that methods use: centers of a whole population in, scores out, blocked over the vertices.

One pass accumulates G = Phi^T Phi and b = Phi^T g. With G = L L^T, P = |L^-1 b|_F^2 (eq. 8), the singular values of Phi
are those of L^T, those of Phi Psi^-1 are those of L^T Psi^-1 (eqs. 4 and 7). Forming G squares the condition number,
so ill-conditioned setups get further passes (CholeskyQR2: Yamamoto et al. 2015; shifted where Cholesky fails: Fukaya et
al. 2020), and those that stay numerically rank-deficient a blocked Householder QR, which is as good as the definition.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.scoring.combination import ONE, Combination
from rbfevo.scoring.deformation import deformation_of
from rbfevo.scoring.evolvability import EPS, Scores, cutoff, score_each
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.gram import GramAccumulator
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.matrices import all_finite, cholesky, left_singular, product, singular_values, solve_lower
from rbfevo.scoring.representations import Representation
from rbfevo.scoring.sliced import SlicedSpectrum, in_slices
from rbfevo.scoring.threads import coarse

TRIGGER = 3e-5  # below this R(Phi), G has lost too many digits: eps / TRIGGER^2 is 2e-7
QR_ROWS = 4096
_COUNTING = threading.Lock()


class Factors(NamedTuple):
    """What one or more passes leave of setups [p, m, d]: with Phi = Q T^T, everything that scores are made of.

    Attributes:
        T: [p, m, m] lower triangular, T T^T = G; columns that no vertex feels have a diagonal of their own.
        y: [p, m, k] Q^T g, which is T^-1 b unless `deficient`.
        potentials: [p, J] P of each objective, maximized; rank: [p].
        usable: [p] finite setups with a finite G; deficient: [p] numerically rank-deficient ones.
    """

    T: Tensor
    y: Tensor
    potentials: Tensor
    rank: Tensor
    usable: Tensor
    deficient: Tensor


class Singular(NamedTuple):
    """What scores are made of: the extreme singular values of U and P, for setups [p]; means nothing if not `usable`.

    Attributes:
        largest, smallest: [p] singular values; lost: [p] where R is 0, since the rank is below m or Psi singular.
        potentials: [p, J] P of each objective, maximized; rank: [p]; usable: [p].
    """

    largest: Tensor
    smallest: Tensor
    lost: Tensor
    potentials: Tensor
    rank: Tensor
    usable: Tensor


class Evaluator:
    """Scores populations of setups of one design.

    The vertices may lie on a GPU and the centers on the host: the passes over the vertices then run on the GPU, all
    else on the host, which waits once a pass: the first, at most three more of ill-conditioned setups, and their QR.

    Args:
        vertices: [n, d] float64, model units.
        gradient: g [n, k], of unit (weighted) Frobenius norm.
        kernel: phi of the representation by RBFs, or any other representation.
        manipulation: `indirect` or `direct`.
        weights: [n] positive, or None for ones.
        backend: `auto`, `fused` or `eager`, see `GramAccumulator`.
        block: vertices a block, or None.
        blend: [n] what rows of U are multiplied by: 0 where a vertex is held; None for ones.
        combination: of several objectives, whose gradients `gradient` stacks.

    Attributes:
        evaluations: setups scored so far; failed_evaluations: those with non-finite centers or scores.
        gradients: setups scored with a gradient (`rbfevo.scoring.gradients`), among the evaluations.
        further_passes: setups that needed more than one pass; factorizations: those that needed QR.
    """

    def __init__(
        self,
        vertices: Tensor,
        gradient: Tensor,
        kernel: Kernel | Representation,
        manipulation: str = "indirect",
        weights: Tensor | None = None,
        backend: str = "auto",
        block: int | None = None,
        blend: Tensor | None = None,
        combination: Combination = ONE,
    ) -> None:
        self.combination = combination
        self.deformation = deformation_of(vertices, kernel, manipulation, blend)
        self.representation = self.deformation.representation
        self.gradient = gradient
        self.weights = torch.ones_like(vertices[:, 0]) if weights is None else weights
        self.gram = GramAccumulator(vertices, gradient, self.weights, self.representation, backend, block, blend)
        self.evaluations = self.failed_evaluations = self.gradients = self.further_passes = self.factorizations = 0

    @property
    def backend(self) -> str:
        """What runs: `fused` or `eager`."""
        return self.gram.backend

    def count(self, **more: int) -> None:
        """Add to the counters; threads may do so at once."""
        with _COUNTING:
            for counter, number in more.items():
                setattr(self, counter, getattr(self, counter) + number)

    def definition(self, centers: Tensor) -> Scores:
        """Scores [*pop] of centers [*pop, m, d] by the definition; the reference, slower by a factor of 50."""
        return self.definition_of_each(centers)[0]

    def definition_of_each(self, centers: Tensor) -> tuple[Scores, Tensor]:
        """`definition`, and P [*pop, J] of each objective."""
        device = self.deformation.vertices.device
        given = centers.to(device), self.gradient, self.weights, self.combination
        scores, potentials = score_each(self.deformation, *given)
        return Scores(*(column.to(centers.device) for column in scores)), potentials.to(centers.device)

    def __call__(self, centers: Tensor) -> Scores:
        """Scores [*pop] of centers [*pop, m, d]; regularity, improvement potential and variability are maximized.

        Never raises for what a setup's values are: non-finite ones fail and score 0, the others are untouched.

        Raises:
            UserError: if the shape does not fit the design.
        """
        return self.of_each(centers)[0]

    @torch.no_grad()
    @coarse()
    def of_each(self, centers: Tensor) -> tuple[Scores, Tensor]:
        """Scores [*pop] of centers [*pop, m, d], as a call returns them, and P [*pop, J] of each objective."""
        (n, d), dims = self.deformation.vertices.shape, self.representation.dims
        self.representation.refuse(centers, d)
        m = self.representation.columns(centers)
        if m > n:
            raise UserError(f"{m} centers are more than the design's {n} vertices; use fewer")
        setups = centers.reshape(-1, *centers.shape[-dims:]).to(self.deformation.vertices.dtype)
        finite = all_finite(setups)
        setups = zeroed(setups, finite)
        parts = in_slices(self, lambda rows: self._score(setups[rows], finite[rows]), setups)
        regularity, potentials, rank = (torch.cat(column) for column in zip(*parts, strict=True))
        failed = ~(finite & torch.isfinite(regularity) & torch.isfinite(potentials).all(1))
        zero = torch.zeros_like(regularity)
        self.count(evaluations=len(setups), failed_evaluations=int(failed.sum()))
        variability = rank.to(regularity.dtype) / n
        potentials = torch.where(failed[:, None], 0.0, potentials.clamp(0.0, 1.0))
        found = (torch.where(failed, zero, c) for c in (regularity, self.combination(potentials), variability))
        regularity, potential, variability = (c.reshape(centers.shape[:-dims]) for c in found)
        scores = Scores(regularity, potential, variability, failed.reshape(centers.shape[:-dims]))
        return scores, potentials.reshape(*centers.shape[:-dims], self.combination.count)

    def spectrum(self, centers: Tensor) -> Spectrum:
        """Singular values of U and P of centers [p, m, d], ready for gradients."""
        return SlicedSpectrum(self, centers)

    def factors(self, setups: Tensor, finite: Tensor) -> Factors:
        """Triangular factors of finite setups [p, m, d]; those that are not usable get an identity."""
        m = self.representation.columns(setups)
        M = self.gram(setups)
        usable = finite & all_finite(M)
        M = torch.where(usable[:, None, None], M, torch.eye(M.shape[-1], dtype=M.dtype, device=M.device))
        G, b = M[:, :m, :m], M[:, :m, m:]
        G, empty = decoupled(G)
        L, sound = cholesky(G)
        y = solve_lower(L, b)
        potentials = self.combination.norms(y)
        rank = m - empty.sum(1)
        deficient = torch.zeros_like(usable)
        index = torch.nonzero(usable & ~(sound & is_regular(L, TRIGGER))).flatten()
        if len(index):
            self.count(further_passes=len(index))
            L[index], y[index], potentials[index], rank[index], deficient[index] = self._refine(
                setups[index], G[index], L[index], sound[index], empty[index]
            )
        if self.representation.narrows:  # a diagonal of their own would show in the columns of U
            index = torch.nonzero(usable & ~deficient & (rank < m)).flatten()
            if len(index):
                deficient[index] = True
                L[index], y[index], potentials[index], rank[index] = self._factorized(setups[index])
        return Factors(L, y, potentials, rank, usable, deficient)

    def _score(self, setups: Tensor, finite: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """R [p], P [p, J] and rank [p] of setups [p, m, d]; NaN where a setup is not usable."""
        largest, smallest, lost, potentials, rank, usable = self.singular(setups, finite)
        regularity = torch.where(usable, torch.where(lost, 0.0, smallest / largest), torch.nan)
        potentials = torch.where(usable[:, None], potentials, torch.nan)
        index = torch.nonzero(finite & ~usable).flatten()
        if len(index):  # G can overflow where Phi does not
            exact, each = self.definition_of_each(setups[index])
            regularity[index] = torch.where(exact.failed, torch.nan, exact.regularity)
            potentials[index] = torch.where(exact.failed[:, None], torch.nan, each)
            rank[index] = (exact.variability * self.deformation.vertices.shape[0]).round().to(rank.dtype)
        return regularity, potentials, rank

    def singular(self, setups: Tensor, finite: Tensor) -> Singular:
        """Extreme singular values of U, P and rank of finite setups [p, m, d]."""
        L, y, potentials, rank, usable, deficient = self.factors(setups, finite)
        lost = rank < L.shape[1]
        if self.deformation.manipulation != "indirect":
            L, _, undetermined = self.representation.reduce(setups, L, self.deformation.manipulation)
            lost |= undetermined
            if L.shape[1] != L.shape[2] or self.representation.narrows:  # they reach less than the columns
                return self.narrow(L, y, undetermined, usable & (deficient | (rank == L.shape[2])))
        sigma = singular_values(L)
        return Singular(sigma[:, 0], sigma[:, -1], lost, potentials, rank, usable)

    def narrow(self, factor: Tensor, y: Tensor, lost: Tensor, usable: Tensor) -> Singular:
        """Singular values, P and rank of U = Q T^T W from `factor` [p, m, r] and y = Q^T g."""
        parts = []
        for one, coordinates in zip(factor, y, strict=True):  # one at a time: in a batch LAPACK may round otherwise
            left, sigma, _ = torch.linalg.svd(one.mT, full_matrices=False)
            kept = sigma > cutoff(len(self.deformation.vertices), len(one)) * sigma[:1]
            reached = self.combination.norms(torch.where(kept[:, None], left.mT @ coordinates, 0.0))
            parts.append((sigma[0], sigma[-1], ~kept.all(), reached, kept.sum()))
        if not parts:  # an empty population
            nothing, none = factor.new_zeros(0), lost.to(torch.int64)
            return Singular(nothing, nothing, lost, factor.new_zeros(0, self.combination.count), none, usable)
        largest, smallest, short, potentials, rank = (torch.stack(column) for column in zip(*parts, strict=True))
        return Singular(largest, smallest, lost | short, potentials, rank, usable)

    def _refine(
        self, setups: Tensor, G: Tensor, L: Tensor, sound: Tensor, empty: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Triangular factor T, T^-1 b, P, rank and deficiency of ill-conditioned setups by CholeskyQR2, else by QR."""
        (n, _), m = self.deformation.vertices.shape, G.shape[1]
        identity = torch.eye(m, dtype=G.dtype, device=G.device)
        shift = 11.0 * (m * n + m * (m + 1)) * EPS * G.diagonal(dim1=1, dim2=2).sum(1)
        shifted, _ = cholesky(G + shift[:, None, None] * identity)
        T = torch.where(sound[:, None, None], L, shifted)
        y = torch.zeros(len(T), m, self.gradient.shape[1], dtype=T.dtype, device=T.device)
        rank = m - empty.sum(1)
        pending = torch.arange(len(T), device=T.device)
        lost: list[Tensor] = []
        for _ in range(3):  # two suffice after an unshifted factor, three after a shifted one
            M = self.gram(setups[pending], T[pending])
            M = torch.where(all_finite(M)[:, None, None], M, 0.0)
            L2, sound = cholesky(M[:, :m, :m] + torch.diag_embed(empty[pending].to(M.dtype)))
            done = sound & is_regular(L2, TRIGGER)
            T[pending] = torch.where(sound[:, None, None], product(T[pending], L2), T[pending])
            y[pending] = solve_lower(L2, M[:, :m, m:])
            lost.append(pending[~sound])
            pending = pending[sound & ~done]
            if not len(pending):
                break
        potentials = self.combination.norms(y)
        deficient = ~is_regular(T, cutoff(n, m))
        deficient[torch.cat([*lost, pending])] = True
        index = torch.nonzero(deficient).flatten()
        if len(index):
            T[index], y[index], potentials[index], rank[index] = self._factorized(setups[index])
        return T, y, potentials, rank, deficient

    def triangle(self, setup: Tensor) -> Tensor:
        """R [m + k, m + k] of a blocked Householder QR of (Phi g) of one setup, rows times the roots of the weights."""
        n, m, k = len(self.deformation.vertices), self.representation.columns(setup[None]), self.gradient.shape[1]
        roots = self.weights.sqrt()[:, None]
        R = torch.zeros(m + k, m + k, dtype=setup.dtype, device=setup.device)
        for begin in range(0, n, QR_ROWS):
            rows = slice(begin, begin + QR_ROWS)
            Phi = self.deformation.phi(setup, rows)
            block = roots[rows] * torch.cat((Phi, self.gradient[rows]), dim=1)
            R = torch.linalg.qr(torch.cat((R, block)), mode="r")[1]
        return R

    def _factorized(self, setups: Tensor) -> tuple[Tensor, ...]:
        """Triangular factor, Q^T g, P and rank by blocked Householder QR of (Phi g), as good as an SVD of Phi."""
        self.count(factorizations=len(setups))
        found = self._factorize(setups.to(self.deformation.vertices.device))
        return tuple(part.to(setups.device) for part in found)

    def _factorize(self, setups: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        n, m = len(self.deformation.vertices), self.representation.columns(setups)
        R = torch.stack([self.triangle(setup) for setup in setups])  # a batch of QR runs no faster
        left, sigma = left_singular(R[:, :m, :m])
        kept = sigma > cutoff(n, m) * sigma[:, :1]
        potentials = self.combination.norms(torch.where(kept[:, :, None], product(left.mT, R[:, :m, m:]), 0.0))
        return R[:, :m, :m].mT, R[:, :m, m:], potentials, kept.sum(1)


def zeroed(setups: Tensor, kept: Tensor) -> Tensor:
    """Setups [p, *setup] with zeros in the place of those that are not `kept` [p]."""
    return torch.where(kept.view(-1, *(1,) * (setups.ndim - 1)), setups, 0.0)


def decoupled(G: Tensor) -> tuple[Tensor, Tensor]:
    """G [p, m, m] with the columns that no vertex feels [p, m] given a diagonal of their own, and which they are.

    Such a column takes nothing from P and the rank of the others.
    """
    diagonal = G.diagonal(dim1=1, dim2=2)
    largest = diagonal.amax(1, keepdim=True)
    empty = diagonal == 0
    return G + torch.diag_embed(torch.where(empty, largest.where(largest > 0, 1.0), 0.0)), empty


def is_regular(L: Tensor, least: float) -> Tensor:
    """Whether sigma_min > least sigma_max [p] of triangular L [p, m, m].

    Their ratio lies between `least_regularity` and m times that; only where this decides nothing they are computed.
    """
    m, bound = L.shape[-1], least_regularity(L)
    found = bound > least
    index = torch.nonzero(~found & ~(bound * m * (1.0 + 1e-9) < least)).flatten()
    if len(index):
        sigma = singular_values(L[index])
        found[index] = sigma[:, -1] > least * sigma[:, 0]
    return found


def least_regularity(L: Tensor) -> Tensor:
    """A lower bound [p] of sigma_min/sigma_max of triangular L [p, m, m], at most m too small: 1 / (|L| |L^-1|)."""
    identity = torch.eye(L.shape[-1], dtype=L.dtype, device=L.device)
    inverse = solve_lower(L, identity.expand_as(L))
    return 1.0 / (L.flatten(1).norm(dim=1) * inverse.flatten(1).norm(dim=1))
