"""Quasi-Newton steps in the space of a setup's weights: damped BFGS, within a bound of the displacement.

Coordinates z are such that |z|^2 is the square of a displacement over the surface, smoothed as the rule `natural` does,

    |z|^2 = w . A w,    A = U^T (M + l^2 K) U,

with areas M, stiffness K and the smoothing length l. There the Hessian of J is approximated from the slopes of the
designs that were solved, in their order, by BFGS with Powell's damping (Nocedal and Wright, Numerical Optimization,
procedure 18.2), which keeps it positive definite whatever the slopes are. It begins as (y.y / s.y) I of the first step
s with a positive curvature, y the change of the slope.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.moves import metrics
from rbfevo.recorded.objectives import uphill
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import EPS, Setup

DAMPED = 0.2  # of s.B s: the least that a step counts as the curvature along it
DOUBLINGS = 60  # of the shift that makes a step fit its bound
REFINED = 30  # bisections of its logarithm


class Coordinates:
    """The coordinates z [r] of a setup's weights [m, k], of those that displace anything.

    Args:
        record: the run; chosen: the setup.

    Raises:
        UserError: if the parameters of the setup reach less than its columns.
    """

    def __init__(self, record: Record, chosen: Setup) -> None:
        if chosen.representation.narrows:
            raise UserError(
                "the steps of a descent are those of all columns, of which points on the surface reach a part; take a "
                "run with manipulation=indirect"
            )
        self.shape = (chosen.count, record.gradient.shape[1])
        self._record, self._parts = record, []
        for components, columns, U, product in metrics(record, chosen):
            values, vectors = np.linalg.eigh((product + product.T) / 2.0)
            kept = values > len(values) * EPS * values.max()
            root = np.sqrt(values[kept])
            self._parts.append((np.ix_(columns, components), U, vectors[:, kept] * root, vectors[:, kept] / root))

    def of(self, weights: Array) -> Array:
        """z [r] of weights [m, k]."""
        return np.concatenate([(into.T @ weights[cells]).ravel() for cells, _, into, _ in self._parts])

    def weights(self, z: Array) -> Array:
        """The weights [m, k] of z [r]."""
        found, begin = np.zeros(self.shape), 0
        for cells, _, _, back in self._parts:
            shape = back.shape[1], found[cells].shape[1]
            found[cells] = back @ z[begin : begin + shape[0] * shape[1]].reshape(shape)
            begin += shape[0] * shape[1]
        return found

    def slope(self, slope: Array) -> Array:
        """The slope [r] by z of a slope [m, k] by weights."""
        return np.concatenate([(back.T @ slope[cells]).ravel() for cells, _, _, back in self._parts])

    def slope_of(self, record: Record) -> Array:
        """The slope [m, k] by weights of what the sensitivity of a record, before smoothing, makes rise: -J or J.

        In the unit of the objective, of which the record needs the size.
        """
        found, rising = np.zeros(self.shape), float(record.summary["gradient_norm"]) * uphill(record)
        for cells, U, _, _ in self._parts:
            found[cells] = -U.T @ rising[:, cells[1].ravel()]
        return found


def hessian(points: Sequence[Array], slopes: Sequence[Array]) -> Array | None:
    """The approximated Hessian [r, r] from points [r] and slopes [r]; None where no step has a positive curvature.

    Steps are those from each point to the next.
    """
    pairs = [(b - a, d - c) for (a, b), (c, d) in zip(_neighbours(points), _neighbours(slopes), strict=True)]
    sound = [float(y @ y) / float(s @ y) for s, y in pairs if float(s @ y) > 0.0]
    if not sound:
        return None
    B = sound[0] * np.eye(len(points[0]))
    for s, y in pairs:
        Bs = B @ s
        curved, own = float(s @ y), float(s @ Bs)
        if not own > 0.0:
            continue
        theta = 1.0 if curved >= DAMPED * own else (1.0 - DAMPED) * own / (own - curved)
        r = theta * y + (1.0 - theta) * Bs
        B = B - np.outer(Bs, Bs) / own + np.outer(r, r) / float(s @ r)
    return (B + B.T) / 2.0


def _neighbours(rows: Sequence[Array]) -> list[tuple[Array, Array]]:
    return list(itertools.pairwise(rows))


def bounded_step(B: Array, slope: Array, length: Callable[[Array], float], bound: float) -> Array:
    """The step [r] -(B + mu I)^-1 slope with the least mu >= 0 whose length does not exceed the bound.

    Args:
        B: [r, r] positive definite; slope: [r]; length: of a step, a norm.
    """
    values, vectors = np.linalg.eigh(B)
    pulled = vectors.T @ slope

    def step(mu: float) -> Array:
        return -vectors @ (pulled / (values + mu))

    found = step(0.0)
    if length(found) <= bound:
        return found
    low, high = 0.0, float(values.min())
    for _ in range(DOUBLINGS):
        if length(step(high)) <= bound:
            break
        low, high = high, 4.0 * high
    for _ in range(REFINED):
        middle = (low + high) / 2.0
        low, high = (low, middle) if length(step(middle)) <= bound else (middle, high)
    found = step(high)
    return found * min(1.0, bound / (length(found) or 1.0))


@dataclasses.dataclass(frozen=True)
class Value:
    """The predicted change of J by a change of the weights [m, k]: to first order, or by a quadratic model.

    Attributes:
        coordinates: of the weights; slope: [r] of J there; curvature: [r, r], or None.
    """

    coordinates: Coordinates
    slope: Array
    curvature: Array | None

    def __call__(self, change: Array) -> float:
        z = self.coordinates.of(change)
        bent = 0.0 if self.curvature is None else float(z @ self.curvature @ z)
        return float(self.slope @ z) + bent / 2.0

    def best_along(self, change: Array) -> Array:
        """The part of a change, at most all of it, that the model likes best; all of it without curvature."""
        if self.curvature is None:
            return change
        z = self.coordinates.of(change)
        bent = float(z @ self.curvature @ z)
        return change * (min(1.0, max(0.0, -float(self.slope @ z)) / bent) if bent > 0.0 else 1.0)

    def step(self, length: Callable[[Array], float], bound: float) -> Array:
        """The step [r] of `bounded_step`, where there is a curvature."""
        if self.curvature is None:
            raise ValueError("a quasi-Newton step needs a curvature")
        return bounded_step(self.curvature, self.slope, length, bound)
