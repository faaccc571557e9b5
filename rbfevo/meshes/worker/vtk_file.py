"""A dataset with points from a file that VTK reads: what it holds, and how it is written with moved points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.meshes.precision import narrowed
from rbfevo.meshes.vtk_datasets import WRITERS, add_array, write_dataset
from rbfevo.meshes.worker import cgns
from rbfevo.meshes.worker.messages import packed
from rbfevo.meshes.worker.vtk_contents import arrays_of, cells_of, parts_of, points_of
from rbfevo.meshes.worker.vtk_readers import read

_SEVERAL = (".vtm", ".pvtp", ".pvtu", ".pvts", ".case", ".encas", ".cgns")  # read, but written as .vtu only


class VtkFile:
    """A dataset with points from one of VTK's own files, an EnSight case, or a file that names several others."""

    def __init__(self, path: Path) -> None:
        self._ending = path.suffix.lower()
        found, self._settings = read(path)
        self._own = found.GetClassName() in WRITERS  # else the dataset is made of the file's several
        self.dataset, patches = (cgns.zones if self._ending == ".cgns" else _single)(found)
        if self.dataset.GetPoints() is None or self.dataset.GetNumberOfPoints() == 0:
            raise ValueError("it holds no points; is it empty or damaged?")
        self.points = points_of(self.dataset)
        cells = cells_of(self.dataset)
        self.reply = {"points": self.points, **cells, "notes": np.array([], np.str_)}
        self.reply |= packed("array", arrays_of(self.dataset.GetPointData(), len(self.points)))
        self.reply |= packed("cell array", arrays_of(self.dataset.GetCellData(), len(cells["kinds"])))
        self.reply |= packed("patch", patches)

    def write(self, moved: Any, displacement: Any, out: Path) -> list[str]:
        """Write the dataset with moved points and the displacement as an array; return notes."""
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonCore import vtkPoints

        if out.suffix.lower() == self._ending and (self._ending in _SEVERAL or not self._own):
            raise ValueError("such a file is read, but not written; choose a name that ends in .vtu")
        notes, data = [], self.dataset.GetPointData()
        data_type = self.points.dtype if self.points.dtype.kind == "f" else np.dtype(np.float64)
        points = vtkPoints()
        points.SetData(numpy_to_vtk(np.ascontiguousarray(narrowed(moved, data_type)), deep=True))
        self.dataset.SetPoints(points)
        if any(attributes.GetNormals() is not None for attributes in (data, self.dataset.GetCellData())):
            notes.append("its normals are kept as they were and do not fit the deformed shape")
        if data.HasArray("displacement"):
            notes.append("its own point array displacement is replaced")
        add_array(data, "displacement", displacement)
        if out.suffix == ".vtk" and self._settings.get("ascii"):
            notes.append("written as binary VTK, so that no digit is lost")
        write_dataset(self.dataset, out, old=self._settings.get("old", False))
        return notes


def _single(found: Any) -> tuple[Any, dict[str, Any]]:
    """One dataset with points and cells, and the cells of its parts by name.

    The parts of a file that names several stand one after another, and no points are merged.
    """
    from vtkmodules.vtkFiltersCore import vtkAppendFilter

    if found.GetClassName() in WRITERS:
        return found, {}
    parts = list(parts_of(found))
    if not parts:
        raise ValueError(f"it holds a {found.GetClassName()[3:]}, which has no points to move")
    append = vtkAppendFilter()
    append.MergePointsOff()
    patches, count = {}, 0
    for name, part in parts:
        append.AddInputData(part)
        patches[name] = np.arange(count, count + part.GetNumberOfCells())
        count += part.GetNumberOfCells()
    append.Update()
    return append.GetOutput(), patches if len(patches) > 1 else {}
