"""The displacement within reach that gains most for a bounded p-norm: for a large p, for a bounded largest one.

A step of an optimizer is limited by the largest displacement of a vertex: by the mesh, by packaging, by the range in
which the objective is linear. Within the columns of U the displacement d that gains most, a.d, for |d|_p = 1 with

    |d|_p = (sum_i u_i |d_i|^p)^(1/p), sum_i u_i = 1,

is the one for a bounded root mean square where p = 2 (what improvement potential measures), and nearly the one for a
bounded maximum where p = 16. NumPy, float64; one setup.

The ratio a.d / |d|_p does not depend on the size of d, is quasi-concave where it is positive, and its maximum in the
span of some columns is unique. Newton's directions of |d|_p^p / p - a.d, each followed to the maximum of the ratio
along it, get there in some seven passes from the optimum for p = 2; without that search along them the size of d alone
takes more. A larger p than 4 is approached by one pass each for 4, 8, ...
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array

Along = Callable[[float], tuple[float, float]]  # t -> value and slope

FIRST = 4.0  # the first p on the way to a larger one; each is twice the one before
TOLERANCE = 1e-13  # of the squared Newton decrement before the last pass: it falls to about its square by that pass
DONE = 1e-25  # of the same: rounding
PASSES = 60  # at most
NEAR = 12  # from a start that was given, before all begins anew
FAINT = 1e-5  # of the largest weight of a vertex in the curvature: what smaller ones count as, lest steps be too long
DAMPING = (1e-13, 1e-10, 1e-7, 1e-4)  # of the scaled curvature: the first with which it can be factorized
LEAST = 1e-30  # of the largest curvature: what smaller ones count as
NOTHING = 1e-24  # of |a|^2: a gain below is rounding
FLAT = 0.05  # of the slope at the start of a line: where the search along it ends
SOFT = 0.1  # of the logarithm of the ratio: a slope that could change it by much less at t is flat, too
ROUNDING = 1e-13  # of the logarithm of the ratio
TRIALS = 60  # of a search along a line
DEPENDENT = 1e-10  # singular values of rows of unit length that count as zero
LARGEST_WHOLE = 64  # exponent for which multiplications are no worse than x^exponent


class Block(NamedTuple):
    """Components of a displacement that share columns: their numbers [c], and the columns' orthonormal basis [n, r]."""

    components: Array
    basis: Array


class Gain(NamedTuple):
    """The best displacement d [n, k] with |d|_p = 1, its coordinates [r, c] in each block's basis, and its gain a.d.

    `passes` counts the assemblies of the curvature.
    """

    displacement: Array
    coordinates: list[Array]
    gain: float
    passes: int = 0


def best_displacement(
    blocks: Sequence[Block],
    a: Array,
    weights: Array,
    p: float = 16.0,
    start: Array | None = None,
    without: Sequence[Array] = (),
) -> Gain:
    """The displacement in the span of some blocks that maximizes a.d for |d|_p = 1.

    Args:
        blocks: components and bases; every component 0 .. k - 1 stands in one of them.
        a: [n, k] what a displacement of each vertex gains; weights: [n] positive, u up to a factor; p: at least 2.
        start: [n, k] a displacement near the best one, such as that of a similar setup; taken where it gains more than
            the best one for p = 2.
        without: [n, k] each, fields by which the displacement is to gain nothing.

    Returns:
        A gain of 0 and no displacement where nothing in the span gains anything.
    """
    u, size = weights / weights.sum(), float(np.abs(a).max(initial=0.0)) or 1.0
    a = a / size
    space = _Span(blocks, a.shape, without)
    linear = space.pulled(a)
    if not linear.any():
        return Gain(np.zeros(a.shape), space.coordinates(np.zeros_like(linear)), 0.0)
    z = _solve(space.curvature(np.repeat(np.eye(a.shape[1])[None], len(u), axis=0) * u[:, None, None]), linear)
    if float(linear @ z) <= NOTHING * float((a**2 / u[:, None]).sum()):
        return Gain(np.zeros(a.shape), space.coordinates(np.zeros_like(linear)), 0.0)
    passes, near = 1, None if start is None else space.pulled(start)
    if near is not None and _ratio(space, near, linear, u, p) > _ratio(space, z, linear, u, p):
        found, count, converged = _climbed(space, near, linear, u, p, [p] * NEAR)
        passes += count
        near = found if converged else None
    else:
        near = None
    if near is None:
        near, count, _ = _climbed(space, z, linear, u, p, [*stages(p), *[p] * PASSES])
        passes += count
    z = near / norm(space.displaced(near), u, p)
    return Gain(space.displaced(z), space.coordinates(z), size * float(linear @ z), passes)


