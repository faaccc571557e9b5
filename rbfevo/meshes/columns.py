"""What the columns of a table are by their names: coordinates, ids, vectors and single values, with their units."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence

_UNIT = re.compile(r"\s*[\[(]\s*(?P<unit>[^\[\]()]*?)\s*[\])]\s*$")
_COMPONENT = re.compile(r"(?P<stem>.*?)\s*(?:\[\s*(?P<index>[ijkxyz012])\s*\]|[:_ .-]?(?P<letter>[xyz012]))$")
_PLACE = r"(?:points?|coord(?:inate)?s?|positions?|locations?)"
_COORDINATE = re.compile(
    rf"(?P<a>[xyz])|(?P<b>[xyz])[_ -]?{_PLACE}|{_PLACE}[:_ .-]?\[?(?P<c>[xyz])\]?|{_PLACE}[:_ .-]\[?(?P<d>[012])\]?"
)
_ID = re.compile(
    r"(?:(?:global|point|node|vertex|vtk ?original ?point)s?[ _-]?)?(?:ids?|index|indices|numbers?|labels?|no\.?|nr\.?)"
    r"|nodes?|vertex|vertices|#|unnamed: 0|"
)
_MAYBE_ID = re.compile(r"points?")  # SU2's name of its ids; others have values of a point in it
_CELL_ID = re.compile(r"(?:cell|element|face)s?[ _-]?(?:ids?|index|indices|numbers?|labels?|no\.?|nr\.?)")
_ASIDE = re.compile(r"(?:normals?|area|face ?normal)[:_ .-]?[xyz012]?|n[xyz]|(?:.*[:_ ])?(?:magnitude|area)")


@dataclasses.dataclass(frozen=True)
class Group:
    """One quantity of a table: its name, and its columns: one, three for x, y and z, or two in a table of x and y."""

    name: str
    columns: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Columns:
    """The columns of a table by what they are.

    Attributes:
        coordinates: column of x, y and z (0, 1, 2) for those that are there; unit: theirs, "" where none is named.
        ids: columns with numbers of vertices; cell_ids: with numbers of cells.
        values: the other quantities, in the order of their first columns; aside: areas, normals and magnitudes, which
            are taken for values only where they are asked for by name.
        doubtful: columns whose name may be that of ids, or of values: what is in them tells (`quantities.settled`).
    """

    coordinates: dict[int, int]
    unit: str
    ids: tuple[int, ...]
    cell_ids: tuple[int, ...]
    values: tuple[Group, ...]
    aside: tuple[Group, ...]
    doubtful: tuple[int, ...] = ()


def recognized(header: Sequence[str]) -> Columns:
    """Tell what columns are by their names, in any case, with or without units."""
    names, units = [], []
    for name in header:
        found = _UNIT.search(name)
        index = found is not None and found["unit"].lower() in ("i", "j", "k", "x", "y", "z", "0", "1", "2")
        units.append(found["unit"] if found and not index else "")
        names.append((name[: found.start()] if found and not index else name).strip().lower())
    coordinates: dict[int, int] = {}
    ids, cell_ids, doubtful, others = [], [], [], []
    for column, name in enumerate(names):
        axis = _axis(name)
        if axis is not None and axis not in coordinates:
            coordinates[axis] = column
        elif _ID.fullmatch(name):
            ids.append(column)
        elif _CELL_ID.fullmatch(name):
            cell_ids.append(column)
        elif _MAYBE_ID.fullmatch(name):
            doubtful.append(column)
        else:
            others.append(column)
    groups = _groups(names, others, {0, 1} if set(coordinates) == {0, 1} else {0, 1, 2})
    return Columns(
        coordinates,
        next((units[column] for column in coordinates.values() if units[column]), ""),
        tuple(ids),
        tuple(cell_ids),
        tuple(group for group in groups if not _ASIDE.fullmatch(group.name)),
        tuple(group for group in groups if _ASIDE.fullmatch(group.name)),
        tuple(doubtful),
    )


def _axis(name: str) -> int | None:
    """0, 1 or 2 if a column's name is that of the points' x, y or z."""
    found = _COORDINATE.fullmatch(name)
    if not found:
        return None
    return "xyz012".index(next(part for part in found.groups() if part)) % 3


def _groups(names: Sequence[str], columns: Sequence[int], axes: set[int]) -> list[Group]:
    """Vectors (three columns whose names differ in x, y, z or 0, 1, 2 or i, j, k) and single values."""
    stems: dict[str, dict[int, int]] = {}
    for column in columns:
        found = _COMPONENT.fullmatch(names[column])
        if found:
            letter = found["index"] or found["letter"]
            axis = "xyz012ijk".index(letter) % 3
            stems.setdefault(found["stem"] + ("" if letter in "xyz" else ":"), {}).setdefault(axis, column)
    vectors = {stem: parts for stem, parts in stems.items() if set(parts) == axes}
    within = {column for parts in vectors.values() for column in parts.values()}
    found = [Group(stem.rstrip(":"), tuple(parts[axis] for axis in sorted(axes))) for stem, parts in vectors.items()]
    found += [Group(names[column], (column,)) for column in columns if column not in within]
    return sorted(found, key=lambda group: group.columns[0])
