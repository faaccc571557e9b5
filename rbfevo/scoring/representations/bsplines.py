"""B-spline basis functions on clamped knots, Bernstein polynomials among them, for NumPy and torch from one formula.

de Boor, "A Practical Guide to Splines", Springer 1978: the recurrence of Cox and de Boor. Fractions whose denominator
is 0, of knots that coincide, count as 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbfevo.geometry.namespaces import namespace


def uniform(count: int, degree: int) -> np.ndarray:
    """The inner knots [count - degree - 1] of `count` basis functions, evenly spaced in (0, 1)."""
    spans = count - degree
    return np.arange(1, spans) / spans


def clamped(inner: Any, degree: int) -> Any:
    """Knots [..., k + 2 (degree + 1)] of inner ones [..., k], which may come in any order."""
    if isinstance(inner, np.ndarray):
        ends = np.ones((*inner.shape[:-1], degree + 1))
        return np.concatenate([0.0 * ends, np.sort(inner, axis=-1), ends], axis=-1)
    import torch

    ends = inner.new_ones(*inner.shape[:-1], degree + 1)
    return torch.cat((0.0 * ends, inner.sort(dim=-1).values, ends), dim=-1)


def greville(knots: Any, degree: int) -> Any:
    """The abscissae [..., count] at which control points make the identity: means of `degree` knots in a row."""
    count = knots.shape[-1] - degree - 1
    return sum(knots[..., 1 + i : 1 + i + count] for i in range(degree)) / degree


def of_greville(abscissae: np.ndarray, degree: int) -> np.ndarray:
    """The inner knots [count - degree - 1] of clamped basis functions with these `greville` abscissae [count]."""
    knots = [0.0] * (degree + 1)
    for i in range(len(abscissae) - degree - 1):
        knots.append(knots[i + 1] + degree * (abscissae[i + 1] - abscissae[i]))
    return np.array(knots[degree + 1 :])


def basis(u: Any, knots: Any, degree: int) -> Any:
    """Values [..., q, count] at u [..., q] in [0, 1] of the basis functions of clamped knots [..., count + degree + 1].

    They are not negative and add up to 1; at u = 1 they are the limits from below.
    """
    xp = namespace(u)
    t, u = knots[..., None, :], u[..., None]
    if knots.shape[-1] == 2 * (degree + 1):
        return bernstein(u[..., 0], degree)
    low, high = t[..., :-1], t[..., 1:]
    inside = (u >= low) & ((u < high) | ((u >= 1.0) & (high >= 1.0) & (low < 1.0)))
    found = xp.where(inside, 1.0 + 0.0 * u, 0.0 * u)
    for k in range(1, degree + 1):
        rising = _over(u - t[..., : -k - 1], t[..., k:-1] - t[..., : -k - 1])
        falling = _over(t[..., k + 1 :] - u, t[..., k + 1 :] - t[..., 1:-k])
        found = rising * found[..., :-1] + falling * found[..., 1:]
    return found


def bernstein(u: Any, degree: int) -> Any:
    """Bernstein polynomials [..., degree + 1] of a degree at u [...]: binomial(p, i) u^i (1 - u)^(p - i)."""
    powers = np.arange(degree + 1.0)
    choices = np.array([math.comb(degree, i) for i in range(degree + 1)], dtype=np.float64)
    u = u[..., None]
    if not isinstance(u, np.ndarray):
        powers, choices = u.new_tensor(powers), u.new_tensor(choices)
    return choices * u**powers * (1.0 - u) ** (degree - powers)


def slopes(u: Any, knots: Any, degree: int) -> Any:
    """Derivatives [..., q, count] of `basis` by u."""
    xp = namespace(u)
    lower = basis(u, knots[..., 1:-1], degree - 1)
    spans = knots[..., degree + 1 : -1] - knots[..., 1 : -degree - 1]
    scaled = degree * _over(lower, spans[..., None, :])
    nothing = 0.0 * u[..., None]
    return _joined(xp, (nothing, scaled)) - _joined(xp, (scaled, nothing))


def _joined(xp: Any, parts: tuple[Any, ...]) -> Any:
    return xp.concatenate(parts, -1)


def _over(numerator: Any, denominator: Any) -> Any:
    """Their fraction; 0 where the denominator is 0."""
    xp = namespace(denominator)
    there = denominator > 0
    return xp.where(there, numerator / xp.where(there, denominator, 1.0), 0.0 * numerator)