def _ratio(space: _Span, z: Array, linear: Array, u: Array, p: float) -> float:
    """a.d / |d|_p; 0 where there is no gain."""
    gain = float(linear @ z)
    return gain / norm(space.displaced(z), u, p) if gain > 0.0 else 0.0


def _climbed(
    space: _Span, z: Array, linear: Array, u: Array, p: float, plan: Sequence[float]
) -> tuple[Array, int, bool]:
    """The coordinates after a pass for each p of a plan, how many there were, and whether they have converged."""
    for count, q in enumerate(plan, 1):
        z, decrement = _pass(space, z / norm(space.displaced(z), u, q), linear, u, q)
        if q == p and decrement <= TOLERANCE:
            return z, count, True
    return z, len(plan), False


def stages(p: float) -> list[float]:
    """The values of p between 2 and the one asked for that are passed on the way."""
    found, q = [], FIRST
    while q < p:
        found.append(q)
        q *= 2.0
    return found


def norm(d: Array, weights: Array, p: float) -> float:
    """|d|_p of a displacement d [n, k], with weights [n] up to a factor; for any size of d."""
    u = weights / weights.sum()
    lengths = np.linalg.norm(d, axis=1)
    largest = float(lengths.max(initial=0.0)) or 1.0
    return largest * float((u * (lengths / largest) ** p).sum()) ** (1.0 / p)


def dual_norm(a: Array, weights: Array, p: float) -> float:
    """The largest a.d of all displacements d [n, k] with |d|_p = 1: (sum_i u_i |a_i / u_i|^p*)^(1/p*)."""
    u = weights / weights.sum()
    return norm(a / u[:, None], u, p / (p - 1.0))


def _pass(space: _Span, z: Array, linear: Array, u: Array, p: float) -> tuple[Array, float]:
    """One Newton direction from z with |d|_p = 1, and the best coordinates along it; the squared decrement before."""
    d = space.displaced(z)
    lengths = np.linalg.norm(d, axis=1)
    weight = u * lengths ** (p - 2.0)
    gain = float(linear @ z)
    slope = linear / gain - space.pulled(weight[:, None] * d)  # of log(a.d / |d|_p)
    directions = np.divide(d, lengths[:, None], out=np.zeros_like(d), where=lengths[:, None] > 0)
    felt = np.maximum(weight, FAINT * float((weight / u).max()) * u)
    local = np.eye(d.shape[1]) + (p - 2.0) * directions[:, :, None] * directions[:, None, :]
    step = _solve(space.curvature(felt[:, None, None] * local), slope)
    decrement = float(slope @ step)
    if not decrement > DONE:
        return z, 0.0
    move = space.displaced(step)
    squares, cross, own = ((one * other).sum(1) for one, other in ((d, d), (d, move), (move, move)))
    along = along_line(squares, cross, own, u, p, gain, float(linear @ step))
    return z + flattest(along, math.log(gain), decrement) * step, decrement


def along_line(squares: Any, cross: Any, own: Any, u: Any, p: float, gain: float, rise: float) -> Along:
    """log(a.d / |d|_p) and its slope along the line d + t move, as a function of t; NumPy and torch alike.

    Args:
        squares, cross, own: [n] |d_i|^2, d_i.move_i and |move_i|^2; u: [n] of sum 1; p: of the norm.
        gain, rise: a.d and a.move.
    """

    def along(t: float) -> tuple[float, float]:
        """Value and slope at t; both -inf where there is no gain."""
        if gain + t * rise <= 0.0:
            return -math.inf, -math.inf
        there = (squares + t * (2.0 * cross + t * own)).clip(min=0.0)
        largest = float(there.max())
        powers = u * power(there / largest, 0.5 * p - 1.0)
        total = float(powers @ there)
        value = math.log(gain + t * rise) - 0.5 * math.log(largest) - math.log(total / largest) / p
        return value, rise / (gain + t * rise) - float(powers @ (cross + t * own)) / total

    return along


def power(x: Any, exponent: float) -> Any:
    """x^exponent of x >= 0, NumPy and torch alike: by a few multiplications where the exponent is whole."""
    whole = int(exponent)
    if whole != exponent or not 1 <= whole <= LARGEST_WHOLE:
        return x**exponent
    found = None
    while True:
        if whole & 1:
            found = x if found is None else found * x
        whole >>= 1
        if not whole:
            return found
        x = x * x


