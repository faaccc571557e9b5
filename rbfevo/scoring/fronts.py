"""What is chosen of a front of regularity and improvement potential: formulas for NumPy and torch."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbfevo.arrays import Array


def preferred(preference: Any, objectives: Any) -> Any:
    """f = preference R + (1 - preference) P of objectives [..., 2], maximized (paper, eq. 9)."""
    return preference * objectives[..., 0] + (1.0 - preference) * objectives[..., 1]


def knee_of(front: Array) -> int:
    """Place of the knee on a front [q, 2], maximized: farthest from the chord between its two ends.

    Both axes are scaled to [0, 1] first; the distance counts on either side of the chord. Equal distances (within
    1e-12) go to the lowest place: so do a front of one point, its duplicates, and a front of two.
    """
    spread = np.ptp(front, axis=0)
    scaled = (front - front.min(axis=0)) / np.where(spread > 0, spread, 1.0)
    distance = np.abs(scaled.sum(axis=1) - 1.0)  # from the chord (0, 1) - (1, 0), times sqrt(2)
    return int(np.flatnonzero(distance >= distance.max() - 1e-12)[0])
