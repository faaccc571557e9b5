"""One number or vector for each vertex of a template: an array of its file, or a table of the user's own."""

from __future__ import annotations

import difflib
import re
import warnings
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbfevo.errors import UserError
from rbfevo.names import existing_home
from rbfevo.scenarios.tables import Table, read_table
from rbfevo.scenarios.templates import Template

Array = NDArray[np.float64]

ENDINGS = (".csv", ".txt", ".npy", ".npz")

_COORDINATE = re.compile(
    r"(?:(?:points?|coord(?:inate)?s?)[:_ .-]?)?([xyz])|(?:points?|coord(?:inate)?s?)[:_ .-]([0-2])"
)
_ID = re.compile(r"(?:(?:point|node|vertex|cell)s?[ _-]?)?(?:ids?|index|indices|no\.?|nr\.?)|node|vertex|#")
_MAGNITUDE = re.compile(r".*[:_ ]magnitude")
_COORDINATES_AGREE = 1e-4  # of the extent: spreadsheets often hold six digits


def vertex_array(source: str, template: Template, what: str) -> Array:
    """Return the array of `scenario.{what}=source`, float64 [n] or [n, 3], a row for each vertex of the template.

    Args:
        source: the name of one of `template.arrays`, or a file: CSV or TXT (commas, semicolons or space; columns that
            the header calls ids or coordinates are not taken), NPY, or NPZ (a single array, or the one named `what`).
            A row for each of the file's points (`template.count`, of which `template.rows` are picked) or one for each
            vertex.
        template: the surface; what: the key below `scenario`, for messages.

    Raises:
        UserError: if there is no such array or file, or it is unreadable, of the wrong length or number of columns, in
            another order than the points, or not finite.
    """
    try:
        if source in template.arrays:
            return _fitting(template.arrays[source], None, template)
        return _fitting(_read(_file(source, template), template, what), template.rows, template)
    except UserError as error:
        raise UserError(f"scenario.{what}={source}: {error}") from None


def _file(source: str, template: Template) -> Path:
    path = existing_home(source)
    ending = path.suffix.lower()
    try:
        there = path.is_file()
    except (OSError, ValueError):
        there = False
    if there and ending in ENDINGS:
        return path
    if source in template.cell_arrays:
        raise UserError("is a cell array; convert it to point data first (ParaView: Cell Data to Point Data)")
    if there:
        raise UserError(f"unknown ending '{ending}'; a file with a row for each vertex can be {_listed(ENDINGS)}")
    if ending in ENDINGS or "/" in source or "\\" in source:
        raise UserError("no such file" if not path.is_dir() else "is a directory; give a file")
    names = sorted(template.arrays)
    close = difflib.get_close_matches(source, names, n=1)
    hint = f", did you mean '{close[0]}'?" if close else ";"
    known = f"its point arrays are {_listed(names)}" if names else "it has no point arrays"
    cells = f" (cell arrays, to be converted to point data first: {_listed(template.cell_arrays)})"
    raise UserError(
        f"the mesh has no such point array{hint} {known}{cells if template.cell_arrays else ''}; "
        f"or give a file ({_listed(ENDINGS)})"
    )


def _read(path: Path, template: Template, what: str) -> Array:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's, about headers of other versions
            if path.suffix.lower() in (".npy", ".npz"):
                return _numbers(_load(path, what))
            content = path.read_bytes()
            if not content.strip():
                raise UserError("the file is empty")
            return _columns(read_table(content), template, what)
    except UserError:
        raise
    except Exception as error:  # NumPy and zipfile raise whatever they like on a damaged file
        lines = str(error).strip().splitlines()
        said = lines[0].strip()[:160] if lines else type(error).__name__
        raise UserError(f"not a readable {path.suffix[1:].upper()} file ({said})") from None


def _load(path: Path, what: str) -> NDArray:
    if path.suffix.lower() == ".npy":
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    with zipfile.ZipFile(path) as archive:
        names = {entry.removesuffix(".npy"): entry for entry in archive.namelist() if entry.endswith(".npy")}
        name = what if what in names else next(iter(names), None)
        if name is None:
            raise UserError("there is no array in it")
        if len(names) > 1 and name != what:
            raise UserError(f"it holds {len(names)} arrays, none named '{what}': {_listed(names)}; name one so")
        with archive.open(names[name]) as file:
            return np.lib.format.read_array(file, allow_pickle=False)


