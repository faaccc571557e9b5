"""Which row of a table belongs to which vertex: by coordinates, ids or order."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Ints
from rbfevo.errors import UserError
from rbfevo.geometry.curves import segment_lengths
from rbfevo.geometry.triangles import triangle_areas
from rbfevo.meshes.numbered import places_of
from rbfevo.scenarios.templates import Template
from rbfevo.scenarios.units import nearest_unit

MATCHES = ("exact", "nearest", "interpolate")
AGREE = 1e-4  # of the template's longest side: spreadsheets often hold six digits
FAR = 0.2  # of the same: rows that lie farther away do not belong to the same surface
_NEIGHBOURS = 8


class Match(NamedTuple):
    """The row [n] of each vertex; `places` [r, 3] if values are interpolated instead; a note on how rows were found."""

    rows: Ints
    places: Array | None
    note: str


def by_order(count: int, template: Template) -> Match:
    """Rows in the order of the file's points, or of the vertices.

    Raises:
        UserError: if there are not as many of them.
    """
    n = len(template.vertices)
    if count == template.count:
        return Match(template.rows, None, "rows in the order of the mesh's points")
    if count == n:
        return Match(np.arange(n), None, "rows in the order of the mesh's vertices")
    wanted = f"{template.count} points" + (f" ({n} of them in triangles)" if n != template.count else "")
    cells = f" and {len(np.unique(template.cell))} cells" if len(template.cell) else ""
    raise UserError(
        f"it has {count} rows, but the mesh has {wanted}{cells}; give one row for each point, or add columns x, y, z "
        "to match rows by coordinates"
    )


def by_ids(ids: Array, name: str, template: Template) -> Match:
    """Rows by the numbers of the mesh's points: the file's own, or else from 0 or from 1.

    Raises:
        UserError: if a number is there twice, or the numbers are not the mesh's.
    """
    if (ids != np.round(ids)).any():
        raise UserError(f"its column '{name}' must hold ids of points, but not all of its numbers are whole")
    twice = len(ids) - len(np.unique(ids))
    if twice:
        raise UserError(f"its column '{name}' holds {twice} ids more than once")
    found = {}
    for title, numbers in _numberings(template).items():
        rows, there = places_of(numbers, ids)
        if there.all():
            found[title] = rows
    if found:
        if len(found) > 1 and len(ids) != template.count:
            raise UserError(
                f"its column '{name}' may number the mesh's {template.count} points from 0 or from 1; add columns "
                "x, y, z, or give exactly one row for each point"
            )
        title, rows = next(iter(found.items()))
        return Match(rows, None, f"rows by '{name}', {title}")
    known = template.numbers if template.numbers is not None else np.array([0, template.count - 1])
    raise UserError(
        f"its column '{name}' ({ids.min():.0f} to {ids.max():.0f}, {len(ids)} rows) does not hold the numbers of the "
        f"mesh's points ({known.min()} to {known.max()}"
        + ("" if template.numbers is not None else f", or 1 to {template.count}")
        + "); remove the column if the rows are in the order of the points, or add columns x, y, z"
    )


def _numberings(template: Template) -> dict[str, Ints]:
    """What the numbers [n] of the vertices may be, by a title: the file's own, or else from 0 or from 1."""
    if template.numbers is not None:
        return {"the file's numbers of its points": template.numbers[template.rows]}
    return {f"from {first}": template.rows + first for first in (0, 1)}


def by_ids_and_coordinates(
    ids: Array, name: str, places: Array, axes: tuple[int, ...], template: Template
) -> Match | None:
    """Rows by numbers of the mesh's points where coordinates confirm them; None where they are other numbers.

    Args:
        ids: [r]; name: of their column; places: [r, k] coordinates; axes: which they are, of 0, 1, 2.
    """
    if not (ids == np.round(ids)).all() or len(np.unique(ids)) != len(ids):
        return None
    vertices = template.vertices[:, list(axes)]
    best, note = None, ""
    off = AGREE * float(np.ptp(template.vertices, axis=0).max())
    for title, numbers in _numberings(template).items():
        rows, there = places_of(numbers, ids)
        apart = float(np.abs(places[rows] - vertices).max()) if there.all() else np.inf
        if apart <= off:  # points may be closer to each other than the tolerance: the better numbering counts
            best, off, note = rows, apart, f"rows by '{name}', {title}, coordinates agree to {apart:.2g}"
    return None if best is None else Match(best, None, note)


