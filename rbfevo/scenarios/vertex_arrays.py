"""One number or vector for each vertex of a template: an array of its file, or a table in another file."""

from __future__ import annotations

import difflib
import re
import warnings
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.meshes.columns import Columns, Group, recognized
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.text_table import TextTable, read_table
from rbfevo.names import existing_home
from rbfevo.scenarios import matching
from rbfevo.scenarios.matching import Match
from rbfevo.scenarios.templates import Template

ENDINGS = (".csv", ".txt", ".npy", ".npz")


class VertexArray(NamedTuple):
    """Values [n] or [n, 3] of the vertices, how they were found, whether they are another mesh's, and their names.

    The names are that of the array, or of a file, without its ending, and the columns.
    """

    values: Array
    note: str
    other_mesh: bool = False
    names: tuple[str, ...] = ()


def vertex_array(source: str, template: Template, what: str, match: str = "exact", kind: str = "nodal") -> VertexArray:
    """Return the array of `scenario.{what}=source`, float64 [n] or [n, 3], a row for each vertex of the template.

    Args:
        source: the name of one of the template's point or cell arrays, or a file: CSV or TXT as `read_table` takes it,
            NPY, or NPZ (a single array, or the one named `what`). The rows of a table are matched to vertices by the
            coordinates in it, else by ids, else by their order; those of an array by their order: one for each of the
            file's points (`template.count`, of which `template.rows` are picked), for each vertex, or for each cell.
        template: the surface; what: the key below `scenario`, for messages.
        match: `exact`; `nearest` or `interpolate` take the values of another mesh, by the coordinates in the table.
        kind: the kind of the values of cells, as `matching.from_cells` takes it.

    Raises:
        UserError: if there is no such array or file, or it is unreadable, of the wrong length or number of columns,
            does not determine which value belongs to which vertex, or is not finite.
    """
    try:
        if source in template.arrays:
            return VertexArray(_fitting(template.arrays[source], template), f"point array {source}", names=(source,))
        if source in template.cell_arrays:
            found = _of_cells(template.cell_arrays[source], template, kind, f"cell array {source}")
            return found._replace(names=(source,))
        path = _file(source, template)
        found = _read(path, template, what, match, kind)
        return found._replace(names=(path.stem, *found.names))
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
    if there:
        raise UserError(f"unknown ending '{ending}'; give a file that ends in one of {_listed(ENDINGS)}")
    if ending in ENDINGS or "/" in source or "\\" in source:
        raise UserError("no such file" if not path.is_dir() else "it is a directory; give a file")
    names = sorted(template.arrays)
    close = difflib.get_close_matches(source, [*names, *template.cell_arrays], n=1)
    hint = f", did you mean '{close[0]}'?" if close else ";"
    known = f"its point arrays are {_listed(names)}" if names else "it has no point arrays"
    cells = f" (cell arrays: {_listed(template.cell_arrays)})" if template.cell_arrays else ""
    raise UserError(f"the mesh has no such array{hint} {known}{cells}; or give a file ({_listed(ENDINGS)})")


def _of_cells(values: Array, template: Template, kind: str, title: str) -> VertexArray:
    if (template.cell < 0).any():
        raise UserError(
            "it belongs to the cells of a volume mesh, of which only the boundary is used; convert it to point data "
            "first (ParaView: Cell Data to Point Data)"
        )
    how = {"nodal": "integrated over each cell, shared by its corners", "density": "per area", "marks": "marks"}[kind]
    bad = int((~np.isfinite(values)).reshape(len(values), -1).any(axis=1).sum())
    if bad:
        raise UserError(f"{bad} of {len(values)} cells have values that are not finite (NaN or infinite)")
    carried = matching.from_cells(values, template, kind)
    return VertexArray(_fitting(carried, template), f"{title}, {how}, carried to the vertices")


