"""What the cells of a mesh are by their kinds: flat ones become triangles, solid ones have a boundary and a volume.

Kinds are VTK's numbers (vtkCellType.h), whatever format the file has. Second-order cells count by their corners, which
come first among their points.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes import polygons
from rbfevo.meshes.faces import alike, corners_of, within
from rbfevo.meshes.mesh import Cells, Faces, FormatError

TRIANGLES, QUADS = (5, 22, 34, 69, 76), (9, 23, 28, 30, 70, 77)
STRIP, POLYGON, PIXEL, CURVED_POLYGON = 6, 7, 8, 36
FLAT = (*TRIANGLES, *QUADS, STRIP, POLYGON, PIXEL, CURVED_POLYGON)
LINES = (3, 4, 21, 35, 68, 75)
POINTS = (0, 1, 2)
SOLIDS = {
    "tetrahedra": (10, 24, 71, 78),
    "voxels": (11,),
    "hexahedra": (12, 25, 29, 33, 72, 79),
    "wedges": (13, 26, 31, 32, 73, 80),
    "pyramids": (14, 27, 37, 74, 81),
    "prisms": (15, 16),
    "polyhedra": (41, 42),
}
UNKNOWN = 255
_CURVED = tuple(kind for kind in (*FLAT, *(k for kinds in SOLIDS.values() for k in kinds)) if kind > 20 and kind != 42)
_CORNERS = {
    **dict.fromkeys(TRIANGLES, 3),
    **dict.fromkeys((*QUADS, PIXEL), 4),
    **dict.fromkeys(SOLIDS["tetrahedra"], 4),
    **dict.fromkeys((*SOLIDS["voxels"], *SOLIDS["hexahedra"]), 8),
    **dict.fromkeys(SOLIDS["wedges"], 6),
    **dict.fromkeys(SOLIDS["pyramids"], 5),
    15: 10,
    16: 12,
}
# The faces of solids, in VTK's order of corners, normals outwards.
_FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetrahedra": ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
    "voxels": ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6)),
    "hexahedra": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedges": ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    "pyramids": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}


class Surface(NamedTuple):
    """Triangles [f, 3] of flat cells, and the cell [f] that each is a part of."""

    triangles: Ints
    cell: Ints


def check(cells: Cells, count: int) -> None:
    """Refuse cells that cannot be: corners that are not among `count` points, or fewer of them than their kind needs.

    Raises:
        FormatError: with a count.
    """
    if len(cells.kinds) != len(cells.sizes) or (cells.sizes < 0).any() or cells.sizes.sum() != len(cells.corners):
        raise FormatError("its cells are damaged")
    needed = np.zeros(256, np.int64)
    for kind, corners in _CORNERS.items():
        needed[kind] = corners
    few = int((cells.sizes < needed[cells.kinds]).sum())
    if few:
        raise FormatError(f"damaged: {few} of its {len(cells)} cells have fewer corners than their kind needs")
    wrong = (cells.corners < 0) | (cells.corners >= count)
    if wrong.any():
        cell = np.searchsorted(np.cumsum(cells.sizes), np.flatnonzero(wrong), side="right")
        raise FormatError(
            f"{len(np.unique(cell))} of its {len(cells)} faces or cells refer to a point that is not there: the first "
            f"to vertex {int(cells.corners[wrong][0])} (from 0), but there are {count} vertices"
        )


def counts(cells: Cells) -> dict[str, int]:
    """How many cells there are of each name: triangles, quadrilaterals, polygons, lines, and the solids by name."""
    of = np.bincount(cells.kinds, minlength=256)
    kinds_of = {
        "triangles": TRIANGLES,
        "quadrilaterals": (*QUADS, PIXEL),
        "polygons": (POLYGON, CURVED_POLYGON),
        "strips": (STRIP,),
        **SOLIDS,
        "lines": LINES,
        "points": POINTS[1:],
    }
    found = {name: int(of[list(kinds)].sum()) for name, kinds in kinds_of.items()}
    found["cells of an unknown kind"] = int(of.sum() - of[0] - sum(found.values()))
    return {name: count for name, count in found.items() if count}


def solids(cells: Cells) -> dict[str, int]:
    """How many cells fill a volume, by name."""
    return {name: count for name, count in counts(cells).items() if name in SOLIDS}


def curved(cells: Cells) -> int:
    """How many flat or solid cells are of second or higher order."""
    return int(np.isin(cells.kinds, _CURVED).sum())


def surface(points: Array, cells: Cells, chosen: Ints | None = None) -> Surface:
    """Cut the flat cells (those `chosen`, or all) into triangles, in the order of the cells.

    Raises:
        FormatError: with the number of polygons that cross themselves.
    """
    flat = np.isin(cells.kinds, FLAT)
    if chosen is not None:
        mask = np.zeros(len(cells), bool)
        mask[chosen] = True
        flat &= mask
    index = np.flatnonzero(flat)
    kinds, sizes = cells.kinds[index], cells.sizes[index].copy()
    starts = (np.cumsum(cells.sizes) - cells.sizes)[index]
    sizes[kinds == CURVED_POLYGON] //= 2
    for members, count in ((TRIANGLES, 3), ((*QUADS, PIXEL), 4)):
        sizes[np.isin(kinds, members)] = count
    strips = kinds == STRIP
    place = np.repeat(starts[~strips], sizes[~strips]) + within(sizes[~strips])
    corners = cells.corners[place]
    ends = np.cumsum(sizes[~strips])
    pixels = (ends - 4)[kinds[~strips] == PIXEL]  # their corners run 0 1 3 2 about them
    corners[pixels + 2], corners[pixels + 3] = corners[pixels + 3], corners[pixels + 2].copy()
    try:
        cut, owner = polygons.triangles(points, sizes[~strips], corners)
    except ValueError as error:
        raise FormatError(str(error)) from None
    owner = index[~strips][owner]
    if strips.any():
        strip, own = _strips(starts[strips], sizes[strips], cells.corners)
        cut, owner = np.concatenate([cut, strip]), np.concatenate([owner, index[strips][own]])
        order = np.argsort(owner, kind="stable")
        cut, owner = cut[order], owner[order]
    return Surface(cut, owner)


def _strips(starts: Ints, sizes: Ints, corners: Ints) -> tuple[Ints, Ints]:
    """Strips as triangles turned the way of the first, and the strip of each."""
    each = np.maximum(sizes - 2, 0)
    strip, step = np.repeat(np.arange(len(each)), each), within(each)
    first, odd = starts[strip] + step, step % 2
    return np.stack([corners[first], corners[first + 1 + odd], corners[first + 2 - odd]], axis=1), strip


def faces_of(cells: Cells) -> Faces:
    """All faces of the solid cells, by their corners, those between two cells once for each.

    Raises:
        FormatError: if there are solids whose faces are not known here.
    """
    found = solids(cells)
    others = {name: count for name, count in found.items() if name not in _FACES and name != "polyhedra"}
    if others:
        listed = ", ".join(f"{count} {name}" for name, count in others.items())
        raise FormatError(f"holds a volume mesh with {listed}, whose boundary is not taken here; extract its surface")
    cell, sizes, corners = ([np.empty(0, np.int64)] for _ in range(3))
    for name in found:
        for face in _FACES.get(name, ()):
            own = _solid_corners(cells, name)[:, face]
            cell.append(np.flatnonzero(np.isin(cells.kinds, SOLIDS[name])))
            sizes.append(np.full(len(own), own.shape[1]))
            corners.append(own.reshape(-1))
    for part, more in zip((cell, sizes, corners), cells.faces or (), strict=False):
        part.append(more)
    return Faces(np.concatenate(cell), np.concatenate(sizes), np.concatenate(corners))


def boundary(cells: Cells) -> Cells:
    """The faces of solid cells that belong to one of them only, as polygons with their normals outwards.

    Raises:
        FormatError: if there are solids whose faces are not known here.
    """
    faces = faces_of(cells)
    number = alike(faces.sizes, faces.corners)
    return polygons_of(faces.sizes, faces.corners, np.flatnonzero(np.bincount(number)[number] == 1))


def polygons_of(sizes: Ints, corners: Ints, chosen: Ints) -> Cells:
    """Some of several faces, with the corners of each one after another, as polygons."""
    return Cells(np.full(len(chosen), POLYGON, np.uint8), sizes[chosen], corners_of(sizes, corners, chosen))


def _solid_corners(cells: Cells, name: str) -> Ints:
    """Corners [c, k] of all solids of a name, in VTK's order of their kind."""
    index = np.flatnonzero(np.isin(cells.kinds, SOLIDS[name]))
    starts = (np.cumsum(cells.sizes) - cells.sizes)[index]
    return cells.corners[starts[:, None] + np.arange(_CORNERS[SOLIDS[name][0]])]