def by_coordinates(places: Array, axes: tuple[int, ...], unit: str, template: Template, match: str) -> Match:
    """Rows by coordinates: exactly (in any order, with extra rows), or the nearest ones of another mesh.

    Args:
        places: [r, k] coordinates; axes: which they are, of 0, 1, 2; unit: theirs, as the header names it.
        match: `exact`, `nearest` or `interpolate`.

    Raises:
        UserError: if a vertex has no row of its own, with the distance of the nearest.
    """
    from scipy.spatial import KDTree

    bad = int((~np.isfinite(places)).any(axis=1).sum())
    if bad:
        raise UserError(f"{bad} of its {len(places)} rows have coordinates that are not finite")
    extent = float(np.ptp(template.vertices, axis=0).max())
    allowed = AGREE * extent
    across = [axis for axis in range(3) if axis not in axes]
    if len(axes) == 2 and not np.ptp(template.vertices[:, across]):  # a curve in a plane needs no third coordinate
        places = np.insert(places, across[0], template.vertices[0, across[0]], axis=1)
        axes = (0, 1, 2)
    vertices = template.vertices[:, list(axes)]
    for rows in (template.rows, np.arange(len(vertices))):
        if len(places) == (template.count if rows is template.rows else len(vertices)):
            off = np.abs(places[rows] - vertices).max()
            if off <= allowed:
                return Match(rows, None, f"rows in the order of the mesh, coordinates agree to {off:.2g}")
    found: Any = KDTree(places).query(vertices)
    distance, nearest = found
    if len(axes) == 3 and (distance <= allowed).all():
        first = np.unique(nearest, return_index=True)[1]
        shared = np.ones(len(nearest), bool)
        shared[first] = False
        owner = np.full(len(places), -1)
        owner[nearest[first]] = first
        apart = np.abs(vertices[owner[nearest]] - vertices).max(axis=1) > 0
        if not (shared & apart).any():
            return Match(
                nearest, None, f"rows by coordinates, the farthest {distance.max():.2g} away (tolerance {allowed:.2g})"
            )
        raise UserError(
            f"its coordinates have too few digits: {int((shared & apart).sum())} vertices share their nearest row"
        )
    _ask_about_units(places, vertices, unit)
    if len(axes) == 3 and match != "exact":
        if distance.max() > FAR * extent:
            raise UserError(
                f"a vertex is {distance.max():.3g} away from the nearest row (the template's longest side is "
                f"{extent:.3g}): the rows are not of the same surface, or of a part of it only"
            )
        note = f"largest distance {distance.max():.3g}, mean {distance.mean():.3g} (longest side {extent:.3g})"
        if match == "nearest":
            return Match(nearest, None, f"nearest rows: {note}")
        return Match(nearest, places, f"interpolated between {min(_NEIGHBOURS, len(places))} nearest rows: {note}")
    off = distance > allowed
    if len(axes) < 3:
        raise UserError(
            f"it has {len(axes)} of three coordinates, and its rows are not in the order of the mesh; add the others"
        )
    raise UserError(
        f"its coordinates differ from the mesh's: {int(off.sum())} of {len(off)} vertices have no row within "
        f"{allowed:.2g} (the largest distance is {distance.max():.3g}); for values of another mesh of the same "
        "surface, set scenario.sensitivity_match=nearest or interpolate"
    )


def _ask_about_units(places: Array, vertices: Array, unit: str) -> None:
    """Raise UserError if the coordinates are the mesh's in another unit."""
    its, mine = (float(np.linalg.norm(np.ptp(points, axis=0))) for points in (places, vertices))
    if its <= 0 or mine <= 0:
        return
    factor = nearest_unit(its / mine)
    if abs(math.log(factor * mine / its)) < 0.02:
        named = f" (its header says {unit})" if unit else ""
        raise UserError(
            f"its coordinates are {factor:.6g} times the mesh's{named}: another unit? Multiply its columns x, y, z by "
            f"{1.0 / factor:.6g}, and check the unit of its values"
        )


def interpolated(values: Array, match: Match, template: Template) -> Array:
    """Values [n] or [n, k] at the vertices from those of a table's rows [r] or [r, k].

    Between rows, by linear radial basis functions of the nearest ones, which keep the rows' own values.
    """
    if match.places is None:
        return values[match.rows]
    from scipy.interpolate import RBFInterpolator

    places, first = np.unique(match.places, axis=0, return_index=True)
    neighbours = min(_NEIGHBOURS, len(places))
    return RBFInterpolator(places, values[first], neighbors=neighbours, kernel="linear", degree=0)(template.vertices)


def from_cells(values: Array, template: Template, kind: str) -> Array:
    """Values of the template's cells [c] or [c, k], carried to its vertices [n] or [n, k].

    Args:
        kind: `nodal`: integrated over a cell, each of whose corners takes its share; `density`: per area, of which a
            vertex takes the mean by areas; `marks`: a vertex of a marked cell is marked.
    """
    parts, n = (template.segments if template.curve else template.triangles), len(template.vertices)
    measure = segment_lengths if template.curve else triangle_areas
    sizes, corners = measure(template.vertices, parts), parts.shape[1]
    rows = values[template.cell].reshape(len(parts), -1)
    if kind == "marks":
        weights = np.ones(len(sizes))
        rows = np.abs(rows)
    elif kind == "nodal":
        weights = sizes / np.bincount(template.cell, sizes, minlength=len(values))[template.cell] / corners
    else:
        weights = sizes / corners
    corner = parts.reshape(-1)
    carried = np.stack(
        [np.bincount(corner, np.repeat(weights * column, corners), minlength=n) for column in rows.T], axis=1
    )
    if kind == "density":
        carried /= np.bincount(corner, np.repeat(weights, corners), minlength=n)[:, None]
    return carried.reshape(n) if values.ndim == 1 else carried


def looks_like_coordinates(columns: Array, template: Template) -> NDArray[np.int64]:
    """Which columns of a table [r, k] without a header are, row by row, the mesh's x, y or z."""
    found = []
    for rows, count in ((template.rows, template.count), (np.arange(len(template.vertices)), len(template.vertices))):
        if len(columns) != count:
            continue
        allowed = AGREE * float(np.ptp(template.vertices, axis=0).max())
        for column in range(columns.shape[1]):
            if any(
                np.abs(columns[rows, column] - template.vertices[:, axis]).max() <= allowed
                and np.ptp(template.vertices[:, axis]) > allowed
                for axis in range(3)
            ):
                found.append(column)
    return np.unique(np.array(found, np.int64))
