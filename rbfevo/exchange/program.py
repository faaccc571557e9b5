"""Read and write VTK datasets and what meshio knows, in a process of its own.

VTK's readers end the whole process on some damaged files, and meshio's print and leave. So this file is also a program,
`python program.py KIND FILE`, which needs NumPy, VTK and meshio only: it answers with the file's points, waits for the
moved ones, and writes them; whatever happens to it, its parent lives on. Messages are .npz archives after their length.
"""

from __future__ import annotations

import copy
import io
import os
import re
import struct
import sys
from pathlib import Path
from typing import IO, Any

import numpy as np

LENGTH = struct.Struct("<Q")
_XML_KIND = re.compile(rb'<VTKFile[^>]*\btype\s*=\s*["\'](\w+)["\']')
_ASCII = re.compile(rb"[^\n]*\n[^\n]*\n\s*ascii\b", re.IGNORECASE)
_OLD = re.compile(rb"# vtk DataFile Version [1-4]\.", re.IGNORECASE)
_WRITERS = {
    "vtkPolyData": {".vtp": "vtkXMLPolyDataWriter"},
    "vtkUnstructuredGrid": {".vtu": "vtkXMLUnstructuredGridWriter"},
    "vtkStructuredGrid": {".vts": "vtkXMLStructuredGridWriter"},
}
_FLAT_OR_SOLID = {5: 3, 9: 4, 10: 4}  # VTK_TRIANGLE, VTK_QUAD, VTK_TETRA: corners