class Volumes(NamedTuple):
    """Signed volumes [c] of the solid cells of one name before and after a move, and the move's largest sound share."""

    name: str
    before: Array
    after: Array
    share: float


def volumes(points: Array, moved: Array, cells: Cells) -> list[Volumes]:
    """The signed volumes of solid cells before and after a move, for each name of them.

    A volume is that within the cell's faces, quadrilaterals as bilinear patches [divergence theorem]. Along the way
    from `points` to `moved` it is a cubic polynomial, whose first root is how far all cells keep their sign.
    """
    found = []
    for name in solids(cells):
        if name in _FACES:
            corners = _solid_corners(cells, name)
            volume = functools.partial(_volume, corners=corners, name=name)
        elif name == "polyhedra" and cells.faces is not None:
            volume = functools.partial(_polyhedra, faces=cells.faces, side=_sides(points, cells.faces))
        else:
            continue
        steps = [volume(points + share * (moved - points)) for share in (0.0, 1 / 3, 2 / 3, 1.0)]
        before, after = steps[0], steps[-1]
        share = 1.0
        for index in np.flatnonzero((before != 0) & (before * after <= 0)):
            cubic = np.polynomial.polynomial.polyfit([0.0, 1 / 3, 2 / 3, 1.0], [step[index] for step in steps], 3)
            roots = np.polynomial.polynomial.polyroots(cubic)
            real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
            share = min(share, float(real.min(initial=1.0)))
        found.append(Volumes(name, before, after, share))
    return found


