"""NPY: a cloud as one array [q, 3] or [q, 2], or flat [3 q], written in its own precision and form."""

from __future__ import annotations

import io

import numpy as np

from rbfevo.arrays import Array
from rbfevo.meshes.mesh import FormatError, Mesh, written_as
from rbfevo.meshes.precision import narrowed


def read_npy(content: bytes) -> Mesh:
    """A cloud from an .npy file; a flat array has x, y, z of one point after another, as OpenMDAO and MPhys do.

    Raises:
        FormatError: if it is not an array of real numbers [q, 2], [q, 3] or [3 q].
    """
    array, notes = np.load(io.BytesIO(content), allow_pickle=False), {}
    flat = isinstance(array, np.ndarray) and array.ndim == 1 and len(array) % 3 == 0
    if flat:
        array = array.reshape(-1, 3)
        notes["flat"] = f"its flat array is x, y, z of {len(array)} points, one after another"
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.shape[1] not in (2, 3) or array.dtype.kind != "f":
        raise FormatError("it does not hold floating-point numbers [q, 3] or [q, 2], or flat x, y, z of q points")
    if not len(array):
        raise FormatError("there are no points in it")
    width, dtype = array.shape[1], array.dtype

    def rewritten(moved: Array) -> bytes:
        """The bytes of the file with moved points [n, 3]."""
        buffer = io.BytesIO()
        found = narrowed(moved[:, :width], dtype)
        np.save(buffer, found.reshape(-1) if flat else found)
        return buffer.getvalue()

    points = np.zeros((len(array), 3))
    points[:, :width] = array
    return Mesh(points, written_as(rewritten), dimension=width, notes=notes)
