"""Largest displacements, of all steps together."""

from __future__ import annotations

import numpy as np

from rbfevo.arrays import Array
from rbfevo.recorded.setup import EPS


def factor(most: Array | None, start: Array, change: Array) -> float:
    """The largest factor, at most 1, of a change [n, k] with which no vertex moves farther than it may.

    Args:
        most: [n] how far each vertex may move at most from the original design, None without bounds.
        start: [n, k] the displacement before.
    """
    moving = change.any(axis=1)
    if most is None or not moving.any():
        return 1.0
    a, b = (change[moving] ** 2).sum(axis=1), (start[moving] * change[moving]).sum(axis=1)
    c = np.maximum(most[moving] ** 2 - (start[moving] ** 2).sum(axis=1), 0.0)
    root = np.sqrt(b**2 + a * c)
    largest = np.where(b > 0.0, c / np.where(b > 0.0, b + root, 1.0), (root - b) / a)  # without cancellation
    return min(1.0, float(largest.min()) * (1.0 - 4.0 * EPS))