def _pyramids(points: Array, faces: Faces) -> Array:
    """Signed volumes [f] of the pyramids between the faces of polyhedra and the middles of their cells."""
    cell = np.unique(faces.cell, return_inverse=True)[1]
    place = points[faces.corners]
    face = np.repeat(np.arange(len(faces.sizes)), faces.sizes)

    def means(of: Ints, values: Array) -> Array:
        """The means [g, 3] of the values [k, 3] of each of the groups `of` [k]."""
        sums = np.stack([np.bincount(of, column) for column in values.T], axis=1)
        return sums / np.bincount(of)[:, None]

    apex = means(cell[face], place)[cell]
    middle = means(face, place) - apex
    starts = np.cumsum(faces.sizes) - faces.sizes
    behind = starts[face] + (within(faces.sizes) + 1) % np.repeat(faces.sizes, faces.sizes)
    own, other = place - apex[face], place[behind] - apex[face]
    parts = np.einsum("ij,ij->i", middle[face], np.cross(own, other)) / 6.0
    return np.bincount(face, parts, minlength=len(faces.sizes))


def _sides(points: Array, faces: Faces) -> Array:
    """[f] 1 or -1: the winding of each face, which files do not promise, seen from the middle of its cell."""
    return np.where(_pyramids(points, faces) < 0, -1.0, 1.0)


def _polyhedra(points: Array, faces: Faces, side: Array) -> Array:
    cell = np.unique(faces.cell, return_inverse=True)[1]
    return np.bincount(cell, side * _pyramids(points, faces))


def _volume(points: Array, corners: Ints, name: str) -> Array:
    """Signed volumes [c]: a third of the flow of x - x0 through the faces."""
    place = points[corners]
    place = place - place.mean(axis=1, keepdims=True)  # so that nothing cancels far from the origin
    total = np.zeros(len(corners))
    for face in _FACES[name]:
        own = place[:, face]
        if len(face) == 3:
            total += np.einsum("ij,ij->i", own[:, 0], np.cross(own[:, 1], own[:, 2])) / 6.0
            continue
        # A bilinear patch: the mean of its two cuts into triangles.
        for a, b, c in ((0, 1, 2), (0, 2, 3), (0, 1, 3), (1, 2, 3)):
            total += np.einsum("ij,ij->i", own[:, a], np.cross(own[:, b], own[:, c])) / 12.0
    return total
