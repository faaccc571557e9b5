"""Tables of values that are no text: arrays of a VTK file's points, and NumPy arrays beside their coordinates."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbfevo import meshes
from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.meshes.array_table import ArrayTable, arrays_of
from rbfevo.scenarios.matching import AGREE
from rbfevo.scenarios.templates import Template

MESHES = meshes.VTK
PLACES = ("points", "coordinates", "x_aero0", "x_aero")  # names of coordinates in an NPZ file


def of_mesh(path: Path) -> ArrayTable:
    """The point arrays of a file that VTK reads, with the points' coordinates.

    Raises:
        UserError: if the file is unreadable, or has none.
    """
    with meshes.opened(path) as mesh:
        if not mesh.arrays:
            cells = f" (its cell arrays, {', '.join(mesh.cell_arrays)}, would have to be converted)"
            raise UserError(f"it has no point arrays{cells if mesh.cell_arrays else ''}")
        return arrays_of(mesh)


def numbers(values: NDArray) -> Array:
    """Real numbers as float64; UserError for others."""
    if values.dtype.kind not in "fiub":
        raise UserError(f"its values are not real numbers (dtype {values.dtype})")
    return values.astype(np.float64)


def load(path: Path, what: str, named: str = "") -> tuple[NDArray, NDArray | None]:
    """The array of an NPY or NPZ file, and coordinates beside it in an NPZ file, or None.

    Args:
        path: the file; what: the name of the array to use of several; named: the same, as the user gave it.

    Raises:
        UserError: if it is not clear which array is meant; many errors of NumPy and zipfile for damaged files.
    """
    if path.suffix.lower() == ".npy":
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False), None
    with zipfile.ZipFile(path) as archive:
        names = {entry.removesuffix(".npy"): entry for entry in archive.namelist() if entry.endswith(".npy")}
        if named and named not in names:
            raise UserError(f"it holds no array {named}; there are {', '.join(names)}")
        wanted = named or what
        places = next((name for name in PLACES if name in names and name != wanted and len(names) > 1), None)
        others = [name for name in names if name != places]
        name = wanted if wanted in names else next(iter(others), None)
        if name is None:
            raise UserError("it holds no array")
        if len(others) > 1 and name != wanted:
            raise UserError(
                f"it holds {len(others)} arrays, but none named '{what}': {', '.join(others)}; rename the one to use"
            )

        def array(entry: str) -> NDArray:
            with archive.open(names[entry]) as file:
                return np.lib.format.read_array(file, allow_pickle=False)

        return array(name), None if places is None else array(places)


def flattened(values: Array, template: Template) -> Array:
    """Values in the order of points; x, y, z of one point after another, as MPhys has them, become [r, 3].

    Raises:
        UserError: if one number for each point or cell fits as well as three.
    """
    if values.ndim != 1:
        return values
    n, cells = len(template.vertices), int(template.cell.max(initial=-1)) + 1
    three = [count for count in dict.fromkeys((template.count, n)) if len(values) == 3 * count]
    one = [
        what for what, count in (("points", template.count), ("vertices", n), ("cells", cells)) if len(values) == count
    ]
    if three and one:
        raise UserError(
            f"its {len(values)} numbers may be one for each of the mesh's {one[0]}, or x, y, z for each of {three[0]} "
            f"points; save it as an array [{len(values)}, 1] or [{three[0]}, 3]"
        )
    return values.reshape(-1, 3) if three else values


def beside_points(values: Array, points: Array, what: str, template: Template, kind: str) -> ArrayTable:
    """The table of values [r], [r, k] or flat [3 r], and the coordinates of their points, [r, 3] or flat [3 r].

    Solvers repeat points that processes or patches share. Moving the point moves all of them, so the derivatives of
    the rows add up; values per area are the same in all of them.

    Raises:
        UserError: if the arrays do not fit, or repeated rows cannot be put together.
    """
    if points.ndim == 1 and len(points) % 3 == 0:
        points = points.reshape(-1, 3)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise UserError(f"its coordinates are of shape {list(points.shape)}; give [r, 3], or flat x, y, z")
    if values.ndim == 1 and len(values) == 3 * len(points):
        values = values.reshape(-1, 3)
    if values.ndim not in (1, 2) or len(values) != len(points):
        raise UserError(f"its values are of shape {list(values.shape)}, but there are {len(points)} coordinates")
    notes = []
    unequal, place = np.unique(points, axis=0, return_inverse=True)
    place = place.reshape(-1)
    if len(unequal) < len(points) and not _in_order(points, template):
        if "coincident vertices" in template.notes:
            raise UserError(
                f"{len(points) - len(unequal)} of its points repeat others, and so do vertices of the template; give "
                "one row for each vertex, in their order"
            )
        points, values = unequal, _together(values, place, len(unequal), kind)
        how = "their values are summed" if kind == "nodal" else "each counts once"
        notes.append(f"{len(place) - len(unequal)} of {len(place)} points repeat others: {how}")
    return ArrayTable.of(points, {what: values}, notes)


def _together(values: Array, place: Array, count: int, kind: str) -> Array:
    """Values of rows at the same place as one row each."""
    rows = values.reshape(len(values), -1)
    if kind == "nodal":
        sums = np.zeros((count, rows.shape[1]))
        np.add.at(sums, place, rows)
        return sums.reshape(count, *values.shape[1:])
    first = np.unique(place, return_index=True)[1]
    if kind == "density" and not np.allclose(rows, rows[first][place], rtol=1e-6, atol=0.0):
        raise UserError("points repeat others with different values per area; give one row for each point")
    if kind == "marks":
        marks = np.zeros((count, rows.shape[1]))
        np.maximum.at(marks, place, np.abs(rows))
        return marks.reshape(count, *values.shape[1:])
    return values[first]


def _in_order(points: Array, template: Template) -> bool:
    """Whether points are those of the template, in its order."""
    allowed = AGREE * float(np.ptp(template.vertices, axis=0).max())
    for rows, count in ((template.rows, template.count), (slice(None), len(template.vertices))):
        if len(points) == count and np.abs(points[rows] - template.vertices).max() <= allowed:
            return True
    return False
