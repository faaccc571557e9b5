"""The surface of a mesh: of its flat cells, of some of its patches, or the boundary of what fills a volume."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Ints
from rbfevo.errors import UserError
from rbfevo.meshes import cells
from rbfevo.meshes.mesh import Mesh

_SHOWN = 12  # names of patches in a line


class Surface(NamedTuple):
    """Triangles [f, 3] into a mesh's points, the cell [f] each is a part of (None on a volume's boundary), and "
    "notes."""

    triangles: Ints
    cell: Ints | None
    notes: dict[str, str]


def surface_of(mesh: Mesh, patches: Sequence[str] | None = None) -> Surface:
    """The triangles of a mesh: polygons are cut, second-order cells count by their corners.

    Args:
        patches: names of some of the mesh's patches, or None: all flat cells, or, of a mesh that fills a volume, the
            faces that belong to one cell only.

    Raises:
        UserError: if there is no such patch, or there are no flat cells in those chosen.
        FormatError: if cells are of an unknown kind, or polygons cross themselves.
    """
    counted, notes = cells.counts(mesh.cells), {}
    unknown = counted.get("cells of an unknown kind", 0)
    if unknown:
        raise cells.FormatError(f"{unknown} of its {len(mesh.cells)} cells are of an unknown kind; save polygons")
    curved, solids = cells.curved(mesh.cells), cells.solids(mesh.cells)
    if curved:
        notes["second-order cells"] = f"{curved} curved cells are taken by their corners, as flat ones"
    if patches:
        found = cells.surface(mesh.points, mesh.cells, patch_cells(mesh, patches))
        if not len(found.triangles):
            raise UserError(f"scenario.patches={','.join(patches)}: there are no faces in it")
        notes["patches"] = f"{', '.join(patches)}: {len(np.unique(found.cell))} faces of {len(mesh.patches)} patches"
        return Surface(found.triangles, found.cell, notes)
    if not solids:
        found = cells.surface(mesh.points, mesh.cells)
        return Surface(found.triangles, found.cell, notes)
    outer = cells.boundary(mesh.cells)
    listed = ", ".join(f"{count} {name}" for name, count in solids.items())
    names = f"; choose of it by scenario.patches, there are {shown(mesh.patches)}" if mesh.patches else ""
    notes["volume mesh"] = f"the boundary of {listed} is taken, {len(outer)} faces{names}"
    return Surface(cells.surface(mesh.points, outer).triangles, None, notes)


def patch_points(mesh: Mesh, patches: Sequence[str], setting: str) -> Ints:
    """The points [h] of the cells of some patches, ascending.

    Args:
        patches: names of patches of the mesh; setting: the key that names them, for messages.

    Raises:
        UserError: if there is no such patch.
    """
    chosen = patch_cells(mesh, patches, setting)
    starts = np.cumsum(mesh.cells.sizes) - mesh.cells.sizes
    each = mesh.cells.sizes[chosen]
    place = np.repeat(starts[chosen] - (np.cumsum(each) - each), each) + np.arange(int(each.sum()))
    return np.unique(mesh.cells.corners[place])


def patch_cells(mesh: Mesh, patches: Sequence[str], setting: str = "scenario.patches") -> Ints:
    """The cells of some of the patches of a mesh, ascending.

    Raises:
        UserError: if there is no such patch, with the names that there are.
    """
    return np.unique(np.concatenate([_patch(mesh, name, setting) for name in patches]))


def _patch(mesh: Mesh, name: str, setting: str) -> Ints:
    if name in mesh.patches:
        return mesh.patches[name]
    if not mesh.patches:
        raise UserError(f"{setting}={name}: the file names no patches")
    close = difflib.get_close_matches(name, mesh.patches, n=1)
    hint = f" (did you mean '{close[0]}'?)" if close else ""
    raise UserError(f"{setting}={name}: there is no such patch{hint}; there are {shown(mesh.patches)}")


def shown(names: Sequence[str] | dict[str, Ints]) -> str:
    """Names in a line, the first dozen of many."""
    listed = list(names)
    more = f" and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
    return ", ".join(listed[:_SHOWN]) + more
