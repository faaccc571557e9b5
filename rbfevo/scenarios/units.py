"""Ratios of units of length, to recognize files in different units."""

from __future__ import annotations

import math

FACTORS = (1e-3, 1.0 / 304.8, 1e-2, 1.0 / 39.3700787, 1.0 / 25.4, 25.4, 39.3700787, 100.0, 304.8, 1e3)


def nearest_unit(factor: float) -> float:
    """Return the ratio of two usual units of length (m, cm, mm, in, ft) that is nearest to a positive factor."""
    return min(FACTORS, key=lambda unit: abs(math.log(unit / factor)))
