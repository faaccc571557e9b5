"""The best approximation of a run's wanted displacement by one setup."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup


class Move(NamedTuple):
    """The wanted displacement and its best approximation by a setup, k components.

    Attributes:
        wanted, reached: [n, k] at the vertices; weights: [m, k]; centers: [m, k] displacements of the centers.
        direction: whether only the direction was given, so that the size is that of `--step`.
    """

    wanted: Array
    reached: Array
    weights: Array
    centers: Array
    direction: bool


def wanted_move(record: Record, chosen: Setup, step: float) -> Move:
    """The least-squares best approximation of the wanted displacement.

    Where only a direction is known it is scaled until a vertex moves by `step` times the diagonal of the template's
    bounding box, and none moves farther.
    """
    direction = record.summary.get("gradient_is") == "direction" or record.gradient_norm is None
    scale, weights = record.gradient_norm or 1.0, chosen.best(record)
    wanted, reached = record.gradient * scale, chosen.displacement(record.vertices, weights)
    if direction:
        farthest = float(np.linalg.norm(reached, axis=1).max())
        farthest = farthest if farthest > 1e-9 * np.linalg.norm(wanted, axis=1).max() else 0.0
        diagonal = float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
        factor = step * diagonal / (farthest or float(np.linalg.norm(wanted, axis=1).max()) or 1.0)
        wanted, reached, weights = factor * wanted, factor * reached, factor * weights
    centers = np.zeros_like(weights) if chosen.kernel is None else chosen.displacement(chosen.centers, weights)
    if chosen.mirror is not None and chosen.crosses(centers.shape[1]):
        centers[chosen.on_plane, chosen.mirror.axis] = 0.0  # exactly, without rounding errors
    return Move(wanted, reached, weights, centers, direction)


def places_of(chosen: Setup) -> Array:
    """Where each parameter acts [m, d]: the centers; NaN of a representation whose control points are not those."""
    if chosen.kernel is not None:
        return chosen.centers
    return np.full((chosen.count, chosen.centers.shape[1]), np.nan)


def spatial(rows: Array) -> Array:
    """Rows [q, k] of a displacement or of points with three components: one component is a height, z."""
    k = rows.shape[1]
    full = np.zeros((len(rows), 3))
    full[:, 2 if k == 1 else slice(0, k)] = rows[:, 0] if k == 1 else rows
    return full
