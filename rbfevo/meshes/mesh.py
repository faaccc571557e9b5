"""A mesh from a file: points, cells and what is stored with them, and how to write it back with moved points."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Ints
from rbfevo.files import write_whole


class FormatError(ValueError):
    """What is wrong with a file's contents, in a few words; `rbfevo.meshes.opened` adds the file."""


class Faces(NamedTuple):
    """The faces of polyhedra: the `cell` [f] that each belongs to, their `sizes` [f] and all their `corners`."""

    cell: Ints
    sizes: Ints
    corners: Ints


@dataclasses.dataclass(frozen=True)
class Cells:
    """Cells of any kinds, in the file's order.

    Attributes:
        kinds: [c] uint8, VTK's number of each cell's kind (vtkCellType.h), whatever format the file has.
        sizes: [c] int64, corners of each; corners: all of them, one cell after another, int64 into points.
        faces: those of the polyhedra, if there are any.
    """

    kinds: NDArray[np.uint8]
    sizes: Ints
    corners: Ints
    faces: Faces | None = None

    @staticmethod
    def none() -> Cells:
        """No cells: a cloud."""
        return Cells(np.empty(0, np.uint8), np.empty(0, np.int64), np.empty(0, np.int64))

    @staticmethod
    def of(kinds: Iterable[int], corners: Sequence[Sequence[int]]) -> Cells:
        """Cells from their kinds and their lists of corners; polygons of three and four are called what they are."""
        sizes = np.fromiter((len(cell) for cell in corners), np.int64, len(corners))
        flat = np.fromiter((corner for cell in corners for corner in cell), np.int64, int(sizes.sum()))
        found = np.fromiter(kinds, np.uint8, len(corners))
        found[(found == 7) & (sizes == 3)] = 5
        found[(found == 7) & (sizes == 4)] = 9
        return Cells(found, sizes, flat)

    @staticmethod
    def polygons(corners: Sequence[Sequence[int]]) -> Cells:
        """Polygons from their lists of corners."""
        return Cells.of([7] * len(corners), corners)

    @staticmethod
    def blocks(blocks: Iterable[tuple[int, Ints]]) -> Cells:
        """Cells from blocks of one kind each: (kind, corners [c, k])."""
        listed = [(kind, np.asarray(corners, np.int64)) for kind, corners in blocks]
        return Cells(
            np.concatenate([np.empty(0, np.uint8), *(np.full(len(c), kind, np.uint8) for kind, c in listed)]),
            np.concatenate([np.empty(0, np.int64), *(np.full(len(c), c.shape[1], np.int64) for _, c in listed)]),
            np.concatenate([np.empty(0, np.int64), *(c.reshape(-1) for _, c in listed)]),
        )

    def __len__(self) -> int:
        return len(self.kinds)


class Meaning(NamedTuple):
    """What a file says of one of its sensitivities.

    Attributes:
        kind: `nodal` (integrated) or `density` (per area), None where the file does not say.
        normal: the normal that one value per vertex refers to (`as_wound`), None for vectors.
        note: how that is known, in a line; rank: of several, the lowest is the best to take.
        solver: the adjoint solver that it comes from, empty where that is not known.
    """

    kind: str | None
    normal: str | None
    note: str
    rank: int = 0
    solver: str = ""


@dataclasses.dataclass(frozen=True)
class Mesh:
    """All that rbfevo takes from a file, and how to write the file back.

    Attributes:
        points: [n, 3] float64, all points of the file in its order and unit; a file with two coordinates a point has
            z = 0.
        write: writes moved points [n, 3] and displacements [n, 3] to a file, whole; returns more notes.
        cells: the file's cells; none for a cloud. Their corners are there, and as many as their kinds need.
        arrays: numeric point arrays by name, float64 [n] or [n, k].
        cell_arrays: the same of the cells, [c] or [c, k].
        patches: named groups of cells (patches, markers, physical groups, element sets, parts): their numbers.
        patch_types: the types of patches by their names, where the format has them: OpenFOAM's, such as wall, patch,
            symmetryPlane, symmetry, empty.
        numbers: [n] int64, the file's own numbers of its points, where the format has them (Abaqus, Nastran, Gmsh).
        dimension: how many coordinates a point has in the file, 2 or 3.
        notes: one line each for what was accepted but is worth knowing, by a short title.
        meanings: what is known of sensitivities among the arrays, by their names.
        kept: what the user should know about writing it back, a line each.
    """

    points: Array
    write: Callable[[Array, Array, Path], list[str]]
    cells: Cells = dataclasses.field(default_factory=Cells.none)
    arrays: dict[str, Array] = dataclasses.field(default_factory=dict)
    cell_arrays: dict[str, Array] = dataclasses.field(default_factory=dict)
    patches: dict[str, Ints] = dataclasses.field(default_factory=dict)
    patch_types: dict[str, str] = dataclasses.field(default_factory=dict)
    numbers: Ints | None = None
    dimension: int = 3
    notes: dict[str, str] = dataclasses.field(default_factory=dict)
    meanings: dict[str, Meaning] = dataclasses.field(default_factory=dict)
    kept: list[str] = dataclasses.field(default_factory=list)


def written_as(content: Callable[[Array], bytes]) -> Callable[[Array, Array, Path], list[str]]:
    """A `write` of a format whose whole file is made from the moved points [n, 3]."""

    def write(moved: Array, _: Array, out: Path) -> list[str]:
        """Write the file with moved points [n, 3], whole; return no notes."""
        write_whole(out, content(moved))
        return []

    return write


def stale_normals(there: bool) -> list[str]:
    """The note on a file whose vertex normals stay as they were."""
    return ["its vertex normals are kept as they were and do not fit the deformed shape"] if there else []
