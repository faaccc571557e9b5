"""A mesh from a file, on its way to be deformed: what is needed of it, and how to write it back."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.record import Array


class FormatError(ValueError):
    """What is wrong with a file's contents, in a few words; `rbfevo.exchange.opened` says which file."""


@dataclasses.dataclass(frozen=True)
class Mesh:
    """Points of a mesh or cloud and what is needed to check and to write it.

    Attributes:
        points: [q, 3] float64, in the file's order and unit; a file with two coordinates a point has z = 0.
        triangles: [f, 3] of its surface (polygons cut into fans), or None for a cloud; corners are checked.
        tetrahedra: [t, 4], or None.
        dimension: how many coordinates a point has in the file, 2 or 3.
        notes: what the user should know about writing it, a line each.
        write: writes moved points [q, 3] and displacements [q, 3] to a file, whole; returns more notes.
    """

    points: Array
    triangles: Array | None
    tetrahedra: Array | None
    dimension: int
    notes: list[str]
    write: Callable[[Array, Array, Path], list[str]]


def written_as(content: Callable[[Array], bytes]) -> Callable[[Array, Array, Path], list[str]]:
    """A `write` of a format whose whole file is made from the moved points [q, 3]."""

    def write(moved: Array, _: Array, out: Path) -> list[str]:
        write_whole(out, content(moved))
        return []

    return write


def narrowed(points: Array, dtype: np.dtype) -> Array:
    """Points in the precision of their file.

    Raises:
        UserError: if they are too large for it.
    """
    with np.errstate(over="ignore"):
        narrow = points.astype(dtype)
    if not np.isfinite(narrow).all():
        raise UserError(f"the deformed points are too large for the {8 * dtype.itemsize}-bit numbers of the file")
    return narrow


def fans(polygons: list[list[int]]) -> Array:
    """Triangles [f, 3] of polygons, each a fan about its first corner."""
    found = [(p[0], p[i], p[i + 1]) for p in polygons for i in range(1, len(p) - 1)]
    return np.array(found, dtype=np.int64).reshape(-1, 3)


def sound(triangles: Array, count: int) -> Array | None:
    """Triangles whose corners are checked against the number of points; None if there are none.

    Raises:
        FormatError: if a corner is not there.
    """
    if not len(triangles):
        return None
    if triangles.min() < 0 or triangles.max() >= count:
        wrong = int(triangles.min() if triangles.min() < 0 else triangles.max())
        raise FormatError(f"a face refers to vertex {wrong} (from 0), but there are {count} vertices")
    return triangles