def send(stream: IO[bytes], arrays: dict[str, Any]) -> None:
    """Write one message."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    stream.write(LENGTH.pack(len(buffer.getbuffer())))
    stream.write(buffer.getbuffer())
    stream.flush()


def receive(stream: IO[bytes]) -> dict[str, Any]:
    """Read one message.

    Raises:
        EOFError: if the other side has ended.
    """
    header = stream.read(LENGTH.size)
    body = stream.read(LENGTH.unpack(header)[0]) if len(header) == LENGTH.size else b""
    if not body:
        raise EOFError
    with np.load(io.BytesIO(body), allow_pickle=False) as archive:
        return dict(archive)


# --- VTK -------------------------------------------------------------------------------------------------------------


class VtkFile:
    """A dataset with points from a .vtk, .vtp, .vtu or .vts file."""

    def __init__(self, path: Path) -> None:
        from vtkmodules.util.numpy_support import vtk_to_numpy

        self.dataset, self._settings = _read(path)
        kind = self.dataset.GetClassName()
        if kind not in _WRITERS:
            raise ValueError(f"it holds a {kind[3:]}, which has no points of its own to move; save it as .vts or .vtu")
        if self.dataset.GetPoints() is None or self.dataset.GetNumberOfPoints() == 0:
            raise ValueError("there are no points in it: empty or damaged")
        self.points = vtk_to_numpy(self.dataset.GetPoints().GetData()).reshape(-1, 3)
        self.triangles, self.tetrahedra = _cells(self.dataset, len(self.points))

    def write(self, moved: Any, displacement: Any, out: Path) -> list[str]:
        """Write the dataset with moved points and the displacement as an array; return notes."""
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonCore import vtkPoints

        notes, data = [], self.dataset.GetPointData()
        data_type = self.points.dtype if self.points.dtype.kind == "f" else np.dtype(np.float64)
        points = vtkPoints()
        points.SetData(numpy_to_vtk(narrow(moved, data_type), deep=True))
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


def narrow(points: Any, data_type: np.dtype) -> Any:
    """Points in the precision of their file."""
    with np.errstate(over="ignore"):
        narrowed = np.ascontiguousarray(points.astype(data_type))
    if not np.isfinite(narrowed).all():
        raise ValueError(f"the deformed points are too large for the {8 * data_type.itemsize}-bit numbers of the file")
    return narrowed


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
        name = _WRITERS[dataset.GetClassName()].get(ending)
        if name is None:
            endings = " or ".join([*_WRITERS[dataset.GetClassName()], ".vtk"])
            raise ValueError(f"a {dataset.GetClassName()[3:]} cannot be written as {ending}; choose {endings}")
        writer = getattr(vtkIOXML, name)()
    writer.SetFileName(str(out))
    writer.SetInputData(dataset)
    if writer.Write() != 1 or not out.is_file():
        raise ValueError("VTK cannot write it (is the disk full?)")


def _read(path: Path) -> tuple[Any, dict[str, bool]]:
    from vtkmodules import vtkIOXML
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader

    complaints = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(complaints)
    settings = {}
    if path.suffix.lower() == ".vtk":
        content = path.read_bytes()
        settings = {"ascii": _ASCII.match(content) is not None, "old": _OLD.match(content) is not None}
        if settings["ascii"]:
            # VTK 9.7 fills up numbers that a truncated file lacks with whatever memory holds, without a word; an empty
            # field at the end stops it, and means nothing otherwise.
            content += b"\nFIELD end 0\n"
        reader: Any = vtkGenericDataObjectReader()
        reader.ReadFromInputStringOn()
        reader.SetInputString(content, len(content))
        for kind in ("Scalars", "Vectors", "Normals", "Tensors", "ColorScalars", "TCoords", "Fields"):
            getattr(reader, f"ReadAll{kind}On")()
    else:
        with path.open("rb") as file:
            kind = _XML_KIND.search(file.read(4096))
        reader = getattr(vtkIOXML, f"vtkXML{kind[1].decode()}Reader", None) if kind else None
        if reader is None:
            raise ValueError("it is not one of VTK's XML files: damaged, or of another format")
        reader = reader()
        reader.SetFileName(str(path))
    reader.Update()
    dataset, said = getattr(reader, "GetOutputAsDataSet", reader.GetOutput)(), complaints.GetOutput()
    if dataset is None or "ERROR:" in said or "Error reading" in said or "ERR|" in said:
        raise ValueError("damaged: VTK cannot read all of it")
    return dataset, settings


def _cells(dataset: Any, count: int) -> tuple[Any, Any]:
    """Triangles [f, 3], polygons cut into fans, and tetrahedra [t, 4], once all cells are known to be sound."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    nothing = np.empty((0, 3), np.int64), np.empty((0, 4), np.int64)
    if dataset.GetClassName() == "vtkPolyData":
        for cells in (dataset.GetVerts(), dataset.GetLines(), dataset.GetStrips()):
            _connectivity(cells, count)
        return _fans(*_connectivity(dataset.GetPolys(), count)), nothing[1]
    if dataset.GetClassName() != "vtkUnstructuredGrid" or dataset.GetNumberOfCells() == 0:
        return nothing
    offsets, corners = _connectivity(dataset.GetCells(), count)
    types = vtk_to_numpy(dataset.GetCellTypesArray())
    sizes = np.diff(offsets)
    if len(types) != len(sizes) or any((sizes[types == kind] != size).any() for kind, size in _FLAT_OR_SOLID.items()):
        raise ValueError("its cells are damaged")
    triangles, quads, tetrahedra = (
        corners[offsets[:-1][types == kind][:, None] + np.arange(size)] for kind, size in _FLAT_OR_SOLID.items()
    )
    return np.concatenate([triangles, quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), tetrahedra


def _connectivity(cells: Any, count: int) -> tuple[Any, Any]:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if cells is None or cells.GetNumberOfCells() == 0:
        return np.zeros(1, np.int64), np.empty(0, np.int64)
    offsets = vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64)
    corners = vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64)
    if offsets[0] != 0 or (np.diff(offsets) < 0).any() or offsets[-1] > len(corners):
        raise ValueError("its cells are damaged")
    if corners.size and (corners.min() < 0 or corners.max() >= count):
        raise ValueError(f"a cell refers to a point that is not there (there are {count})")
    return offsets, corners


def _fans(offsets: Any, corners: Any) -> Any:
    fans = np.maximum(np.diff(offsets) - 2, 0)
    polygon = np.repeat(np.arange(len(fans)), fans)
    first = offsets[:-1][polygon]
    within = np.arange(len(polygon)) - np.repeat(np.cumsum(fans) - fans, fans)
    return np.stack([corners[first], corners[first + within + 1], corners[first + within + 2]], axis=1)


# --- meshio ----------------------------------------------------------------------------------------------------------


