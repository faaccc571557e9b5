"""The displacement that gains most for its p-norm, fast: the method of `rbfevo.scoring.maxnorm`, in torch.

One setup at a time, float64, on the calling thread; beside the columns nothing is stored but a few numbers a vertex.

Three things make it fast. A vertex counts in the curvature by |d_i|^(p-2), which is next to nothing where d is small:
such vertices are left out, and a multiple of the identity that bounds what they add takes their place. It is large far
from the optimum, where it keeps steps short, and falls with them. Where nothing better is known the search begins on a
sample of the vertices. And a step comes with a bound of the gain: forces h at the vertices that gain what a does for
every d in the span give a.d = h.d <= |h|_p* |d|_p. When bound and gain agree, the search is over.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.scoring.maxnorm import DONE, NEAR, NOTHING, PASSES, along_line, flattest, power, stages

ROWS = 1024  # of a step of the curvature: in cache
FAINT = (1e-8, 1e-3)  # least and largest share of the largest |d_i|^(p-2) below which a vertex is left out
FALL = 1e-3  # that share over the squared decrement of the pass before
WARM = 1e-6  # that share in the first pass from near the optimum
ROUGH = 1e-4  # the squared decrement before the last pass on a sample
CLOSE = 1e-2  # the squared decrement below which a bound is worth its powers
SURE = 1e-11  # the squared decrement before the last pass: gradients then hold to some 1e-6


class Part(NamedTuple):
    """Components of a displacement that share columns: their numbers, and a basis [n, r] of the columns.

    The basis is orthonormal where rows count with u.
    """

    components: list[int]
    basis: Tensor


class Best(NamedTuple):
    """Coordinates [r, c] in each part's basis of the best d with |d|_p = 1, d itself [k, n], a.d, and the passes."""

    coordinates: list[Tensor]
    displacement: Tensor
    gain: float
    passes: int


def norm(d: Tensor, u: Tensor, p: float) -> float:
    """|d|_p of d [k, n], weights u [n] of sum 1."""
    squares = d.square().sum(0)
    largest = float(squares.max())
    if not largest > 0.0:
        return 1.0
    return largest**0.5 * float(u @ power(squares / largest, 0.5 * p)) ** (1.0 / p)


def dual_norm(a: Tensor, u: Tensor, p: float) -> float:
    """The largest a.d of all d [k, n] with |d|_p = 1."""
    return norm(a / u, u, p / (p - 1.0))


def best(
    parts: Sequence[Part],
    a: Tensor,
    u: Tensor,
    p: float,
    gap: float = 0.0,
    start: Tensor | None = None,
    sample: Tensor | None = None,
) -> Best | None:
    """The displacement in the span of some parts that maximizes a.d for |d|_p = 1; None where nothing gains anything.

    Args:
        parts: every component 0 .. k - 1 stands in one of them, unless nothing moves it.
        a: [k, n], u: [n] of sum 1; p: at least 2.
        gap: by what share of the gain its bound may lie above it at the end; 0 to go on until d is known, too.
        start: [k, n] a displacement that is near the best.
        sample: numbers of the vertices on which to begin without a start; passes over these alone are not counted.
    """
    climb = _Climb(parts, u, len(a))
    first = climb.linear = climb.pulled(a)  # the bases are orthonormal: for p = 2 this is the best
    if not float(first @ first) > NOTHING * float((a.square() / u).sum()):
        return None
    approach = [*stages(p), *[p] * PASSES]
    near = None if start is None else climb.pulled(u * start)
    if near is not None and climb.ratio(near, p) > climb.ratio(first, p):
        near, converged = climb.climbed(near, p, gap, [p] * NEAR, WARM)
        if converged:
            return climb.finished(near, p)
    if sample is not None:
        some = [Part(part.components, part.basis[sample]) for part in parts]
        rough = _Climb(some, u[sample] / u[sample].sum(), len(a), first)
        near, _ = rough.climbed(first, p, 0.0, approach[:NEAR], FAINT[1], ROUGH)
        if climb.ratio(near, p) > climb.ratio(first, p):
            near, converged = climb.climbed(near, p, gap, [p] * NEAR, WARM)
            if converged:
                return climb.finished(near, p)
    return climb.finished(climb.climbed(first, p, gap, approach, FAINT[1])[0], p)


