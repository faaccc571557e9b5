"""Local errors: lengths of the wanted displacement and of residuals, in plain NumPy from the files of a run."""

from __future__ import annotations

import numpy as np

from rbfevo.arrays import Array
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import BLOCK, setup

__all__ = ["BLOCK", "local_error", "reached"]


def reached(record: Record, index: int) -> Array:
    """Return U U^+ g [n, k], the part of the gradient that setup `index` can follow (paper, eq. 8).

    Rows count with the square root of their weight in the fit, not in the result. Direct and indirect manipulation span
    the same space, so U = Phi serves both.

    Raises:
        UserError: if summary.json names a kernel or a symmetry that is not known here.
    """
    chosen = setup(record, index)
    return chosen.displacement(record.vertices, chosen.fit(record, BLOCK), BLOCK)


def local_error(displacement: Array) -> Array:
    """Return the row norms [n] of a displacement [n, k]."""
    return np.linalg.norm(displacement, axis=1)