def sixteen_characters(points: Any) -> Any:
    """Points rounded so that each coordinate fits a large Nastran field, which meshio insists on."""

    def digits(x: float) -> int:
        return 11 - (x < 0) - (x != 0 and not 1e-9 <= abs(x) < 1e10)

    rounded = [float(f"{x:.{digits(x)}e}") for x in np.asarray(points, np.float64).reshape(-1).tolist()]
    return np.array(rounded).reshape(np.shape(points))


class MeshioFile:
    """A mesh in one of the formats of meshio."""

    def __init__(self, path: Path) -> None:
        import meshio

        formats = meshio.extension_to_filetypes.get(path.suffix.lower(), [])
        if path.suffix.lower() == ".msh":
            with path.open("rb") as file:
                formats = ["gmsh" if b"$MeshFormat" in file.read(4096) else "ansys"]
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
            raise ValueError("there are no points in it: empty or damaged")
        corners = {kind: self._corners(kind, size) for kind, size in (("triangle", 3), ("quad", 4), ("tetra", 4))}
        quads = corners["quad"]
        self.triangles = np.concatenate([corners["triangle"], quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        self.tetrahedra = corners["tetra"]

    def _corners(self, kind: str, size: int) -> Any:
        blocks = [np.asarray(block.data, np.int64) for block in self.mesh.cells if block.type == kind]
        corners = np.concatenate([np.empty((0, size), np.int64), *blocks])
        if corners.size and (corners.min() < 0 or corners.max() >= len(self.points)):
            raise ValueError(f"a cell refers to a point that is not there (there are {len(self.points)})")
        return corners

    def write(self, moved: Any, displacement: Any, out: Path) -> list[str]:
        """Write the mesh with moved points, read it again, and return what has become of it."""
        import meshio

        width = self.points.shape[1]
        if width == 2 and out.suffix in (".vtk", ".vtu"):
            width = 3
        data_type = self.points.dtype if self.points.dtype.kind == "f" else np.dtype(np.float64)
        mesh, file_format, options = copy.copy(self.mesh), self.format, {}
        mesh.points = narrow(moved[:, :width], data_type)
        if out.suffix.lower() != self._source.suffix.lower():
            file_format = {".vtk": "vtk", ".vtu": "vtu"}.get(out.suffix.lower())
            if file_format is None:
                raise ValueError(f"it cannot be written as {out.suffix}; choose {self._source.suffix}, .vtu or .vtk")
            mesh.point_data = {**mesh.point_data, "displacement": displacement}
        elif file_format == "gmsh":
            head = self._source.read_bytes()[:4096].split(b"$MeshFormat", 1)[-1].split()
            file_format = "gmsh22" if head[:1] == [b"2.2"] else "gmsh"
            options["binary"] = head[1:2] != [b"0"]
        elif file_format == "xdmf" and b'Format="HDF"' not in self._source.read_bytes():
            options["data_format"] = "XML"
        written = copy.copy(mesh)
        if file_format == "nastran":
            written.points = sixteen_characters(mesh.points)
        try:
            meshio.write(out, written, file_format, **options)
        except meshio.WriteError as error:
            raise ValueError(f"meshio says: {error} Convert the mesh to .vtu first") from None
        return self._losses(mesh, meshio.read(out, file_format.removesuffix("22")))

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


# --- the program -----------------------------------------------------------------------------------------------------


def _main() -> None:
    # What a library prints must not get between the messages.
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        file = {"vtk": VtkFile, "meshio": MeshioFile}[sys.argv[1]](Path(sys.argv[2]))
        send(replies, {"points": file.points, "triangles": file.triangles, "tetrahedra": file.tetrahedra})
        request = receive(sys.stdin.buffer)
        notes = file.write(request["moved"], request["displacement"], Path(str(request["out"])))
        send(replies, {"notes": np.array(notes, dtype=np.str_)})
    except EOFError:
        return
    except ModuleNotFoundError as error:
        send(replies, {"problem": f"meshio needs {error.name} for this format: pip install {error.name}"})
    except (Exception, SystemExit) as error:  # loaders raise whatever they like on a damaged file
        message = " ".join(str(error).split())[:300] or type(error).__name__
        send(replies, {"problem": message if isinstance(error, ValueError) else f"{type(error).__name__}: {message}"})


if __name__ == "__main__":
    _main()
