"""NPY: a cloud as one array [q, 3] or [q, 2], written in its own precision."""

from __future__ import annotations

import io

import numpy as np

from rbfevo.arrays import Array
from rbfevo.meshes.mesh import FormatError, Mesh, written_as
from rbfevo.meshes.precision import narrowed


def read_npy(content: bytes) -> Mesh:
    """A cloud from an .npy file.

    Raises:
        FormatError: if it is not an array of real numbers [q, 2] or [q, 3].
    """
    array = np.load(io.BytesIO(content), allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] not in (2, 3) or array.dtype.kind != "f":
        raise FormatError("it does not hold floating-point numbers [q, 3] or [q, 2]")
    if not len(array):
        raise FormatError("there are no points in it")
    width, dtype = array.shape[1], array.dtype

    def rewritten(moved: Array) -> bytes:
        """The bytes of the file with moved points [n, 3]."""
        buffer = io.BytesIO()
        np.save(buffer, narrowed(moved[:, :width], dtype))
        return buffer.getvalue()

    points = np.zeros((len(array), 3))
    points[:, :width] = array
    return Mesh(points, written_as(rewritten), dimension=width)
