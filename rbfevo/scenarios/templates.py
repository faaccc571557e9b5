"""Read a user's template: a surface or a curve, and the arrays of its points and cells."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Ints, Points, Triangles
from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.geometry.curves import segment_lengths
from rbfevo.meshes import cells, opened
from rbfevo.meshes.lines import Lines, lines_of
from rbfevo.meshes.mesh import Meaning, Mesh
from rbfevo.meshes.surface import Surface, patch_cells, patch_points
from rbfevo.names import existing_home
from rbfevo.scenarios.reading import checked_extent, surface

_ROUNDING = 4.0 * np.finfo(np.float64).eps


@dataclasses.dataclass(frozen=True)
class Template:
    """A surface of n vertices and f triangles, or a curve of s segments, in the file's units and order.

    Attributes:
        vertices: [n, 3] float64, the file's points that belong to a triangle with an area, or to a segment.
        triangles: [f, 3] int64 into vertices; each has an area.
        arrays: numeric point arrays by name, float64, [n] or [n, c].
        rows: [n] int64, ascending: which of the file's points each vertex is (STL: after merging).
        count: points in the file (STL: after merging).
        notes: a line for each oddity that was accepted, by title.
        cell_arrays: numeric arrays of the file's cells by name, [c] or [c, k].
        cell: [f] or [s] int64, the cell that each triangle or segment is a part of; -1 on the boundary of a volume.
        numbers: [count] the file's own numbers of its points, where the format has them.
        patch_types: the solver's type of each patch, by name, where the format has it; meanings: what is known of
            sensitivities among the arrays, by name.
        patch_points: (setting, names) -> the points [h, 3] of some of them, a
            UserError that names the setting for a name that there is not.
        patches: the names of the file's patches.
        segments: [s, 2] int64 into vertices, of a curve, which has no triangles; each has a length.
    """

    vertices: Points
    triangles: Triangles
    arrays: dict[str, Points]
    rows: NDArray[np.int64]
    count: int
    notes: dict[str, str]
    cell_arrays: dict[str, Array] = dataclasses.field(default_factory=dict)
    cell: NDArray[np.int64] = dataclasses.field(default_factory=lambda: np.empty(0, np.int64))
    numbers: NDArray[np.int64] | None = None
    patches: tuple[str, ...] = ()
    patch_points: Callable[[str, Sequence[str]], Points] = lambda setting, names: np.empty((0, 3))
    patch_types: dict[str, str] = dataclasses.field(default_factory=dict)
    meanings: dict[str, Meaning] = dataclasses.field(default_factory=dict)
    segments: Ints = dataclasses.field(default_factory=lambda: np.empty((0, 2), np.int64))

    @property
    def curve(self) -> bool:
        """Whether it is a curve."""
        return len(self.segments) > 0


def read_template(path: str | Path, patches: Sequence[str] | None = None, curves: bool = False) -> Template:
    """Read a surface with faces, in any of the formats of `rbfevo.meshes` but for clouds.

    Polygons are cut into triangles; of a mesh that fills a volume, the boundary is taken; triangles without an area,
    repeated triangles and points that belong to no triangle are left out, and exactly equal vertices of an STL file are
    merged, each with a note. Vertices that coincide in other formats stay as they are.

    Args:
        path: the file; patches: names of patches (markers, groups, sets) to take, None for all.
        curves: whether a file may hold a curve: line cells without faces, or beside those of a mesh in one plane.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, or holds no usable surface: a cloud, a
            curve where none is expected, or faces without area or with coordinates that are not finite.
    """
    path = existing_home(path)
    with opened(path) as mesh:
        pass
    lines = curve_of(path, mesh, patches) if curves else None
    return template_of(path, mesh, surface(path, mesh, patches)) if lines is None else curve_template(path, mesh, lines)


def curve_of(path: Path, mesh: Mesh, patches: Sequence[str] | None = None) -> Lines | None:
    """The curve of a mesh: the lines of its patches if these have no faces, or all lines of a mesh in one plane.

    Raises:
        UserError: if there is no such patch.
    """
    try:
        lines = lines_of(mesh, patches)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    if not len(lines.segments) or cells.solids(mesh.cells):
        return None
    faces = np.isin(mesh.cells.kinds, cells.FLAT)
    if patches:
        members = np.zeros(len(faces), bool)
        members[patch_cells(mesh, patches)] = True
        return None if (faces & members).any() else lines
    used = np.unique(mesh.cells.corners)
    return lines if not faces.any() or topology.flat(mesh.points[used]) else None


def curve_template(path: Path, mesh: Mesh, lines: Lines) -> Template:
    """The template that lines of a mesh make: segments without a length and repeated ones are left out, with a note.

    Raises:
        UserError: if no segment is left, or vertices have coordinates that are not finite.
    """
    segments, notes = lines.segments, mesh.notes | lines.notes
    _refuse_not_finite(path, mesh.points, np.unique(segments), "lines")
    extent = checked_extent(path, mesh.points[np.unique(segments)])
    kept = segment_lengths(mesh.points / extent, segments) > _ROUNDING
    kept[kept] &= _first_rows(np.sort(segments[kept], axis=1))[0]
    if not kept.any():
        raise UserError(f"{path}: none of its {len(segments)} lines has any length")
    if not kept.all():
        notes["dropped lines"] = f"{int((~kept).sum())} of {len(kept)} lines have no length or repeat another"
    nothing = np.empty((0, 3), np.int64)
    return _numbered(mesh, mesh.points, nothing, lines.cell[kept], notes, "line", segments[kept])


def template_of(path: Path, mesh: Mesh, found: Surface) -> Template:
    """The template that a file's mesh makes with a surface of it, as `read_template` describes it.

    Raises:
        UserError: if the surface is not usable.
    """
    points, triangles, notes = mesh.points, found.triangles, mesh.notes | found.notes
    if not len(triangles):
        raise UserError(f"{path}: {_without_faces(mesh)}")
    cell = np.full(len(triangles), -1) if found.cell is None else found.cell
    if path.suffix.lower() == ".stl":
        notes["merged vertices"] = f"{len(points)} points of the STL file, equal ones merged"
        points, triangles = _merged(points, triangles)
        notes["merged vertices"] += f": {len(points)} vertices"

    kept = _with_area(path, points, triangles)
    if not kept.any():
        raise UserError(f"{path}: none of its {len(triangles)} triangles has any area")
    if not kept.all():
        notes["dropped triangles"] = f"{int((~kept).sum())} of {len(kept)} triangles have no area and are left out"
        triangles, cell = triangles[kept], cell[kept]
    kept = _first_of_equal(triangles)
    if not kept.all():
        notes["repeated triangles"] = f"{int((~kept).sum())} triangles repeat another one and are left out"
        triangles, cell = triangles[kept], cell[kept]

    return _numbered(mesh, points, triangles, cell, notes, "triangle", np.empty((0, 2), np.int64))


def _numbered(
    mesh: Mesh, points: Points, triangles: Triangles, cell: Ints, notes: dict[str, str], part: str, segments: Ints
) -> Template:
    """The template of triangles or segments of points, whose vertices are the points in these."""
    used = np.zeros(len(points), bool)
    used[triangles] = used[segments] = True
    rows = np.flatnonzero(used)
    if len(rows) < len(points):
        notes["unused points"] = f"{len(points) - len(rows)} of {len(points)} points are in no {part} and are left out"
    vertices = points[rows]
    coincident = len(vertices) - int(_first_rows(vertices)[0].sum())
    if coincident:
        notes["coincident vertices"] = f"{coincident} vertices coincide with others; each is counted separately"
    renumbered = np.cumsum(used) - 1
    return Template(
        vertices,
        renumbered[triangles],
        {name: values[rows] for name, values in mesh.arrays.items()},
        rows,
        len(points),
        notes,
        mesh.cell_arrays,
        cell,
        mesh.numbers,
        tuple(mesh.patches),
        lambda setting, names: mesh.points[patch_points(mesh, names, setting)],
        patch_types=mesh.patch_types,
        meanings=mesh.meanings,
        segments=renumbered[segments],
    )


def _without_faces(mesh: Mesh) -> str:
    """Why a mesh has no surface, and what to do."""
    lines = cells.counts(mesh.cells).get("lines", 0)
    if lines:
        return (
            f"it holds a curve ({lines} lines) and no faces: set scenario.planar=z (or x, y), the axis across its "
            "plane, to deform the curve, or give a surface"
        )
    return f"it holds {len(mesh.points)} points but no faces (a cloud, or damaged?); give a surface mesh"


def _with_area(path: Path, points: Points, triangles: Triangles) -> NDArray[np.bool_]:
    """[f] True where a triangle's height exceeds the rounding of its corners' coordinates."""
    a, b, c = triangles.T
    kept = (a != b) & (b != c) & (c != a)
    used = np.unique(triangles[kept])
    if used.size == 0:
        return kept
    _refuse_not_finite(path, points, used, "triangles")
    scaled = points / checked_extent(path, points[used])  # so that no square overflows or underflows
    sound = np.flatnonzero(kept)
    corners = scaled[triangles[sound]]
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.sqrt((edges**2).sum(axis=2).max(axis=1))
    doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    kept[sound] = doubled > _ROUNDING * longest * (longest + np.abs(corners).max(axis=(1, 2)))
    return kept


def _refuse_not_finite(path: Path, points: Points, used: Ints, parts: str) -> None:
    bad = int((~np.isfinite(points[used])).any(axis=1).sum())
    if bad:
        raise UserError(
            f"{path}: {bad} of {len(used)} vertices of its {parts} have coordinates that are not finite "
            "(NaN or infinite)"
        )


def _first_of_equal(triangles: Triangles) -> NDArray[np.bool_]:
    """[f] False where a triangle has the corners of an earlier one, turned the same way."""
    start = np.argmin(triangles, axis=1)
    turned = np.take_along_axis(triangles, (start[:, None] + np.arange(3)) % 3, axis=1)
    return _first_rows(turned)[0]


def _first_rows(table: NDArray) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """[r] True at the first of equal rows [r, 3], and [r] the index of that first one."""
    order = np.lexsort(table.T[::-1])  # stable: of equal rows the first comes first
    ordered = table[order]
    new = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])
    first = np.empty(len(table), np.int64)
    first[order] = order[np.maximum.accumulate(np.where(new, np.arange(len(table)), 0))]
    return first == np.arange(len(table)), first


def _merged(points: Points, triangles: Triangles) -> tuple[Points, Triangles]:
    """Merge exactly equal points, in the order in which they first appear."""
    kept, first = _first_rows(points)
    renumbered = np.cumsum(kept) - 1
    return points[kept], renumbered[first[triangles]]
