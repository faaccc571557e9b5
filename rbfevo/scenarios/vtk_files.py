"""Read surfaces and clouds from legacy VTK and from VTP files, in a process of its own.

VTK's readers end the whole process on some damaged files (a segmentation fault, an allocation that nobody catches) and
print about the others. So this file is also a program, `python vtk_files.py FILE ENDING`, which needs NumPy and VTK
only: it writes what it read to standard output, and whatever happens to it, its parent lives on.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ASCII = re.compile(rb"[^\n]*\n[^\n]*\n\s*ascii\b", re.IGNORECASE)
_FLAT_CELLS = (5, 7, 9)  # VTK_TRIANGLE, VTK_POLYGON, VTK_QUAD
_IGNORED_CELLS = (0, 1, 2, 3, 4)  # nothing, vertices, lines


def read_vtk(content: bytes, ending: str) -> tuple[NDArray[np.float64], NDArray[np.int64] | None]:
    """Read vertices [n, 3] and triangles [f, 3], or None where there are none, from the bytes of a .vtk or .vtp file.

    Taken are the polygons and triangle strips of PolyData and the flat cells of an UnstructuredGrid.

    Raises:
        ValueError: if the file cannot be read, or holds another kind of grid.
    """
    command = [sys.executable, "-P", __file__, ending]
    reply = subprocess.run(command, input=content, capture_output=True, check=False)
    if reply.returncode != 0:
        raise ValueError("damaged: VTK cannot read it")
    with np.load(io.BytesIO(reply.stdout), allow_pickle=False) as arrays:
        if "problem" in arrays:
            raise ValueError(str(arrays["problem"]))
        return arrays["vertices"], arrays["triangles"] if len(arrays["triangles"]) else None


def _main() -> None:
    reply = io.BytesIO()
    try:
        vertices, triangles = _surface(_read(sys.stdin.buffer.read(), sys.argv[1]))
        np.savez(reply, vertices=vertices, triangles=triangles)
    except ValueError as error:
        np.savez(reply, problem=str(error))
    sys.stdout.buffer.write(reply.getvalue())


def _read(content: bytes, ending: str) -> Any:
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    complaints = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(complaints)
    reader: Any = vtkXMLPolyDataReader() if ending == ".vtp" else vtkGenericDataObjectReader()
    reader.ReadFromInputStringOn()
    if ending == ".vtp":
        reader.SetInputString(content)
    else:
        if _ASCII.match(content):
            # VTK 9.7 fills up numbers that a truncated file lacks with whatever memory holds, without a word; an empty
            # field at the end stops it, and means nothing otherwise.
            content += b"\nFIELD end 0\n"
        reader.SetInputString(content, len(content))
    reader.Update()
    grid, said = reader.GetOutput(), complaints.GetOutput()
    if grid is None or "ERROR:" in said or "Error reading" in said:
        raise ValueError("damaged: VTK cannot read all of it")
    return grid


def _surface(grid: Any) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    kind = grid.GetClassName()
    if kind not in ("vtkPolyData", "vtkUnstructuredGrid"):
        raise ValueError(f"it holds a {kind[3:]}; save the surface as PolyData")
    if grid.GetPoints() is None or grid.GetNumberOfPoints() == 0:
        raise ValueError("there are no points in it: empty or damaged")
    points = vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64).reshape(-1, 3)
    if kind == "vtkPolyData":
        polygons = _fans(*_cells(grid.GetPolys(), len(points)))
        return points, np.concatenate([polygons, _strips(*_cells(grid.GetStrips(), len(points)))])
    types = np.array([grid.GetCellType(i) for i in range(grid.GetNumberOfCells())], np.int64)
    corners, sizes = _cells(grid.GetCells(), len(points))
    if len(types) != len(sizes) or not np.isin(types, _FLAT_CELLS + _IGNORED_CELLS).all():
        raise ValueError("it holds volume or curved cells; save its surface as PolyData")
    flat = np.isin(types, _FLAT_CELLS)
    return points, _fans(corners[np.repeat(flat, sizes)], sizes[flat])


def _cells(cells: Any, n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all cells' corners, one cell after another, and the cells' sizes, once they are known to be sound."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if cells is None or cells.GetNumberOfCells() == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    cells.ConvertTo64BitStorage()
    offsets = vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64)
    corners = vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64)
    sizes = np.diff(offsets)
    if offsets[0] != 0 or (sizes < 0).any() or offsets[-1] > len(corners):
        raise ValueError("its cells are damaged")
    corners = corners[: offsets[-1]]
    if corners.size and (corners.min() < 0 or corners.max() >= n):
        raise ValueError(f"a cell refers to a vertex that is not there (there are {n})")
    return corners, sizes


def _fans(corners: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cut every polygon into a fan of triangles about its first corner."""
    fans = np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes)), fans)
    within = np.arange(len(polygon)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = (np.cumsum(sizes) - sizes)[polygon]
    return np.stack([corners[first], corners[first + within + 1], corners[first + within + 2]], axis=1)


def _strips(corners: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cut every triangle strip into its triangles, all turned the way of the first."""
    count = np.maximum(sizes - 2, 0)
    strip = np.repeat(np.arange(len(sizes)), count)
    within = np.arange(len(strip)) - np.repeat(np.cumsum(count) - count, count)
    start = (np.cumsum(sizes) - sizes)[strip] + within
    odd = within % 2
    return np.stack([corners[start], corners[start + 1 + odd], corners[start + 2 - odd]], axis=1)


if __name__ == "__main__":
    _main()