class _Climb:
    """One problem; coordinates of all parts and components lie one behind the other: component by component.

    Args:
        parts: of which the columns are; u: [n] of sum 1; k: components of a displacement.
        linear: what each coordinate gains.
    """

    def __init__(self, parts: Sequence[Part], u: Tensor, k: int, linear: Tensor | None = None) -> None:
        self.parts, self.u, self.k, self.passes = parts, u, k, 0
        self._sizes = [part.basis.shape[1] * len(part.components) for part in parts]
        self.linear = torch.zeros(sum(self._sizes), dtype=u.dtype) if linear is None else linear

    def pulled(self, field: Tensor) -> Tensor:
        """What each coordinate gains by a field [k, n]."""
        return torch.cat([(field[part.components] @ part.basis).flatten() for part in self.parts])

    def displaced(self, z: Tensor) -> Tensor:
        """The displacement [k, n]."""
        d = torch.zeros(self.k, len(self.u), dtype=z.dtype)
        for part, coordinates in zip(self.parts, self._cut(z), strict=True):
            d[part.components] = coordinates.mT @ part.basis.mT
        return d

    def _cut(self, z: Tensor) -> list[Tensor]:
        """The coordinates [r, c] in each part's basis."""
        pieces = zip(self.parts, z.split(self._sizes), strict=True)
        return [piece.unflatten(0, (len(part.components), -1)).mT for part, piece in pieces]

    def ratio(self, z: Tensor, p: float) -> float:
        """a.d / |d|_p; 0 where there is no gain."""
        gain = float(self.linear @ z)
        return gain / norm(self.displaced(z), self.u, p) if gain > 0.0 else 0.0

    def finished(self, z: Tensor, p: float) -> Best:
        """The result, scaled to |d|_p = 1."""
        d = self.displaced(z)
        size = norm(d, self.u, p)
        z, d = z / size, d / size
        return Best(self._cut(z), d, float(self.linear @ z), self.passes)

    def climbed(
        self, z: Tensor, p: float, gap: float, plan: Sequence[float], faint: float, sure: float = SURE
    ) -> tuple[Tensor, bool]:
        """The coordinates after a pass for each p of a plan, or fewer that are enough, and whether they were.

        Args:
            z: where to begin; p, gap: as of `best`.
            faint: share of the largest |d_i|^(p-2) below which vertices are left out first.
            sure: the squared decrement before the last pass.
        """
        d = self.displaced(z)
        size = norm(d, self.u, plan[0])
        for q, following in zip(plan, [*plan[1:], p], strict=True):
            z, d, decrement, bound = self._pass(z / size, d / size, q, faint, gap > 0.0 and q == p)
            self.passes += 1
            size = norm(d, self.u, following)
            if q == p and (decrement <= sure or bound <= (1.0 + gap) * float(self.linear @ z) / size):
                return z, True
            faint = min(max(FALL * decrement, FAINT[0]), FAINT[1])
        return z, False

    def _pass(self, z: Tensor, d: Tensor, p: float, faint: float, bounded: bool) -> tuple[Tensor, Tensor, float, float]:
        """One Newton direction from z with |d|_p = 1, followed to the best along it.

        Returns:
            Coordinates and displacement, the squared decrement before, and a bound of the gain, which is infinite where
            none is asked for or the step is long.
        """
        squares, gain = d.square().sum(0), float(self.linear @ z)
        steepness = power(squares, 0.5 * p - 1.0)
        largest = float(steepness.max())
        weight = self.u * steepness
        slope = self.linear / gain - self.pulled(weight * d)  # of log(a.d / |d|_p)
        kept = torch.nonzero(steepness > faint * largest).flatten()
        stretch = (p - 2.0) * weight[kept] / squares[kept].clamp_min(torch.finfo(d.dtype).tiny)
        shift = (p - 1.0) * faint * largest
        H = self._curvature(d[:, kept], kept, weight[kept], stretch)
        H.diagonal().add_(shift)
        step = torch.cholesky_solve(slope[:, None], torch.linalg.cholesky(H))[:, 0]
        decrement = float(slope @ step)
        if not decrement > DONE:
            return z, d, 0.0, math.inf
        move, rise = self.displaced(step), float(self.linear @ step)
        cross, own = (d * move).sum(0), move.square().sum(0)
        along = along_line(squares, cross, own, self.u, p, gain, rise)
        share = flattest(along, math.log(gain), decrement)
        bound = math.inf
        if bounded and decrement <= CLOSE:
            forces = weight * d + shift * self.u * move
            forces[:, kept] += weight[kept] * move[:, kept] + stretch * cross[kept] * d[:, kept]
            bound = gain * dual_norm(forces, self.u, p)
        return z + share * step, d + share * move, decrement, bound

    def _curvature(self, d: Tensor, kept: Tensor, weight: Tensor, stretch: Tensor) -> Tensor:
        """Sum_i B_i^T (weight_i I + stretch_i d_i d_i^T) B_i over the vertices of the numbers `kept`."""
        total = sum(self._sizes)
        out = torch.zeros(total, total, dtype=d.dtype)
        ends = torch.tensor([0, *self._sizes]).cumsum(0).tolist()
        for s, left in enumerate(self.parts):
            for t, right in enumerate(self.parts[: s + 1]):
                pairs = [(c, e) for c in left.components for e in right.components if s != t or e <= c]
                rows, columns = left.basis.shape[1], right.basis.shape[1]
                sums = torch.zeros(rows, len(pairs) * columns, dtype=d.dtype)
                local = [stretch * d[c] * d[e] + weight if c == e else stretch * d[c] * d[e] for c, e in pairs]
                local = torch.stack(local, 1)[:, :, None]
                for begin in range(0, len(kept), ROWS):
                    these = slice(begin, begin + ROWS)
                    one = left.basis[kept[these]]
                    other = one if s == t else right.basis[kept[these]]
                    sums.addmm_(one.mT, (local[these] * other[:, None, :]).flatten(1))
                for (c, e), block in zip(pairs, sums.split(columns, 1), strict=True):
                    i = ends[s] + left.components.index(c) * rows
                    j = ends[t] + right.components.index(e) * columns
                    out[i : i + rows, j : j + columns] = block
                    out[j : j + columns, i : i + rows] = block.mT
        return out