def _read(path: Path, template: Template, what: str, match: str, kind: str) -> VertexArray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's, about headers of other versions
            if path.suffix.lower() in (".npy", ".npz"):
                return _by_order(_numbers(_load(path, what)), template, kind)
            content = path.read_bytes()
            if not content.strip():
                raise UserError("the file is empty")
            table = read_table(content)
        return _of_table(table, template, what, match, kind)
    except UserError:
        raise
    except FormatError as error:
        raise UserError(f"not a readable {path.suffix[1:].upper()} file ({error})") from None
    except Exception as error:  # NumPy and zipfile raise many kinds of errors on a damaged file
        lines = str(error).strip().splitlines()
        reason = lines[0].strip()[:160] if lines else type(error).__name__
        raise UserError(f"not a readable {path.suffix[1:].upper()} file ({reason})") from None


def _load(path: Path, what: str) -> NDArray:
    if path.suffix.lower() == ".npy":
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    with zipfile.ZipFile(path) as archive:
        names = {entry.removesuffix(".npy"): entry for entry in archive.namelist() if entry.endswith(".npy")}
        name = what if what in names else next(iter(names), None)
        if name is None:
            raise UserError("it holds no array")
        if len(names) > 1 and name != what:
            raise UserError(
                f"it holds {len(names)} arrays, but none named '{what}': {_listed(names)}; rename the one to use"
            )
        with archive.open(names[name]) as file:
            return np.lib.format.read_array(file, allow_pickle=False)


def _numbers(values: NDArray) -> Array:
    if values.dtype.kind not in "fiub":
        raise UserError(f"its values are not real numbers (dtype {values.dtype})")
    return values.astype(np.float64)


def _by_order(values: Array, template: Template, kind: str) -> VertexArray:
    """Values in the order of the file's points, of the vertices or, where there are as many, of the cells."""
    _shaped(values)
    cells = int(template.cell.max(initial=-1)) + 1
    if len(values) not in (template.count, len(template.vertices)) and len(values) == cells:
        return _of_cells(values.reshape(cells) if values.shape[1:] == (1,) else values, template, kind, f"{cells} rows")
    found = matching.by_order(len(values), template)
    return VertexArray(_fitting(values[found.rows], template), found.note)


def _of_table(table: TextTable, template: Template, what: str, match: str, kind: str) -> VertexArray:
    """The values of a table, each at its vertex."""
    if table.header is None:
        columns, values = _without_header(table, template)
    else:
        columns = recognized(table.header)
        values = _chosen(table, columns, what).columns
    if not columns.coordinates and not columns.ids:
        found = _by_order(table.numbers(values), template, kind)
        note = "; ".join([_titled(table, values) + found.note, *table.notes])
        return found._replace(note=note, names=_columns(table, values))
    if columns.coordinates:
        axes = tuple(sorted(columns.coordinates))
        places = table.numbers([columns.coordinates[axis] for axis in axes])
        found = matching.by_coordinates(places, axes, columns.unit, template, match)
    else:
        found = _by_ids(table, columns, template)
    numbers = table.numbers(values)
    if numbers.shape[1] == 2:
        numbers = np.pad(numbers, ((0, 0), (0, 1)))
    other = match != "exact" and not found.note.startswith("rows ")
    bad = int((~np.isfinite(numbers)).any(axis=1).sum())
    if bad and found.places is not None:
        raise UserError(f"{bad} of its {len(numbers)} rows have values that are not finite (NaN or infinite)")
    carried = _fitting(matching.interpolated(numbers, found, template), template)
    note = "; ".join([_titled(table, values) + found.note, *table.notes])
    return VertexArray(carried, note, other, _columns(table, values))


def _columns(table: TextTable, values: tuple[int, ...]) -> tuple[str, ...]:
    return () if table.header is None else tuple(table.header[column] for column in values)


def _titled(table: TextTable, values: tuple[int, ...]) -> str:
    return "" if table.header is None else f"{', '.join(_columns(table, values))}: "


def _by_ids(table: TextTable, columns: Columns, template: Template) -> Match:
    """Rows by the first column of ids that holds the mesh's numbers."""
    problems = []
    for column in columns.ids:
        name = (table.header or {}).__getitem__(column) if table.header else f"column {column}"
        try:
            return matching.by_ids(table.numbers([column])[:, 0], name or "the first column", template)
        except UserError as error:
            problems.append(error)
    raise problems[0]


