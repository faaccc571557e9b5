"""What a file with points and cells holds, whatever format it came in."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Triangles = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class Contents:
    """The points of a file, the triangles among them, and what is stored with them.

    Attributes:
        points: [n, 3] float64, all points of the file in its order and units.
        triangles: [f, 3] int64 into points; None where the file has no faces.
        arrays: numeric point arrays by name, float64, [n] or [n, c].
        cell_arrays: names of the arrays that belong to cells.
        notes: one line each for what was accepted but is worth a word.
    """

    points: Points
    triangles: Triangles | None
    arrays: dict[str, Points] = dataclasses.field(default_factory=dict)
    cell_arrays: tuple[str, ...] = ()
    notes: dict[str, str] = dataclasses.field(default_factory=dict)
