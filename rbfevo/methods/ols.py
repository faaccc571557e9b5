"""Orthogonal least squares: pick, one after the other, the centers that raise the improvement potential the most.

Chen, Billings & Luo, "Orthogonal least squares methods and their application to non-linear system identification",
Int. J. Control 50(5), 1989; section 7 of the paper. With Q [n, t] an orthonormal basis of the t columns picked so far
and r = g - Q Q^T g, a candidate with column phi and w = phi - Q Q^T phi would raise P by

    gain = |w^T r|_F^2 / (w^T w).

The textbook orthogonalizes every column against every pick. Here a candidate carries only bounds: with y = phi^T q for
the newest q, w^T w falls by y^2 and w^T r by y (q^T r); y comes from columns that are kept in single precision if need
be, and the bounds allow for that. Only who may win by them is orthogonalized against all of Q, in double precision. So
the picks are those of the textbook, and each costs about one product with the kept columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.errors import UserError


class Selection(NamedTuple):
    """Centers [count, d] in the order picked, their candidate indices [count], the rise of P [count] each brought."""

    centers: Tensor
    indices: Tensor
    gains: Tensor


def grid_candidates(lower: Tensor, upper: Tensor, per_axis: int = 30) -> Tensor:
    """Return the uniform grid [per_axis**d, d] over the box `lower` [d], `upper` [d], ends included, last axis fastest.

    Raises:
        UserError: if `per_axis` is below 2.
    """
    if per_axis < 2:
        raise UserError(f"the grid of OLS candidates needs at least 2 points per axis, not {per_axis}")
    steps = torch.linspace(0.0, 1.0, per_axis, dtype=lower.dtype, device=lower.device)
    axes = [torch.lerp(low, high, steps) for low, high in zip(lower, upper, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(axes))


@torch.no_grad()
def ols(
    columns: Callable[[Tensor], Tensor],
    candidates: Tensor,
    gradient: Tensor,
    count: int,
    *,
    weights: Tensor | None = None,
    tolerance: float = 1e-9,
    vanish: float = 1e-12,
    memory: float = 1.25e9,
    block: int = 128,
) -> Selection:
    """Pick `count` of `candidates` [c, d] greedily, to maximize the improvement potential P of indirect manipulation.

    Gains are exact, count all columns of g together, and are in units of P: relative to the squared (weighted)
    Frobenius norm of g. Those within `tolerance` of the best tie, and the lowest index wins. A candidate is skipped if
    its column is zero or not finite, or if w^T w is below the fraction `vanish` of phi^T phi.

    Args:
        columns: maps centers [b, d] to their float64 kernel columns [n, b] at all vertices, without weights.
        candidates: [c, d], model units.
        gradient: [n, k] float64, the estimated fitness gradient g.
        count: number of centers to pick.
        weights: [n] positive; rows of Phi and g count with their square roots.
        tolerance: width of a tie, in P.
        vanish: see above.
        memory: bytes for kept columns: float64 if all fit, else float32; what does not fit is computed at every pick.
        block: number of candidates computed at a time.

    Raises:
        UserError: if `count` is below 1, g is zero or not finite, or fewer than `count` candidates can be used.
    """
    if count < 1:
        raise UserError(f"OLS has to pick at least one center, not {count}")
    if count > len(candidates):
        raise UserError(f"OLS cannot pick {count} centers from {len(candidates)} candidates: refine the candidate grid")
    root = None if weights is None else weights.sqrt()[:, None]
    rest = gradient if root is None else gradient * root
    length = torch.linalg.vector_norm(rest)
    if not bool(length.isfinite() & (length > 0)):
        raise UserError("OLS needs an estimated fitness gradient that is finite and not zero everywhere")

    screen = _Screen(columns, candidates, root, rest / length, memory, block)
    basis = rest.new_empty(count, len(rest)).T
    indices: list[int] = []
    gains: list[Tensor] = []
    for t in range(count):
        winner, gain = screen.best(basis[:, :t], tolerance, vanish)
        if winner < 0:
            raise UserError(
                f"only {t} of the {len(candidates)} OLS candidates have kernel columns independent of each other, for "
                f"{count} centers: ask for fewer centers, refine the candidate grid or enlarge the support radius"
            )
        indices.append(winner)
        gains.append(gain)
        basis[:, t] = screen.pick(winner, basis[:, :t])
        if t + 1 < count:
            screen.advance(basis[:, t])
    chosen = torch.tensor(indices, device=candidates.device)
    return Selection(candidates[chosen], chosen, torch.stack(gains))


class _Screen:
    """What is known of every candidate, its column phi scaled to unit length, given the picks so far.

    `left` [c] bounds w^T w from below, `moment` [c, k] is w^T r to within `doubt` [c] in norm, `usable` [c] says who
    may still be picked. A product of a kept unit column with a unit vector is taken to be wrong by at most `slack`: u
    for rounding each factor and sqrt(n) u for summing n terms (Higham & Mary 2019), in the column's precision.
    """

    def __init__(
        self,
        columns: Callable[[Tensor], Tensor],
        candidates: Tensor,
        root: Tensor | None,
        rest: Tensor,
        memory: float,
        block: int,
    ):
        self.columns, self.candidates, self.root, self.rest, self.block = columns, candidates, root, rest, block
        c, (n, k) = len(candidates), rest.shape
        keep = torch.float64 if 8 * n * c <= memory else torch.float32
        self.rounding, rough = (torch.finfo(dtype).eps * (1 + math.sqrt(n) / 2) for dtype in (torch.float64, keep))
        self.scale, self.moment = rest.new_zeros(c), rest.new_zeros(c, k)
        self.slack = rest.new_full((c,), self.rounding)
        self.blocks = torch.arange(c, device=rest.device).split(block)
        self.kept: list[Tensor] = []
        for indices in self.blocks:
            phi = self._weighted(indices)
            square = (phi * phi).sum(0)
            scale = torch.where(square.isfinite() & (square > 0), square.rsqrt(), 0.0)
            self.scale[indices] = scale
            self.moment[indices] = (phi.T @ rest) * scale[:, None]
            memory -= phi.numel() * keep.itemsize
            if memory >= 0:
                self.kept.append(torch.mul(phi, scale, out=torch.empty_like(phi, dtype=keep)))
                self.slack[indices] = rough
        self.usable = self.scale > 0
        self.left = self.usable.to(rest.dtype)
        self.doubt = torch.full_like(self.left, self.rounding)

    def _weighted(self, indices: Tensor) -> Tensor:
        phi = self.columns(self.candidates[indices])
        return phi if self.root is None else phi * self.root

    def _remainder(self, indices: Tensor, Q: Tensor) -> Tensor:
        """Return the columns w [n, b], in double precision; projecting twice suffices (Giraud et al. 2005)."""
        w = self._weighted(indices) * self.scale[indices]
        w -= Q @ (Q.T @ w)
        w -= Q @ (Q.T @ w)
        return w

    def best(self, Q: Tensor, tolerance: float, vanish: float) -> tuple[int, Tensor]:
        """Return index and exact gain of the next pick, or -1 and 0 if no candidate can be used."""
        remaining = (self.rest * self.rest).sum()
        upper = (torch.linalg.vector_norm(self.moment, dim=1) + self.doubt).square() / self.left
        upper = torch.where(self.left > 0, upper, torch.inf).clamp(max=remaining)
        exact = torch.full_like(upper, -torch.inf)  # the gains computed in full
        index = torch.arange(len(upper), device=upper.device)
        batch = 4
        while True:
            top = exact.max()
            tied = (exact >= 0) & (exact >= top - tolerance)
            first = int(tied.int().argmax()) if bool(tied.any()) else -1
            doubtful = self.usable & exact.isneginf() & (upper >= top - tolerance)
            if first >= 0:  # a later one that cannot lead the first by more than the tolerance changes nothing
                doubtful &= (index < first) | (upper > exact[first] + tolerance)
            ahead = torch.where(doubtful, upper, -torch.inf).argsort(descending=True, stable=True)
            ahead = ahead[: min(batch, int(doubtful.sum()))]
            if len(ahead) == 0:
                return first, exact[first] if first >= 0 else torch.zeros_like(remaining)
            w = self._remainder(ahead, Q)
            square, moment = (w * w).sum(0), w.T @ self.rest
            alive = square >= vanish
            exact[ahead] = torch.where(alive, (moment * moment).sum(1) / square, -torch.inf)
            self.usable[ahead[~alive]] = False
            self.left[ahead] = (square.sqrt() - self.rounding).clamp(min=0).square()
            self.moment[ahead] = moment
            self.doubt[ahead] = self.rounding
            batch = min(2 * batch, self.block)

    def pick(self, winner: int, Q: Tensor) -> Tensor:
        """Take `winner` out and return the unit vector q [n] that it adds to Q."""
        self.usable[winner] = False
        q = self._remainder(self.blocks[0].new_tensor([winner]), Q)[:, 0]
        return q / torch.linalg.vector_norm(q)

    def advance(self, q: Tensor) -> None:
        """Bring the bounds and r up to date with the newest q."""
        rough = q.to(self.kept[0].dtype) if self.kept else q
        products = [torch.mv(phi.T, rough).to(q.dtype) for phi in self.kept]
        products += [torch.mv(self._weighted(i).T, q) * self.scale[i] for i in self.blocks[len(self.kept) :]]
        y = torch.cat(products)
        share = q @ self.rest
        self.left -= (y.abs() + self.slack).square()
        self.moment -= torch.outer(y, share)
        self.doubt += self.slack * torch.linalg.vector_norm(share)
        self.rest = self.rest - torch.outer(q, share)
