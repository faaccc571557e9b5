"""Read what meshio reads (Gmsh, Abaqus, Nastran, SU2 ...); run by `separate.py` only, and needing NumPy and meshio."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

# A cell's kind by the first word of meshio's name for it: VTK's number, corners of the straight cell, and VTK's number
# of the curved one.
_KINDS = {
    "vertex": (1, 1, 1),
    "line": (3, 2, 68),
    "curve": (68, 2, 68),
    "triangle": (5, 3, 69),
    "quad": (9, 4, 70),
    "quadrilateral": (9, 4, 70),
    "polygon": (7, 0, 7),
    "pixel": (8, 4, 8),
    "tetra": (10, 4, 71),
    "tetrahedron": (10, 4, 71),
    "hexahedron": (12, 8, 72),
    "wedge": (13, 6, 73),
    "pyramid": (14, 5, 74),
    "penta_prism": (15, 10, 15),
    "hexa_prism": (16, 12, 16),
    "polyhedron": (42, 0, 42),
}
_FLAT, _UNKNOWN = (5, 7, 8, 9, 69, 70), 255
_NODE_BLOCK = re.compile(rb"^[ \t]*\*node[ \t]*(?:,|\r?$)", re.IGNORECASE | re.MULTILINE)


def read(path: str, ending: str) -> dict[str, Any]:
    """Return points, cells and arrays as `separate.read` describes them; cells that are not flat have no corners.

    Raises:
        ValueError: if the file is of a make that meshio would misread without a word; beside what meshio raises.
    """
    import meshio

    mesh = meshio.read(path, file_format=_format(path, ending))
    points = np.asarray(mesh.points)
    if points.ndim != 2 or len(points) == 0 or points.dtype.kind not in "fiu":
        raise ValueError("there are no points in it: empty or damaged")
    n, dimensions = points.shape
    if dimensions not in (2, 3):
        raise ValueError(f"its points have {dimensions} coordinates")
    notes = ["the points have two coordinates; the third is taken as 0"] if dimensions == 2 else []
    if ending in (".bdf", ".fem", ".nas") and np.any(mesh.point_data.get("nastran:ref", 0)):
        notes.append("GRID points name coordinate systems of their own (CP), which are taken as the basic one")

    blocks = [_block(block.type, block.data) for block in mesh.cells]
    return {
        "points": np.pad(points.astype(np.float64), ((0, 0), (0, 3 - dimensions))),
        "kinds": np.concatenate([np.empty(0, np.uint8), *(np.full(len(s), k, np.uint8) for k, s, _ in blocks)]),
        "sizes": np.concatenate([np.empty(0, np.int64), *(sizes for _, sizes, _ in blocks)]),
        "corners": np.concatenate([np.empty(0, np.int64), *(corners for _, _, corners in blocks)]),
        "arrays": _arrays(mesh.point_data, n),
        "cell_arrays": [str(name) for name in mesh.cell_data],
        "notes": notes,
    }


def _format(path: str, ending: str) -> str | None:
    """The format where the ending does not settle it; None where it does."""
    if ending == ".msh":  # meshio would try Ansys first, whose reader never ends on some files
        with Path(path).open("rb") as file:
            return "gmsh" if file.read(200).lstrip().startswith(b"$") else "ansys"
    if ending == ".inp":
        blocks = len(_NODE_BLOCK.findall(Path(path).read_bytes()))
        if blocks > 1:
            raise ValueError(f"it has {blocks} *NODE blocks, of which only one can be read; write a single, flat part")
    return None


def _block(name: str, cells: Any) -> tuple[int, Any, Any]:
    """Kind (VTK's number), sizes and corners of a block of cells."""
    word = re.sub(r"^vtk_(lagrange|bezier)_", "", str(name).lower()).rstrip("0123456789")
    straight, count, curved = _KINDS.get(word, (_UNKNOWN, 0, _UNKNOWN))
    if straight not in _FLAT:
        return straight, np.zeros(len(cells), np.int64), np.empty(0, np.int64)
    cells = np.asarray(cells)
    if cells.size == 0:
        return straight, np.empty(0, np.int64), np.empty(0, np.int64)
    if cells.ndim != 2 or cells.dtype.kind not in "iu":
        raise ValueError(f"its {name} cells are damaged")
    kind = straight if count in (0, cells.shape[1]) else curved
    return kind, np.full(len(cells), cells.shape[1], np.int64), cells.astype(np.int64).reshape(-1)


def _arrays(point_data: dict[str, Any], n: int) -> dict[str, Any]:
    arrays = {}
    for name, given in point_data.items():
        values = np.asarray(given)
        if values.dtype.kind in "fiub" and len(values) == n and values.size:
            values = values.astype(np.float64).reshape(n, -1)
            arrays[str(name)] = values[:, 0] if values.shape[1] == 1 else values
    return arrays
