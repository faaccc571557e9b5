"""The displacement within reach that gains most for a bounded p-norm: for a large p, for a bounded largest one.

A step of an optimizer is limited by the largest displacement of a vertex: by the mesh, by packaging, by the range in
which the objective is linear. Within the columns of U the displacement d that gains most, a.d, for |d|_p = 1 with

    |d|_p = (sum_i u_i |d_i|^p)^(1/p), sum_i u_i = 1,

is the one for a bounded root mean square where p = 2 (what improvement potential measures), and nearly the one for a
bounded maximum where p = 16. NumPy, float64; one setup.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array

GROWTH = 1.5  # of p - 1, from one stage to the next: Newton's method then starts where it converges
DECREMENT = 1e-20  # of the squared Newton decrement, twice the error of the objective
STEPS = 60  # of Newton's method in one stage, at most
DAMPING = 1e-14  # of the largest curvature, so that directions that move nothing stay out of the way
ARMIJO, HALVINGS = 1e-4, 40
NOTHING = 1e-24  # of |a|^2: a gain below is rounding


class Block(NamedTuple):
    """Components of a displacement that share columns: their numbers [c], and the columns' orthonormal basis [n, r]."""

    components: Array
    basis: Array


class Gain(NamedTuple):
    """The best displacement d [n, k] with |d|_p = 1, its coordinates [r, c] in each block's basis, and its gain a.d."""

    displacement: Array
    coordinates: list[Array]
    gain: float


def best_displacement(blocks: Sequence[Block], a: Array, weights: Array, p: float = 16.0) -> Gain:
    """The displacement in the span of some blocks that maximizes a.d for |d|_p = 1.

    The optimum is unique where the bases have full rank: it minimizes the convex |d|_p^p / p - a.d, but for its size.
    Newton's method with a line search solves this for a p that grows from 2, where it is linear.

    Args:
        blocks: components and bases; every component 0 .. k - 1 stands in one of them.
        a: [n, k] what a displacement of each vertex gains; weights: [n] positive, u up to a factor; p: at least 2.

    Returns:
        A gain of 0 and no displacement where nothing in the span gains anything.
    """
    u = weights / weights.sum()
    slices, start = [], 0
    for block in blocks:
        size = block.basis.shape[1] * len(block.components)
        slices.append(slice(start, start + size))
        start += size

    def coordinates(z: Array) -> list[Array]:
        """The coordinates [r, c] in each block's basis."""
        shapes = [(block.basis.shape[1], len(block.components)) for block in blocks]
        return [z[part].reshape(shape) for part, shape in zip(slices, shapes, strict=True)]

    def displaced(z: Array) -> Array:
        """The displacement [n, k]."""
        d = np.zeros(a.shape)
        for block, part in zip(blocks, coordinates(z), strict=True):
            d[:, block.components] = block.basis @ part
        return d

    def pulled(field: Array) -> Array:
        """What each coordinate gains by a field [n, k]."""
        return np.concatenate([(block.basis.T @ field[:, block.components]).ravel() for block in blocks])

    linear = pulled(a)
    if not linear.any():
        return Gain(np.zeros(a.shape), coordinates(np.zeros_like(linear)), 0.0)
    H = _curvature(blocks, np.repeat(np.eye(a.shape[1])[None], len(u), axis=0) * u[:, None, None])
    z = _solved(H, linear)
    if float(linear @ z) <= NOTHING * float((a**2 / u[:, None]).sum()):
        z = np.zeros_like(z)
    else:
        for q in _stages(p):
            z = _newton(blocks, z / norm(displaced(z), u, q), linear, u, q, displaced, pulled)
        z = z / norm(displaced(z), u, p)
    return Gain(displaced(z), coordinates(z), float(linear @ z))


def _stages(p: float) -> list[float]:
    """The values of p between 2 and the last, which is the one asked for."""
    found = [2.0]
    while found[-1] < p:
        found.append(min(p, 1.0 + GROWTH * (found[-1] - 1.0)))
    return found[1:]


def norm(d: Array, weights: Array, p: float) -> float:
    """|d|_p of a displacement d [n, k], with weights [n] up to a factor; for any size of d."""
    u = weights / weights.sum()
    lengths = np.linalg.norm(d, axis=1)
    largest = float(lengths.max(initial=0.0)) or 1.0
    return largest * float((u * (lengths / largest) ** p).sum()) ** (1.0 / p)


def _newton(
    blocks: Sequence[Block],
    z: Array,
    linear: Array,
    u: Array,
    p: float,
    displaced: Callable[[Array], Array],
    pulled: Callable[[Array], Array],
) -> Array:
    """Minimize |d|_p^p / p - a.d from z with |d|_p = 1; a is scaled so that the minimum has a norm near 1."""
    scaled = linear / float(linear @ z)
    d = displaced(z)
    value = _objective(d, u, p) - float(scaled @ z)
    for _ in range(STEPS):
        lengths = np.linalg.norm(d, axis=1)
        weight = u * lengths ** (p - 2.0)
        slope = pulled(weight[:, None] * d) - scaled
        directions = np.divide(d, lengths[:, None], out=np.zeros_like(d), where=lengths[:, None] > 0)
        local = np.eye(d.shape[1]) + (p - 2.0) * directions[:, :, None] * directions[:, None, :]
        H = _curvature(blocks, weight[:, None, None] * local)
        step = -_solved(H, slope)
        decrement = -float(slope @ step)
        if decrement <= DECREMENT:
            break
        move, share = displaced(step), 1.0
        for _ in range(HALVINGS):
            trial = _objective(d + share * move, u, p) - float(scaled @ (z + share * step))
            if trial <= value - ARMIJO * share * decrement:
                break
            share /= 2.0
        else:
            break  # rounding
        z, d, value = z + share * step, d + share * move, trial
    return z


def _solved(H: Array, right: Array) -> Array:
    """H^-1 right of a positive semidefinite H, damped a little."""
    from scipy.linalg import cho_factor, cho_solve  # which takes a while, and most commands need none

    damped = H + DAMPING * H.diagonal().max(initial=1e-300) * np.eye(len(H))
    return cho_solve(cho_factor(damped), right)


def _objective(d: Array, u: Array, p: float) -> float:
    return float((u * np.linalg.norm(d, axis=1) ** p).sum()) / p


def _curvature(blocks: Sequence[Block], local: Array) -> Array:
    """Sum_i B_i^T local_i B_i for local [n, k, k], in the order of the coordinates."""
    rows = []
    for one in blocks:
        row = []
        for other in blocks:
            part = np.empty((one.basis.shape[1], len(one.components), other.basis.shape[1], len(other.components)))
            for i, c in enumerate(one.components):
                for j, e in enumerate(other.components):
                    part[:, i, :, j] = one.basis.T @ (local[:, c, e, None] * other.basis)
            row.append(part.reshape(one.basis.shape[1] * len(one.components), -1))
        rows.append(np.hstack(row))
    return np.vstack(rows)
