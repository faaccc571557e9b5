"""Boxes in settings: six numbers, or two corners of three; null for an open side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rbfevo.arrays import Points
from rbfevo.errors import UserError

SHAPE = "a box is six numbers, [xmin,ymin,zmin,xmax,ymax,zmax], with null for an open side"


def is_box(value: Any) -> bool:
    """Whether a value is meant as a box: a list that begins with a number or null, or of two such lists."""
    if isinstance(value, str) or not isinstance(value, Sequence) or not len(value):
        return False
    first = value[0]
    if isinstance(first, Sequence) and not isinstance(first, str):
        return len(first) == 3
    return not isinstance(first, str)


def box_of(key: str, value: Any, other: str) -> tuple[Points, Points]:
    """The corners [3], [3] of the box that `scenario.{key}=value` gives, infinite at open sides.

    Args:
        other: what else the setting takes, for the message.

    Raises:
        UserError: if it is no box, or a lower side lies above its upper side.
    """
    sides = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else []
    if len(sides) == 2 and all(isinstance(corner, Sequence) for corner in sides):
        sides = [*sides[0], *sides[1]]
    numbers = all(side is None or (isinstance(side, int | float) and not isinstance(side, bool)) for side in sides)
    if len(sides) != 6 or not numbers:
        raise UserError(f"scenario.{key}={value}: {SHAPE}; {other}")
    low = np.array([-np.inf if side is None else float(side) for side in sides[:3]])
    high = np.array([np.inf if side is None else float(side) for side in sides[3:]])
    if np.isnan(low).any() or np.isnan(high).any() or (low > high).any():
        raise UserError(f"scenario.{key}={value}: a lower side lies above its upper side; {SHAPE}")
    return low, high
