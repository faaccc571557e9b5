"""The precision of the numbers of a file, and what does not fit in it."""

from __future__ import annotations

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError


def narrowed(points: Array, dtype: np.dtype) -> Array:
    """Points in the precision of their file.

    Raises:
        UserError: if they are too large for it.
    """
    with np.errstate(over="ignore"):
        narrow = points.astype(dtype)
    if not np.isfinite(narrow).all():
        raise UserError(f"the deformed points are too large for the {8 * dtype.itemsize}-bit numbers of the file")
    return narrow
