"""The displacement that gains most for its p-norm, fast: the method of `rbfevo.scoring.maxnorm`, in torch.

One setup at a time, float64, on the calling thread; beside the columns nothing is stored but a few numbers a vertex.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.scoring.maxnorm import DAMPING, DONE, FAINT, LEAST, NEAR, NOTHING, PASSES, along_line, flattest, stages

ROWS = 2048  # of a step of the curvature: in cache


class Part(NamedTuple):
    """Components of a displacement that share columns: their numbers, and a basis [n, r] of the columns.

    The basis is orthonormal where rows count with u.
    """

    components: list[int]
    basis: Tensor


class Best(NamedTuple):
    """Coordinates [r, c] in each part's basis of the best d with |d|_p = 1, d itself [n, k], a.d, and the passes."""

    coordinates: list[Tensor]
    displacement: Tensor
    gain: float
    passes: int


def norm(d: Tensor, u: Tensor, p: float) -> float:
    """|d|_p of d [n, k], weights u [n] of sum 1."""
    return _root(d.square().sum(1), u, p)


def dual_norm(a: Tensor, u: Tensor, p: float) -> float:
    """The largest a.d of all d [n, k] with |d|_p = 1."""
    return norm(a / u[:, None], u, p / (p - 1.0))


def best(
    parts: Sequence[Part], a: Tensor, u: Tensor, p: float, tolerance: float, start: Tensor | None = None
) -> Best | None:
    """The displacement in the span of some parts that maximizes a.d for |d|_p = 1; None where nothing gains anything.

    Args:
        parts: every component 0 .. k - 1 stands in one of them, unless nothing moves it.
        a: [n, k], u: [n] of sum 1; p: at least 2.
        tolerance: of the squared Newton decrement before the last pass, twice the relative error of the gain then.
        start: [n, k] a displacement in the span that is near the best.
    """
    climb = _Climb(parts, a, u)
    z = climb.linear  # the bases are orthonormal: for p = 2 this is the best
    if not float(z @ z) > NOTHING * float((a.square() / u[:, None]).sum()):
        return None
    passes = 0
    if start is not None:
        near = climb.pulled(u[:, None] * start)
        if climb.ratio(near, p) > climb.ratio(z, p):
            found, passes, converged = climb.climbed(near, p, tolerance, [p] * NEAR)
            if converged:
                return climb.finished(found, p, passes)
    found, count, _ = climb.climbed(z, p, tolerance, [*stages(p), *[p] * PASSES])
    return climb.finished(found, p, passes + count)


