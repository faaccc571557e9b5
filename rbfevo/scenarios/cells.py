"""Cells of a mesh become triangles; cells that fill a volume are counted and refused.

Kinds of cells are VTK's numbers (vtkCellType.h), whatever format the file has.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbfevo.errors import UserError

Ints = NDArray[np.int64]

_TRIANGLES, _QUADS, _POLYGON, _CURVED_POLYGON, _PIXEL, _STRIP = (
    (5, 22, 34, 69, 76),
    (9, 23, 28, 30, 70, 77),
    7,
    36,
    8,
    6,
)
_FLAT = (*_TRIANGLES, *_QUADS, _POLYGON, _CURVED_POLYGON, _PIXEL, _STRIP)
_CURVED = tuple(kind for kind in _FLAT if kind > 9)
_VOLUMES = {
    "tetrahedra": (10, 24, 71, 78),
    "voxels": (11,),
    "hexahedra": (12, 25, 29, 33, 72, 79),
    "wedges": (13, 26, 31, 32, 73, 80),
    "pyramids": (14, 27, 37, 74, 81),
    "prisms": (15, 16),
    "polyhedra": (41, 42),
}
_IGNORED = (0, 1, 2, 3, 4, 21, 35, 68, 75)  # nothing, vertices, lines


def triangles(path: Path, n: int, kinds: NDArray[np.uint8], sizes: Ints, corners: Ints) -> tuple[Ints, dict[str, str]]:
    """Cut the flat cells among `kinds` [c] into triangles [f, 3]; return them and notes.

    Args:
        path: the file, for messages.
        n: number of points.
        kinds: VTK's number of each cell's kind; vertices and lines are passed over.
        sizes: [c] corners of each cell; corners: all of them, one cell after another.

    Raises:
        UserError: if a cell fills a volume, is of an unknown kind, or refers to a point that is not there.
    """
    counts = np.bincount(kinds, minlength=256)
    solids = {name: int(counts[list(numbers)].sum()) for name, numbers in _VOLUMES.items()}
    if any(solids.values()):
        listed = ", ".join(f"{count} {name}" for name, count in solids.items() if count)
        raise UserError(
            f"{path}: holds a volume mesh ({listed}); a surface is wanted: "
            "extract its surface first (in ParaView: Extract Surface)"
        )
    unknown = np.setdiff1d(np.flatnonzero(counts), _FLAT + _IGNORED)
    if unknown.size:
        raise UserError(f"{path}: holds cells of an unknown kind; save its surface as triangles or polygons")
    if len(kinds) != len(sizes) or (sizes < 0).any() or sizes.sum() != len(corners):
        raise UserError(f"{path}: its cells are damaged")
    if corners.size and (corners.min() < 0 or corners.max() >= n):
        raise UserError(f"{path}: a cell refers to a vertex that is not there (there are {n})")

    flat, curved = np.isin(kinds, _FLAT), np.isin(kinds, _CURVED)
    starts, kept = (np.cumsum(sizes) - sizes)[flat], _corners(kinds[flat], sizes[flat])
    if (kept < 0).any():
        raise UserError(f"{path}: its cells are damaged (a cell has fewer corners than its kind needs)")
    notes = {}
    if curved.any():
        notes["second-order cells"] = f"{int(curved.sum())} curved cells are taken by their corners, as flat ones"
    return _cut(kinds[flat], starts, kept, corners), notes


def _corners(kinds: NDArray[np.uint8], sizes: Ints) -> Ints:
    """How many of each cell's points are its corners, which come first; -1 where it has too few."""
    corners = sizes.copy()
    corners[kinds == _CURVED_POLYGON] //= 2
    for members, count in ((_TRIANGLES, 3), ((*_QUADS, _PIXEL), 4)):
        fixed = np.isin(kinds, members)
        corners[fixed] = np.where(sizes[fixed] < count, -1, count)
    return corners


def _cut(kinds: NDArray[np.uint8], starts: Ints, sizes: Ints, corners: Ints) -> Ints:
    """Cut polygons into fans about their first corner, strips into triangles turned the way of the first."""
    fans = np.maximum(sizes - 2, 0)
    cell = np.repeat(np.arange(len(sizes)), fans)
    within = np.arange(len(cell)) - np.repeat(np.cumsum(fans) - fans, fans)
    first, kind = starts[cell], kinds[cell]
    a, b, c = first, first + within + 1, first + within + 2
    strip, odd = kind == _STRIP, within % 2
    a = np.where(strip, first + within, a)
    b, c = np.where(strip, b + odd, b), np.where(strip, c - odd, c)
    pixel = kind == _PIXEL  # its corners run 0 1 3 2 about it
    b = np.where(pixel, first + np.where(within == 0, 1, 3), b)
    c = np.where(pixel, first + np.where(within == 0, 3, 2), c)
    return np.stack([corners[a], corners[b], corners[c]], axis=1).reshape(-1, 3)
