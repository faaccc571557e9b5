"""Read legacy VTK, VTP, VTU and OFF files with VTK; run by `separate.py` only, and needing NumPy and VTK only."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ASCII = re.compile(rb"[^\n]*\n[^\n]*\n\s*ascii\b", re.IGNORECASE)
# An infinite value makes VTK write a range that it cannot read again; nothing else is lost with it.
_HARMLESS = re.compile(r"ERROR: In [^\n]*\n[^\n]*Error reading InformationKey[^\n]*")
_POLYGON, _STRIP = 7, 6  # VTK_POLYGON, VTK_TRIANGLE_STRIP


def read(path: str, ending: str) -> dict[str, Any]:
    """Return points, cells and arrays as `separate.read` describes them, of PolyData or an UnstructuredGrid.

    Raises:
        ValueError: if the file cannot be read, or holds another kind of grid.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy

    grid = _grid(path, ending)
    kind = grid.GetClassName()
    if kind not in ("vtkPolyData", "vtkUnstructuredGrid"):
        raise ValueError(f"it holds a {kind[3:]}; save the surface as PolyData")
    if grid.GetPoints() is None or grid.GetNumberOfPoints() == 0:
        raise ValueError("there are no points in it: empty or damaged")
    points = vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64).reshape(-1, 3)
    if kind == "vtkPolyData":
        blocks = [(_POLYGON, *_cells(grid.GetPolys())), (_STRIP, *_cells(grid.GetStrips()))]
        kinds = np.concatenate([np.full(len(sizes), number, np.uint8) for number, _, sizes in blocks])
        corners = np.concatenate([block[1] for block in blocks])
        sizes = np.concatenate([block[2] for block in blocks])
    else:
        corners, sizes = _cells(grid.GetCells())
        kinds = vtk_to_numpy(grid.GetCellTypes()).astype(np.uint8) if len(sizes) else np.empty(0, np.uint8)
    return {
        "points": points,
        "kinds": kinds,
        "sizes": sizes,
        "corners": corners,
        "arrays": _arrays(grid.GetPointData(), len(points)),
        "cell_arrays": [name for name, _ in _named(grid.GetCellData())],
        "notes": [],
    }


def _grid(path: str, ending: str) -> Any:
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOGeometry import vtkOFFReader
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    complaints = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(complaints)
    readers = {".vtp": vtkXMLPolyDataReader, ".vtu": vtkXMLUnstructuredGridReader, ".off": vtkOFFReader}
    reader: Any = readers.get(ending, vtkGenericDataObjectReader)()
    if ending in readers:
        reader.SetFileName(path)
    else:
        content = Path(path).read_bytes()
        if _ASCII.match(content):
            # VTK 9.7 fills up numbers that a truncated file lacks with whatever memory holds, without a word; an empty
            # field at the end stops it, and means nothing otherwise.
            content += b"\nFIELD end 0\n"
        for every in ("Scalars", "Vectors", "Normals", "Tensors", "ColorScalars", "TCoords", "Fields"):
            getattr(reader, f"ReadAll{every}On")()  # else the first of each only
        reader.ReadFromInputStringOn()
        reader.SetInputString(content, len(content))
    reader.Update()
    grid, said = reader.GetOutput(), _HARMLESS.sub("", complaints.GetOutput())
    if grid is None or "ERROR:" in said or "ERR|" in said or "Error reading" in said:
        raise ValueError("damaged: VTK cannot read all of it")
    return grid


def _named(attributes: Any) -> list[tuple[str, Any]]:
    """Names and arrays of a point's or cell's attributes, texts and nameless ones left out."""
    found = [attributes.GetArray(i) for i in range(attributes.GetNumberOfArrays())]  # a text gives None
    return [(array.GetName(), array) for array in found if array is not None and array.GetName()]


def _arrays(attributes: Any, n: int) -> dict[str, NDArray[np.float64]]:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    arrays = {}
    for name, array in _named(attributes):
        if array.GetNumberOfTuples() != n:
            raise ValueError(f"damaged: its array '{name}' has {array.GetNumberOfTuples()} rows for {n} points")
        values = vtk_to_numpy(array).astype(np.float64)
        arrays[name] = values.reshape(n) if array.GetNumberOfComponents() == 1 else values.reshape(n, -1)
    return arrays


def _cells(cells: Any) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all cells' corners, one cell after another, and the cells' sizes."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if cells is None or cells.GetNumberOfCells() == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    cells.ConvertTo64BitStorage()
    offsets = vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64)
    corners = vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64)
    sizes = np.diff(offsets)
    if offsets[0] != 0 or (sizes < 0).any() or offsets[-1] > len(corners):
        raise ValueError("its cells are damaged")
    return corners[: offsets[-1]], sizes
