"""What is chosen of a front of regularity and improvement potential, and of numbers of centers: for NumPy and torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rbfevo.arrays import Array

ENOUGH = 0.95  # of the largest gain, which the smallest number of centers has to reach


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


def enough_of(numbers: Sequence[int], gains: Sequence[float]) -> int | None:
    """The smallest number of centers whose gain reaches `ENOUGH` of the largest; None where nothing gains anything.

    A gain is the square root of a potential: what the best step gains, as a share of what all vertices free would.
    """
    largest = max((gain for gain in gains if gain > 0.0), default=None)
    if largest is None:
        return None
    return min(number for number, gain in zip(numbers, gains, strict=True) if gain >= ENOUGH * largest)
