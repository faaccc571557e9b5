"""One number or vector for each vertex of a template: an array of its file, or a table in another file."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.meshes.array_table import Table
from rbfevo.meshes.columns import Columns, recognized
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.text_table import read_table
from rbfevo.names import existing_home, file_and_name
from rbfevo.scenarios import matching, quantities, vertex_tables
from rbfevo.scenarios.matching import Match
from rbfevo.scenarios.templates import Template

ENDINGS = (".csv", ".txt", ".npy", ".npz")


class VertexArray(NamedTuple):
    """Values [n] or [n, 3] of the vertices, how they were found, whether they are another mesh's, and their names.

    The names are that of the array, or of a file, without its ending, and the columns. `beside` [n] is the component
    along a normal that SU2 writes beside a vector, or None.
    """

    values: Array
    note: str
    other_mesh: bool = False
    names: tuple[str, ...] = ()
    beside: Array | None = None


def vertex_array(source: str, template: Template, what: str, match: str = "exact", kind: str = "nodal") -> VertexArray:
    """Return the array of `scenario.{what}=source`, float64 [n] or [n, 3], a row for each vertex of the template.

    Args:
        source: the name of one of the template's point or cell arrays, or a file: CSV or TXT as `read_table` takes it,
            NPY, NPZ (a single array, or the one named `what`; coordinates beside it are named `points`), or a file
            that VTK reads; `FILE:NAME` picks one of its quantities. The rows of a table are matched to vertices by ids
            whose coordinates agree, else by coordinates, else by ids alone, else by their order; those of an array by
            their order: one for each of the file's points (`template.count`, of which `template.rows` are picked), for
            each vertex, or for each cell.
        template: the surface; what: the key below `scenario`, for messages.
        match: `exact`; `nearest` or `interpolate` take the values of another mesh, by the coordinates in the table.
        kind: the kind of the values of cells, as `matching.from_cells` takes it.

    Raises:
        UserError: if there is no such array or file, or it is unreadable, of the wrong length or number of columns,
            does not determine which value belongs to which vertex, or is not finite.
    """
    try:
        if source in template.arrays:
            values = _fitting(template.arrays[source], template)
            scalar = next((name for name in template.arrays if name.lower() == quantities.SCALAR), source)
            beside = (
                template.arrays[scalar] if scalar != source and values.ndim == 2 and "sens" in source.lower() else None
            )
            return VertexArray(values, f"point array {source}", names=(source,), beside=beside)
        if source in template.cell_arrays:
            found = _of_cells(template.cell_arrays[source], template, kind, f"cell array {source}")
            return found._replace(names=(source,))
        path, named = _file(source, template)
        found = _read(path, template, what, match, kind, named)
        return found._replace(names=(path.stem, *found.names))
    except UserError as error:
        raise UserError(f"scenario.{what}={source}: {error}") from None


def _file(source: str, template: Template) -> tuple[Path, str]:
    """The file that is meant, and the name of one of its quantities, if one is given."""
    text, named = file_and_name(source)
    path = existing_home(text)
    ending = path.suffix.lower()
    try:
        there = path.is_file()
    except (OSError, ValueError):
        there = False
    if there and ending in (*ENDINGS, *vertex_tables.MESHES):
        return path, named
    if there:
        raise UserError(
            f"unknown ending '{ending}'; give a file that ends in one of {_listed((*ENDINGS, *vertex_tables.MESHES))}"
        )
    if ending in (*ENDINGS, *vertex_tables.MESHES) or "/" in source or "\\" in source:
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


def _read(path: Path, template: Template, what: str, match: str, kind: str, named: str) -> VertexArray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's, about headers of other versions
            if path.suffix.lower() in vertex_tables.MESHES:
                return _of_table(vertex_tables.of_mesh(path), template, what, match, kind, named)
            if path.suffix.lower() in (".npy", ".npz"):
                loaded, places = vertex_tables.load(path, what, named)
                values = vertex_tables.numbers(loaded)
                if places is None:
                    return _by_order(vertex_tables.flattened(values, template), template, kind)
                table = vertex_tables.beside_points(values, vertex_tables.numbers(places), what, template, kind)
                return _of_table(table, template, what, match, kind, named and what)
            content = path.read_bytes()
            if not content.strip():
                raise UserError("the file is empty")
            table = read_table(content)
        return _of_table(table, template, what, match, kind, named)
    except UserError:
        raise
    except FormatError as error:
        raise UserError(f"not a readable {path.suffix[1:].upper()} file ({error})") from None
    except Exception as error:  # NumPy and zipfile raise many kinds of errors on a damaged file
        lines = str(error).strip().splitlines()
        reason = lines[0].strip()[:160] if lines else type(error).__name__
        raise UserError(f"not a readable {path.suffix[1:].upper()} file ({reason})") from None


def _by_order(values: Array, template: Template, kind: str) -> VertexArray:
    """Values in the order of the file's points, of the vertices or, where there are as many, of the cells."""
    _shaped(values)
    cells = int(template.cell.max(initial=-1)) + 1
    if len(values) not in (template.count, len(template.vertices)) and len(values) == cells:
        return _of_cells(values.reshape(cells) if values.shape[1:] == (1,) else values, template, kind, f"{cells} rows")
    found = matching.by_order(len(values), template)
    return VertexArray(_fitting(values[found.rows], template), found.note)