class _Climb:
    """One problem; coordinates of all parts and components lie one behind the other: component by component."""

    def __init__(self, parts: Sequence[Part], a: Tensor, u: Tensor) -> None:
        self.parts, self.u, self.shape = parts, u, a.shape
        self.columns = [(c, part.basis) for part in parts for c in part.components]
        self.sizes = [basis.shape[1] for _, basis in self.columns]
        self.linear = self.pulled(a)

    def pulled(self, field: Tensor) -> Tensor:
        """What each coordinate gains by a field [n, k]."""
        return torch.cat([(part.basis.mT @ field[:, part.components]).mT.flatten() for part in self.parts])

    def displaced(self, z: Tensor) -> Tensor:
        """The displacement [n, k]."""
        d = torch.zeros(self.shape, dtype=z.dtype)
        for part, coordinates in zip(self.parts, self._cut(z), strict=True):
            d[:, part.components] = part.basis @ coordinates
        return d

    def _cut(self, z: Tensor) -> list[Tensor]:
        """The coordinates [r, c] in each part's basis."""
        sizes = [part.basis.shape[1] * len(part.components) for part in self.parts]
        pieces = zip(self.parts, z.split(sizes), strict=True)
        return [piece.unflatten(0, (len(part.components), -1)).mT for part, piece in pieces]

    def ratio(self, z: Tensor, p: float) -> float:
        """a.d / |d|_p; 0 where there is no gain."""
        gain = float(self.linear @ z)
        return gain / norm(self.displaced(z), self.u, p) if gain > 0.0 else 0.0

    def finished(self, z: Tensor, p: float, passes: int) -> Best:
        """The result, scaled to |d|_p = 1."""
        d = self.displaced(z)
        size = norm(d, self.u, p)
        z, d = z / size, d / size
        return Best(self._cut(z), d, float(self.linear @ z), passes)

    def climbed(self, z: Tensor, p: float, tolerance: float, plan: Sequence[float]) -> tuple[Tensor, int, bool]:
        """The coordinates after a pass for each p of a plan, how many there were, and whether they have converged."""
        d = self.displaced(z)
        for count, q in enumerate(plan, 1):
            size = norm(d, self.u, q)
            z, d, decrement = self._pass(z / size, d / size, q)
            if q == p and decrement <= tolerance:
                return z, count, True
        return z, len(plan), False

    def _pass(self, z: Tensor, d: Tensor, p: float) -> tuple[Tensor, Tensor, float]:
        """One Newton direction from z with |d|_p = 1, followed to the best along it; the squared decrement before."""
        squares, gain = d.square().sum(1), float(self.linear @ z)
        weight = self.u * squares ** (0.5 * p - 1.0)
        slope = self.linear / gain - self.pulled(weight[:, None] * d)  # of log(a.d / |d|_p)
        least = FAINT * float((weight / self.u).max())
        step = _solve(self._curvature(d, squares, weight.maximum(least * self.u), p), slope)
        decrement = float(slope @ step)
        if not decrement > DONE:
            return z, d, 0.0
        move, rise = self.displaced(step), float(self.linear @ step)
        cross, own = (d * move).sum(1), move.square().sum(1)
        along = along_line(squares, cross, own, self.u, p, gain, rise)
        share = flattest(along, math.log(gain), decrement)
        return z + share * step, d + share * move, decrement

    def _curvature(self, d: Tensor, squares: Tensor, weight: Tensor, p: float) -> Tensor:
        """Sum_i w_i B_i^T (I + (p - 2) e_i e_i^T) B_i with e = d / |d|."""
        scaled = (p - 2.0) * weight / squares.clamp_min(torch.finfo(d.dtype).tiny)
        out = torch.zeros(sum(self.sizes), sum(self.sizes), dtype=d.dtype)
        places = [0, *torch.tensor(self.sizes).cumsum(0).tolist()]
        for i, (c, left) in enumerate(self.columns):
            for j, (e, right) in enumerate(self.columns[: i + 1]):
                factor = scaled * d[:, c] * d[:, e]
                if i == j:
                    factor = factor + weight
                rows, columns = slice(places[i], places[i + 1]), slice(places[j], places[j + 1])
                block = out[rows, columns]
                for begin in range(0, len(d), ROWS):
                    these = slice(begin, begin + ROWS)
                    block += left[these].mT @ (factor[these, None] * right[these])
                if i != j:
                    out[columns, rows] = block.mT
        return out


def _root(squares: Tensor, u: Tensor, p: float) -> float:
    largest = float(squares.max())
    if not largest > 0.0:
        return 1.0
    return largest**0.5 * float(u @ (squares / largest) ** (0.5 * p)) ** (1.0 / p)


def _solve(H: Tensor, b: Tensor) -> Tensor:
    """H^-1 b of a curvature H, scaled to a diagonal of ones and damped."""
    diagonal = H.diagonal()
    scale = diagonal.clamp_min(LEAST * max(float(diagonal.max()), 1e-300)).rsqrt()
    scaled = H * scale[:, None] * scale
    for damping in DAMPING:
        L, info = torch.linalg.cholesky_ex(scaled + damping * torch.eye(len(H), dtype=H.dtype))
        if int(info) == 0:
            return scale * torch.cholesky_solve((scale * b)[:, None], L)[:, 0]
    return scale * (scale * b)