def _numbers(values: NDArray) -> Array:
    if values.dtype.kind not in "fiub":
        raise UserError(f"its entries are no real numbers (dtype {values.dtype})")
    return values.astype(np.float64)


def _columns(table: Table, template: Template, what: str) -> Array:
    """The columns of a table that are neither ids nor coordinates, once these are known to agree with the mesh."""
    if table.header is None:
        return table.numbers()
    names = table.header
    ids = [k for k, name in enumerate(names) if _ID.fullmatch(name)]
    axes = {axis: k for k, name in enumerate(names) if (axis := _axis(name)) is not None}
    others = [k for k in range(len(names)) if k not in ids and k not in axes.values()]
    if not others:
        if len(axes) != 3 or any(names[k].startswith("point") for k in axes.values()):
            raise UserError("it holds only ids and coordinates, no values")
        others, axes = [axes[axis] for axis in range(3)], {}
    for k in ids:
        numbers = table.numbers((k,))[:, 0]
        if (np.diff(numbers) <= 0).any():
            raise UserError(f"its '{names[k]}' column does not ascend; give the rows in the order of the mesh's points")
    if len(axes) == 3:
        _check_coordinates(table.numbers([axes[axis] for axis in range(3)]), template)

    own = [k for k in others if re.fullmatch(rf"{re.escape(what)}(?:[:_ .-]?[0-2xyz])?", names[k])]
    if len(others) not in (1, 3):
        others = own or [k for k in others if not _MAGNITUDE.fullmatch(names[k])]
    if len(others) not in (1, 3):
        raise UserError(
            f"it has {len(others)} columns of values ({_listed([names[k] for k in others])}); "
            f"1 or 3 are wanted, or name them {what}"
        )
    return table.numbers(others)


def _axis(name: str) -> int | None:
    """0, 1 or 2 if a column's name says that it is the x, y or z of the points."""
    found = _COORDINATE.fullmatch(name)
    return "xyz012".index(found[1] or found[2]) % 3 if found else None


def _check_coordinates(points: Array, template: Template) -> None:
    """Refuse a table whose points are not those of the mesh, as when its rows were sorted."""
    picked = points
    if len(points) == template.count:
        picked = points[template.rows]
    if picked.shape != template.vertices.shape:
        return  # the number of rows is told soon
    allowed = _COORDINATES_AGREE * np.ptp(template.vertices, axis=0).max()
    off = ~(np.abs(picked - template.vertices).max(axis=1) <= allowed)
    if off.any():
        raise UserError(
            f"its coordinates differ from the mesh's at {int(off.sum())} of {len(off)} vertices; give the rows in the "
            "order of the mesh's points (or leave the coordinates out)"
        )


def _fitting(values: Array, rows: NDArray[np.int64] | None, template: Template) -> Array:
    """The rows of the vertices, [n] or [n, 3], all finite; `rows` is None where they are already picked."""
    n = len(template.vertices)
    if values.ndim not in (1, 2) or (values.ndim == 2 and values.shape[1] not in (1, 3)):
        shape = " x ".join(str(side) for side in values.shape)
        said = f"it has {values.shape[1]} columns" if values.ndim == 2 else f"it is of shape {shape or 'none'}"
        raise UserError(f"{said}; one number or a vector of three for each point is wanted")
    if rows is not None:
        if len(values) == template.count:
            values = values[rows]
        elif len(values) != n:
            wanted = f"{template.count} points" + (f" ({n} of them in triangles)" if n != template.count else "")
            raise UserError(f"it has {len(values)} rows, but the mesh has {wanted}; give one row for each point")
    bad = int((~np.isfinite(values)).reshape(n, -1).any(axis=1).sum())
    if bad:
        raise UserError(f"{bad} of {n} vertices have values that are not finite (NaN or infinite)")
    return np.ascontiguousarray(values.reshape(n) if values.ndim == 1 or values.shape[1] == 1 else values)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