def flattest(along: Along, value: float, first: float) -> float:
    """Where a function of t > 0 with one maximum has nearly no slope: at 1, if that will do.

    Args:
        along: value and slope at t, both -inf beyond its domain; value, first: those at 0, where the slope is positive.
    """
    low, below, high, above, t = 0.0, first, math.inf, -math.inf, 1.0
    for _ in range(TRIALS):
        found, slope = along(t)
        if abs(slope) <= FLAT * min(first, SOFT / t) and found >= value - ROUNDING:
            return t
        width = high - low
        if slope > 0 and found >= value - ROUNDING:
            low, below, above = t, slope, 0.5 * above
        else:
            high, above, below = t, min(slope, 0.0), 0.5 * below
        if high == math.inf:
            t = 2.0 * low
        elif above < below and not math.isinf(above) and high - low <= 0.5 * width:
            t = (low * above - high * below) / (above - below)  # regula falsi; an end that stays counts half (Illinois)
        else:
            t = 0.5 * (low + high) if low > 0 else 0.125 * high
        if not low < t < math.inf:
            break
    return low


def _solve(H: Array, b: Array) -> Array:
    """H^-1 b of a curvature H, scaled to a diagonal of ones and damped."""
    from scipy.linalg import LinAlgError, cho_factor, cho_solve  # which takes a while, and most commands need none

    diagonal = H.diagonal()
    scale = 1.0 / np.sqrt(np.maximum(diagonal, LEAST * diagonal.max(initial=1e-300)))
    scaled = H * scale[:, None] * scale
    for damping in DAMPING:
        try:
            return scale * cho_solve(cho_factor(scaled + damping * np.eye(len(H))), scale * b)
        except LinAlgError:
            continue
    return scale * (scale * b)


class _Span:
    """The displacements [n, k] that some blocks span, or those of them that gain nothing by some fields.

    Coordinates of all blocks lie one behind the other; of the latter they are those in a basis of their own.
    """

    def __init__(self, blocks: Sequence[Block], shape: tuple[int, ...], without: Sequence[Array] = ()) -> None:
        self.blocks, self.shape = blocks, shape
        ends = np.cumsum([0, *(block.basis.shape[1] * len(block.components) for block in blocks)])
        self._slices = [slice(begin, end) for begin, end in itertools.pairwise(ends.tolist())]
        self._within: Array | None = None
        if without:
            self._within = _across(np.stack([self.pulled(field) for field in without]))

    def coordinates(self, z: Array) -> list[Array]:
        """The coordinates [r, c] in each block's basis."""
        z = z if self._within is None else self._within @ z
        shapes = [(block.basis.shape[1], len(block.components)) for block in self.blocks]
        return [z[part].reshape(shape) for part, shape in zip(self._slices, shapes, strict=True)]

    def displaced(self, z: Array) -> Array:
        """The displacement [n, k]."""
        d = np.zeros(self.shape)
        for block, part in zip(self.blocks, self.coordinates(z), strict=True):
            d[:, block.components] = block.basis @ part
        return d

    def pulled(self, field: Array) -> Array:
        """What each coordinate gains by a field [n, k]."""
        found = np.concatenate([(block.basis.T @ field[:, block.components]).ravel() for block in self.blocks])
        return found if self._within is None else self._within.T @ found

    def curvature(self, local: Array) -> Array:
        """Sum_i B_i^T local_i B_i for local [n, k, k], in the order of the coordinates."""
        rows = []
        for one in self.blocks:
            row = []
            for other in self.blocks:
                part = np.empty((one.basis.shape[1], len(one.components), other.basis.shape[1], len(other.components)))
                for i, c in enumerate(one.components):
                    for j, e in enumerate(other.components):
                        part[:, i, :, j] = one.basis.T @ (local[:, c, e, None] * other.basis)
                row.append(part.reshape(one.basis.shape[1] * len(one.components), -1))
            rows.append(np.hstack(row))
        found = np.vstack(rows)
        return found if self._within is None else self._within.T @ found @ self._within


def _across(rows: Array) -> Array:
    """An orthonormal basis [r, q] of what is orthogonal to rows [s, r]; rows of 0 do not count."""
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    _, sigma, right = np.linalg.svd(np.divide(rows, lengths, out=np.zeros_like(rows), where=lengths > 0))
    return right[int((sigma > DEPENDENT).sum()) :].T
