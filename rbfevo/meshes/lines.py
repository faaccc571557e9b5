"""The line cells of a mesh as segments: a curve, such as the boundary of a mesh in two dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Ints
from rbfevo.meshes import cells
from rbfevo.meshes.mesh import Mesh
from rbfevo.meshes.surface import patch_cells, shown

POLYLINE = 4


class Lines(NamedTuple):
    """Segments [s, 2] into a mesh's points, the cell [s] each is a part of, and notes."""

    segments: Ints
    cell: Ints
    notes: dict[str, str]


def lines_of(mesh: Mesh, patches: Sequence[str] | None = None) -> Lines:
    """The segments of all line cells, or of those in some patches; cells of higher order count by their two ends.

    Raises:
        UserError: if there is no such patch.
    """
    chosen = np.isin(mesh.cells.kinds, cells.LINES)
    if patches:
        members = np.zeros(len(chosen), bool)
        members[patch_cells(mesh, patches)] = True
        chosen &= members
    index = np.flatnonzero(chosen & (mesh.cells.sizes >= 2))
    starts = (np.cumsum(mesh.cells.sizes) - mesh.cells.sizes)[index]
    counts = np.where(mesh.cells.kinds[index] == POLYLINE, mesh.cells.sizes[index] - 1, 1)
    place = np.repeat(starts, counts) + np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    segments = np.stack([mesh.cells.corners[place], mesh.cells.corners[place + 1]], axis=1)
    return Lines(segments, np.repeat(index, counts), _notes(mesh, patches, len(index)))


def _notes(mesh: Mesh, patches: Sequence[str] | None, count: int) -> dict[str, str]:
    flat = int(np.isin(mesh.cells.kinds, cells.FLAT).sum())
    if patches:
        return {"patches": f"{', '.join(patches)}: {count} lines of {len(mesh.patches)} patches"}
    if not flat:
        return {}
    names = f"; choose of them by scenario.patches, there are {shown(mesh.patches)}" if mesh.patches else ""
    return {"curve": f"the design is the curve of all {count} lines, not the area of {flat} faces{names}"}