def _of_table(table: Table, template: Template, what: str, match: str, kind: str, named: str) -> VertexArray:
    """The values of a table, each at its vertex."""
    beside: tuple[int, ...] = ()
    remarks = list(table.notes)
    if table.header is None:
        columns, values = _without_header(table, template)
    else:
        columns = quantities.settled(recognized(table.header), table, template)
        group = quantities.chosen(table, columns, what, named)
        values, beside = group.columns, quantities.beside(columns, group)
        remarks += quantities.remarks(table, columns, group)
    if not columns.coordinates and not columns.ids:
        found = _by_order(table.numbers(values), template, kind)
        note = "; ".join([_titled(table, values) + found.note, *remarks])
        return found._replace(note=note, names=_columns(table, values))
    found = _matched(table, columns, template, match)
    numbers = table.numbers(values)
    if numbers.shape[1] == 2:
        numbers = np.pad(numbers, ((0, 0), (0, 1)))
    other = match != "exact" and not found.note.startswith("rows ")
    bad = int((~np.isfinite(numbers)).any(axis=1).sum())
    if bad and found.places is not None:
        raise UserError(f"{bad} of its {len(numbers)} rows have values that are not finite (NaN or infinite)")
    carried = _fitting(matching.interpolated(numbers, found, template), template)
    note = "; ".join([_titled(table, values) + found.note, *remarks])
    scalar = table.numbers(beside)[found.rows, 0] if beside and not other else None
    return VertexArray(carried, note, other, _columns(table, values), scalar)


def _columns(table: Table, values: tuple[int, ...]) -> tuple[str, ...]:
    return () if table.header is None else tuple(table.header[column] for column in values)


def _titled(table: Table, values: tuple[int, ...]) -> str:
    return "" if table.header is None else f"{', '.join(_columns(table, values))}: "


def _matched(table: Table, columns: Columns, template: Template, match: str) -> Match:
    """Which row belongs to which vertex: by ids that coordinates confirm, else by coordinates, else by ids."""
    names = table.header or ["the first column", *[""] * table.width]
    if not columns.coordinates:
        problems = []
        for column in columns.ids:
            try:
                return matching.by_ids(table.numbers([column])[:, 0], names[column] or "the first column", template)
            except UserError as error:
                problems.append(error)
        raise problems[0]
    axes = tuple(sorted(columns.coordinates))
    places = table.numbers([columns.coordinates[axis] for axis in axes])
    for column in columns.ids:
        try:
            ids = table.numbers([column])[:, 0]
        except FormatError:  # names, which coordinates do not need
            continue
        found = matching.by_ids_and_coordinates(ids, names[column] or "column without a name", places, axes, template)
        if found is not None:
            return found
    return matching.by_coordinates(places, axes, columns.unit, template, match)


def _without_header(table: Table, template: Template) -> tuple[Columns, tuple[int, ...]]:
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
