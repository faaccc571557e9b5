"""Boxes of hexahedra with named patches, for tests of volume meshes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.meshes.mesh import Cells, Faces, Mesh

HEXAHEDRON = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def hexahedra(*axes: Any) -> tuple[Any, Any]:
    """Points [n, 3] of a grid and the corners [c, 8] of its cells, in VTK's order."""
    index = np.arange(np.prod([len(axis) for axis in axes])).reshape([len(axis) for axis in axes])
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    i, j, k = (slice(None, -1), slice(None, -1), slice(None, -1))
    up = slice(1, None)
    around = [(i, j), (up, j), (up, up), (i, up)]
    corners = [index[(*side, level)].ravel() for level in (k, up) for side in around]
    return points, np.stack(corners, axis=1)


def outer_quads(corners: Any) -> Any:
    """The faces [f, 4] of one cell only."""
    every = np.concatenate([corners[:, face] for face in HEXAHEDRON])
    _, first, uses = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_counts=True)
    return every[np.sort(first[uses == 1])]


def box(points: Any, corners: Any, types: dict[str, str] | None = None) -> Mesh:
    """A mesh of hexahedra whose boundary faces are quads in patches: xmin, xmax ... zmax, and on zmin also bump."""
    quads, patches = outer_quads(corners), {}
    centre, low, high = points[quads].mean(axis=1), points.min(axis=0), points.max(axis=0)
    for axis, letter in enumerate("xyz"):
        for name, at in (("min", low[axis]), ("max", high[axis])):
            patches[letter + name] = np.flatnonzero(np.isclose(centre[:, axis], at)) + len(corners)
    bump = (np.abs(centre[:, 0]) < 0.5) & np.isclose(centre[:, 2], low[2])
    patches["bump"] = np.flatnonzero(bump) + len(corners)
    patches["zmin"] = np.setdiff1d(patches["zmin"], patches["bump"])
    cells = Cells.blocks([(12, corners), (9, quads)])
    return Mesh(points, lambda *_: [], cells, patches=patches, patch_types=types or {})


def polyhedra(corners: Any) -> Cells:
    """The same cells as polyhedra with faces, wound outwards and inwards by turns."""
    faces = np.stack(
        [corners[:, list(face)[:: 1 - 2 * (number % 2)]] for number, face in enumerate(HEXAHEDRON)], axis=1
    )
    cell = np.repeat(np.arange(len(corners)), 6)
    listed = Faces(cell, np.full(len(cell), 4), faces.reshape(-1))
    return Cells(np.full(len(corners), 42, np.uint8), np.full(len(corners), 8), corners.reshape(-1), listed)


def write_su2(path: Path, mesh: Mesh) -> None:
    """Write a box as SU2 has it."""
    count = int((mesh.cells.kinds == 12).sum())
    solid, quads = mesh.cells.corners[: 8 * count].reshape(-1, 8), mesh.cells.corners[8 * count :].reshape(-1, 4)
    lines = ["NDIME= 3", f"NELEM= {count}"]
    lines += [f"12 {' '.join(map(str, cell))} {number}" for number, cell in enumerate(solid.tolist())]
    lines += [f"NPOIN= {len(mesh.points)}"]
    lines += [f"{x!r} {y!r} {z!r} {number}" for number, (x, y, z) in enumerate(mesh.points.tolist())]
    lines += [f"NMARK= {len(mesh.patches)}"]
    for name, members in mesh.patches.items():
        lines += [f"MARKER_TAG= {name}", f"MARKER_ELEMS= {len(members)}"]
        lines += [f"9 {' '.join(map(str, quads[member - count]))}" for member in members.tolist()]
    path.write_text("\n".join(lines) + "\n")
