"""What a VTK dataset holds, as NumPy arrays: its parts, points, cells and arrays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np


def parts_of(found: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The datasets with points in a composite one, or the one that is none, with their names below `name`."""
    from vtkmodules.vtkCommonDataModel import vtkCompositeDataSet

    if not found.IsA("vtkCompositeDataSet"):
        if found.IsA("vtkDataSet") and found.GetNumberOfPoints():
            yield name or "part", found
        return
    for block in range(found.GetNumberOfBlocks() if found.IsA("vtkMultiBlockDataSet") else 0):
        child = found.GetBlock(block)
        if child is None:
            continue
        info = found.GetMetaData(block) if found.HasMetaData(block) else None
        own = info.Get(vtkCompositeDataSet.NAME()) if info is not None else None
        own = own or f"block {block}"
        yield from parts_of(child, f"{name}/{own}" if name else own)


def points_of(dataset: Any) -> Any:
    """The points [n, 3] of a dataset, in its own precision."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(dataset.GetPoints().GetData()).reshape(-1, 3)


def cells_of(dataset: Any) -> dict[str, Any]:
    """Kinds, sizes and corners of all cells, in the order of the cell arrays."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkAppendFilter

    if dataset.GetClassName() == "vtkPolyData":
        blocks = []
        for cells, by_size, other in (
            (dataset.GetVerts(), {1: 1}, 2),
            (dataset.GetLines(), {2: 3}, 4),
            (dataset.GetPolys(), {3: 5, 4: 9}, 7),
            (dataset.GetStrips(), {}, 6),
        ):
            sizes, corners = _connectivity(cells)
            kinds = np.full(len(sizes), other, np.uint8)
            for size, kind in by_size.items():
                kinds[sizes == size] = kind
            blocks.append((kinds, sizes, corners))
        kinds, sizes, corners = (np.concatenate(part) for part in zip(*blocks, strict=True))
    else:
        if dataset.GetClassName() == "vtkStructuredGrid":
            append = vtkAppendFilter()
            append.AddInputData(dataset)
            append.Update()
            dataset = append.GetOutput()
        sizes, corners = _connectivity(dataset.GetCells())
        kinds = vtk_to_numpy(_kinds(dataset)).astype(np.uint8) if len(sizes) else np.empty(0, np.uint8)
    faces = _polyhedra(dataset, kinds)
    return {"kinds": kinds, "sizes": sizes, "corners": corners, **faces}


def _kinds(dataset: Any) -> Any:
    """The array of the cells' kinds, as VTK gives it from 9.6 on, or before."""
    try:
        return dataset.GetCellTypes()
    except TypeError:
        return dataset.GetCellTypesArray()


def _polyhedra(dataset: Any, kinds: Any) -> dict[str, Any]:
    """The faces of polyhedra: the cell that each belongs to, their sizes and corners."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if not (kinds == 42).any():
        nothing = np.empty(0, np.int64)
        return {"face cells": nothing, "face sizes": nothing, "face corners": nothing}
    sizes, corners = _connectivity(dataset.GetPolyhedronFaces())
    locations = dataset.GetPolyhedronFaceLocations()
    starts = vtk_to_numpy(locations.GetOffsetsArray()).astype(np.int64)
    listed = vtk_to_numpy(locations.GetConnectivityArray()).astype(np.int64)
    begins = np.cumsum(sizes) - sizes
    own = [corners[begins[face] : begins[face] + sizes[face]] for face in listed]
    return {
        "face cells": np.repeat(np.arange(len(starts) - 1), np.diff(starts)),
        "face sizes": sizes[listed],
        "face corners": np.concatenate([np.empty(0, np.int64), *own]),
    }


def arrays_of(attributes: Any, n: int) -> dict[str, Any]:
    """Numeric arrays by name, float64 [n] or [n, k]; texts and nameless ones are left out."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    found = {}
    for place in range(attributes.GetNumberOfArrays()):
        array = attributes.GetArray(place)  # a text gives None
        if array is None or not array.GetName():
            continue
        name = array.GetName()
        if array.GetNumberOfTuples() != n:
            raise ValueError(f"damaged: its array '{name}' has {array.GetNumberOfTuples()} rows for {n}")
        values = vtk_to_numpy(array).astype(np.float64)
        found[name] = values.reshape(n) if array.GetNumberOfComponents() == 1 else values.reshape(n, -1)
    return found


def _connectivity(cells: Any) -> tuple[Any, Any]:
    """Sizes and corners of cells, one after another."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if cells is None or cells.GetNumberOfCells() == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    offsets = vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64)
    corners = vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64)
    if offsets[0] != 0 or (np.diff(offsets) < 0).any() or offsets[-1] > len(corners):
        raise ValueError("its cells are damaged")
    return np.diff(offsets), corners[: offsets[-1]]
