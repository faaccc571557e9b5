"""VTK datasets made of NumPy arrays, and written to files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

WRITERS = {  # by the class of a dataset, the only ones that are written, and the ending
    "vtkPolyData": {".vtp": "vtkXMLPolyDataWriter"},
    "vtkUnstructuredGrid": {".vtu": "vtkXMLUnstructuredGridWriter"},
    "vtkStructuredGrid": {".vts": "vtkXMLStructuredGridWriter"},
}


def add_array(attributes: Any, name: str, values: Any) -> None:
    """Add an array [q] or [q, c] to point data or cell data, in place of one of the same name."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
    array.SetName(name)
    attributes.AddArray(array)


def polydata(points: Any, triangles: Any | None, arrays: dict[str, Any]) -> Any:
    """A vtkPolyData: points [q, 3], triangles [f, 3] or, without, one vertex cell a point, and point arrays."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    made, places, cells = vtkPolyData(), vtkPoints(), vtkCellArray()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points, np.float64), deep=True))
    made.SetPoints(places)
    corners = np.arange(len(points))[:, None] if triangles is None else np.asarray(triangles)
    offsets = np.arange(len(corners) + 1, dtype=np.int64) * corners.shape[1]
    cells.SetData(
        numpy_to_vtkIdTypeArray(offsets, deep=True),
        numpy_to_vtkIdTypeArray(np.ascontiguousarray(corners, np.int64).ravel(), deep=True),
    )
    if triangles is None:
        made.SetVerts(cells)
    else:
        made.SetPolys(cells)
    for name, values in arrays.items():
        add_array(made.GetPointData(), name, values)
    return made


def grid(points: Any, kinds: Any, sizes: Any, corners: Any, arrays: dict[str, Any], cell_arrays: dict[str, Any]) -> Any:
    """A vtkUnstructuredGrid of cells (none: one vertex cell a point) with arrays of points and of cells."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    if not len(kinds):
        kinds, sizes, corners = np.full(len(points), 1), np.full(len(points), 1), np.arange(len(points))
    made, places, cells = vtkUnstructuredGrid(), vtkPoints(), vtkCellArray()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points, np.float64), deep=True))
    made.SetPoints(places)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    cells.SetData(
        numpy_to_vtkIdTypeArray(offsets, deep=True),
        numpy_to_vtkIdTypeArray(np.ascontiguousarray(corners, np.int64), deep=True),
    )
    made.SetCells(numpy_to_vtk(np.asarray(kinds, np.uint8), deep=True), cells)
    for name, values in arrays.items():
        add_array(made.GetPointData(), name, values)
    for name, values in cell_arrays.items():
        add_array(made.GetCellData(), name, values)
    return made


def write_dataset(dataset: Any, out: Path, old: bool = False) -> None:
    """Write a VTK dataset as .vtk (binary; `old`: of version 4.2), .vtp, .vtu or .vts.

    Raises:
        ValueError: if the ending does not fit the dataset, or VTK cannot write there.
    """
    from vtkmodules import vtkIOLegacy, vtkIOXML

    ending = out.suffix.lower()
    if ending == ".vtu" and dataset.GetClassName() != "vtkUnstructuredGrid":
        from vtkmodules.vtkFiltersCore import vtkAppendFilter

        append = vtkAppendFilter()
        append.AddInputData(dataset)
        append.Update()
        dataset = append.GetOutput()
    if ending == ".vtk":
        writer: Any = vtkIOLegacy.vtkDataSetWriter()
        writer.SetFileTypeToBinary()
        if old:
            writer.SetFileVersion(42)
    else:
        name = WRITERS[dataset.GetClassName()].get(ending)
        if name is None:
            endings = " or ".join([*WRITERS[dataset.GetClassName()], ".vtk"])
            raise ValueError(f"a {dataset.GetClassName()[3:]} cannot be written as {ending}; choose {endings}")
        writer = getattr(vtkIOXML, name)()
    writer.SetFileName(str(out))
    writer.SetInputData(dataset)
    if writer.Write() != 1 or not out.is_file():
        raise ValueError("VTK cannot write it (is the disk full?)")
