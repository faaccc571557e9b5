"""A mesh in one of the formats of meshio: read, and written back or converted."""

from __future__ import annotations

import copy
import re
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.meshes.precision import narrowed
from rbfevo.meshes.worker.messages import packed

_KIND_OF = {  # of a cell by the first part of meshio's name: VTK's number, corners, and the number of the curved cell
    "vertex": (1, 1, 1),
    "line": (3, 2, 21),
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
}
_UNKNOWN = 255


class MeshioFile:
    """A mesh in one of the formats of meshio."""

    def __init__(self, path: Path) -> None:
        import meshio

        double = "".join(path.suffixes[-2:]).lower()
        known = meshio.extension_to_filetypes
        formats = known.get(double) or known.get(path.suffix.lower(), [])
        if path.suffix.lower() == ".msh":
            formats = ["ansys"]  # Gmsh's files have a reader of their own
        if not formats:
            raise ValueError(f"unknown ending '{path.suffix}'")
        self._source = path
        for self.format in formats:
            try:
                self.mesh = meshio.read(path, self.format)
                break
            except ModuleNotFoundError:
                raise
            except (Exception, SystemExit):  # its readers raise whatever they like
                continue
        else:
            raise ValueError(f"damaged, or not in the format {' or '.join(formats)}: meshio cannot read it")
        self.points = np.asarray(self.mesh.points)
        if self.points.ndim != 2 or self.points.shape[1] not in (2, 3) or self.points.dtype.kind not in "fiu":
            raise ValueError("it does not have points with two or three coordinates")
        if not len(self.points):
            raise ValueError("it holds no points; is it empty or damaged?")
        blocks = [_block(block.type, block.data) for block in self.mesh.cells]
        starts = np.cumsum([0, *(len(block) for _, block in blocks)])
        nothing = np.empty(0, np.int64)
        n, width = self.points.shape
        self.reply = {
            "points": np.pad(self.points.astype(np.float64), ((0, 0), (0, 3 - width))),
            "dimension": np.array(width),
            "kinds": np.concatenate([np.empty(0, np.uint8), *(np.full(len(c), k, np.uint8) for k, c in blocks)]),
            "sizes": np.concatenate([nothing, *(np.full(len(c), c.shape[1], np.int64) for _, c in blocks)]),
            "corners": np.concatenate([nothing, *(c.reshape(-1) for _, c in blocks)]),
            "notes": np.array([], np.str_),
            **{f"face {part}": nothing for part in ("cells", "sizes", "corners")},
        }
        cell_data = {
            name: np.concatenate([np.asarray(part).reshape(len(part), -1) for part in parts])
            for name, parts in self.mesh.cell_data.items()
            if len({np.asarray(part).reshape(len(part), -1).shape[1] for part in parts if len(part)}) == 1
        }
        self.reply |= packed("array", _rows(self.mesh.point_data, n))
        self.reply |= packed("cell array", _rows(cell_data, int(starts[-1])))
        self.reply |= packed("patch", self._patches(starts))

    def _patches(self, starts: Any) -> dict[str, Any]:
        found = {}
        for name, parts in self.mesh.cell_sets.items():
            own = [np.asarray(part, np.int64) + starts[i] for i, part in enumerate(parts) if part is not None]
            found[str(name)] = np.concatenate([np.empty(0, np.int64), *own])
        return found

    def write(self, moved: Any, displacement: Any, out: Path) -> list[str]:
        """Write the mesh with moved points, read it again, and return what has become of it."""
        import meshio

        width = self.points.shape[1]
        if width == 2 and out.suffix in (".vtk", ".vtu"):
            width = 3
        data_type = self.points.dtype if self.points.dtype.kind == "f" else np.dtype(np.float64)
        mesh, file_format, options = copy.copy(self.mesh), self.format, {}
        mesh.points = np.ascontiguousarray(narrowed(moved[:, :width], data_type))
        if out.suffix.lower() != self._source.suffix.lower():
            file_format = {".vtk": "vtk", ".vtu": "vtu"}.get(out.suffix.lower())
            if file_format is None:
                raise ValueError(f"it cannot be written as {out.suffix}; choose {self._source.suffix}, .vtu or .vtk")
            mesh.point_data = {**mesh.point_data, "displacement": displacement}
        elif file_format == "xdmf" and b'Format="HDF"' not in self._source.read_bytes():
            options["data_format"] = "XML"
        try:
            meshio.write(out, mesh, file_format, **options)
        except (Exception, SystemExit) as error:  # its writers raise whatever they like
            reason = " ".join(str(error).split())[:300] or type(error).__name__
            raise ValueError(f"meshio does not write it ({reason}); choose a name that ends in .vtu") from None
        return self._losses(mesh, meshio.read(out, file_format))

    def _losses(self, mesh: Any, again: Any) -> list[str]:
        notes, before = [], np.asarray(mesh.points, np.float64)
        width = min(before.shape[1], again.points.shape[1])
        if len(again.points) != len(before) or _counts(again) != _counts(mesh):
            raise ValueError("meshio would lose points or cells of it; convert the mesh to .vtu first")
        rounding = float(np.abs(again.points[:, :width] - before[:, :width]).max())
        if rounding > 1e-14 * max(float(np.abs(before).max()), 1e-300):
            notes.append(f"the format's numbers round the coordinates by up to {rounding:.2g}")
        for what in ("point_data", "cell_data", "field_data", "point_sets", "cell_sets"):
            lost = [str(name) for name in getattr(mesh, what) if name not in getattr(again, what)]
            if lost:
                notes.append(f"meshio does not write its {what.replace('_', ' ')} {', '.join(lost)[:200]}")
        return notes


def _counts(mesh: Any) -> dict[str, int]:
    counts: dict[str, int] = {}
    for block in mesh.cells:
        counts[block.type] = counts.get(block.type, 0) + len(block.data)
    return counts


def _block(name: str, cells: Any) -> tuple[int, Any]:
    """VTK's number of a block's kind, and its corners [c, k]."""
    kind = re.sub(r"^vtk_(lagrange|bezier)_", "", str(name).lower()).rstrip("0123456789")
    straight, count, curved = _KIND_OF.get(kind, (_UNKNOWN, 0, _UNKNOWN))
    if straight == _UNKNOWN:
        return _UNKNOWN, np.empty((len(cells), 0), np.int64)
    corners = np.asarray(cells)
    if corners.size == 0:
        return straight, np.empty((0, max(count, 1)), np.int64)
    if corners.ndim != 2 or corners.dtype.kind not in "iu":
        raise ValueError(f"its {name} cells are damaged")
    return straight if count in (0, corners.shape[1]) else curved, corners.astype(np.int64)


def _rows(named: dict[str, Any], n: int) -> dict[str, Any]:
    """Numeric arrays by name, float64 [n] or [n, k]."""
    arrays = {}
    for name, given in named.items():
        values = np.asarray(given)
        if values.dtype.kind in "fiub" and len(values) == n and values.size:
            values = values.astype(np.float64).reshape(n, -1)
            arrays[str(name)] = values[:, 0] if values.shape[1] == 1 else values
    return arrays