def _without_header(table: TextTable, template: Template) -> tuple[Columns, tuple[int, ...]]:
    """Coordinates, ids and values of a table without a header, if there is only one way to read it."""
    nothing = Columns({}, "", (), (), (), ())
    if table.width == 1:
        return nothing, (0,)
    numbers = table.numbers()
    like = matching.looks_like_coordinates(numbers, template)
    if table.width == 3:
        if len(like) == 3:
            raise UserError("it holds only the coordinates of the mesh and no values")
        if len(like) == 2:
            raise UserError(
                "its three columns have no names, and two of them are coordinates of the mesh; add a first line that "
                "names them, such as x,y,value"
            )
        return nothing, (0, 1, 2)
    first = numbers[:, 0]
    if table.width in (2, 4) and (first == np.round(first)).all() and len(np.unique(first)) == len(first):
        return Columns({}, "", (0,), (), (), ()), tuple(range(1, table.width))
    if table.width in (4, 6):
        return Columns({0: 0, 1: 1, 2: 2}, "", (), (), (), ()), tuple(range(3, table.width))
    raise UserError(
        f"it has {table.width} columns without names; add a first line that names them, such as x,y,z,value or id,value"
    )


def _chosen(table: TextTable, columns: Columns, what: str) -> Group:
    """The quantity of a table to use: that named `what`, or the only one."""
    names = table.header or []
    groups = [*columns.values, *columns.aside]
    if not groups:
        named = ", ".join(names)
        raise UserError(
            f"it holds only ids and coordinates ({named}) and no values; name the columns of a vector {what}_x, "
            f"{what}_y, {what}_z"
        )
    own = [group for group in groups if re.fullmatch(rf"{re.escape(what)}(?:[:_ .-]?[0-2xyz])?", group.name)]
    near = [group for group in columns.values if "sens" in group.name] if what == "sensitivity" else []
    candidates = own or near or list(columns.values) or groups
    related = [*candidates, *(group for group in near if group not in candidates)]
    if len(related) > 1:
        zero = [group for group in related if not table.numbers(group.columns).any()]
        if zero and len(zero) < len(related):
            full = [group for group in related if group not in zero]
            raise UserError(
                f"{_headings(zero, names)} is zero in every row, {_headings(full, names)} is not: which one should be "
                "used? Remove the other one"
            )
    vectors = [group for group in candidates if len(group.columns) > 1]
    candidates = vectors if (own or near) and len(vectors) == 1 else candidates
    if len(candidates) != 1:
        raise UserError(
            f"it has {len(candidates)} columns or vectors of values "
            f"({'; '.join(_headings([g], names) for g in candidates)}); "
            f"name the one to use {what} (or {what}_x, {what}_y, {what}_z), or remove the others"
        )
    return candidates[0]


def _headings(groups: list[Group], names: list[str]) -> str:
    return ", ".join(names[column] for group in groups for column in group.columns)


def _shaped(values: Array) -> None:
    """Raise UserError if values are not [r], [r, 1] or [r, 3]."""
    if values.ndim not in (1, 2) or (values.ndim == 2 and values.shape[1] not in (1, 3)):
        shape = " x ".join(str(side) for side in values.shape)
        shown = f"it has {values.shape[1]} columns" if values.ndim == 2 else f"it is of shape {shape or 'none'}"
        raise UserError(f"{shown}; give one number or a vector of three for each point")


def _fitting(values: Array, template: Template) -> Array:
    """Values of the vertices, [n] or [n, 3], all finite."""
    _shaped(values)
    n = len(template.vertices)
    bad = int((~np.isfinite(values)).reshape(n, -1).any(axis=1).sum())
    if bad:
        raise UserError(f"{bad} of {n} vertices have values that are not finite (NaN or infinite)")
    return np.ascontiguousarray(values.reshape(n) if values.ndim == 1 or values.shape[1] == 1 else values)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)
