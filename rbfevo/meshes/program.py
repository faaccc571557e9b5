"""Read and write VTK datasets and what meshio knows, in a process of its own.

VTK's readers end the whole process on some damaged files, and meshio's print, leave, or never come back. So this file
is also a program, `python program.py KIND FILE`, which needs NumPy, VTK and meshio only: it answers with what the file
holds, waits for the moved points, and writes them; whatever happens to it, its parent lives on. Messages are .npz
archives after their length.
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
_KIND_OF = {  # of a cell by the first word of meshio's name: VTK's number, corners, and the number of the curved cell
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
_SEVERAL = (".vtm", ".pvtp", ".pvtu", ".pvts", ".case", ".encas", ".cgns")  # read, but written as .vtu only
_WRITERS = {
    "vtkPolyData": {".vtp": "vtkXMLPolyDataWriter"},
    "vtkUnstructuredGrid": {".vtu": "vtkXMLUnstructuredGridWriter"},
    "vtkStructuredGrid": {".vts": "vtkXMLStructuredGridWriter"},
}
# An infinite value makes VTK write a range that it cannot read again; nothing else is lost with it.
_HARMLESS = re.compile(r"ERROR: In [^\n]*\n[^\n]*Error reading InformationKey[^\n]*")


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
    """A dataset with points from one of VTK's own files, an EnSight case, or a file that names several others."""

    def __init__(self, path: Path) -> None:
        from vtkmodules.util.numpy_support import vtk_to_numpy

        self._ending = path.suffix.lower()
        found, self._settings = _read(path)
        self.dataset, patches, self._own = (_zones if self._ending == ".cgns" else _single)(found)
        if self.dataset.GetPoints() is None or self.dataset.GetNumberOfPoints() == 0:
            raise ValueError("there are no points in it: empty or damaged")
        self.points = vtk_to_numpy(self.dataset.GetPoints().GetData()).reshape(-1, 3)
        cells = _cells(self.dataset)
        self.reply = {"points": self.points, **cells, "notes": np.array([], np.str_)}
        self.reply |= packed("array", _arrays(self.dataset.GetPointData(), len(self.points)))
        self.reply |= packed("cell array", _arrays(self.dataset.GetCellData(), len(cells["kinds"])))
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
    from vtkmodules.vtkIOEnSight import vtkGenericEnSightReader
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
    elif path.suffix.lower() in (".case", ".encas"):
        reader = vtkGenericEnSightReader()
        reader.SetCaseFileName(str(path))
    elif path.suffix.lower() == ".cgns":
        reader = _cgns_reader(path, "BndPatch")
    else:
        with path.open("rb") as file:
            kind = _XML_KIND.search(file.read(4096))
        name = {"vtkMultiBlockDataSet": "MultiBlockData"}.get(kind[1].decode(), kind[1].decode()) if kind else ""
        reader = getattr(vtkIOXML, f"vtkXML{name}Reader", None)
        if reader is None or not kind:
            raise ValueError("it is not one of VTK's XML files: damaged, or of another format")
        reader = reader()
        reader.SetFileName(str(path))
    reader.Update()
    if path.suffix.lower() == ".cgns" and (
        "Skipping BC_t" in complaints.GetOutput()
        or not any("/Patches/" in name for name, _ in _parts(reader.GetOutput(), ""))
    ):
        # VTK takes the conditions of families alone: the sections of surface elements are the patches of other files.
        # VTK 9.7 crashes where both are asked for at once.
        reader = _cgns_reader(path, "SurfacePatch")
        reader.Update()
    dataset = reader.GetOutputDataObject(0)
    said = _HARMLESS.sub("", complaints.GetOutput())
    if dataset is None or "ERROR:" in said or "Error reading" in said or "ERR|" in said:
        raise ValueError("damaged: VTK cannot read all of it")
    return dataset, settings


def _cgns_reader(path: Path, patches: str) -> Any:
    from vtkmodules.vtkIOCGNSReader import vtkCGNSReader

    reader: Any = vtkCGNSReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    for part in ("Bases", "Families", "PointArrays", "CellArrays"):
        getattr(reader, f"EnableAll{part}")()
    getattr(reader, f"SetLoad{patches}")(True)
    return reader


def _zones(found: Any) -> tuple[Any, dict[str, Any], bool]:
    """The zones of a CGNS file, one after another, each with its patches' cells at its own points."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    parts: dict[str, list[tuple[str, Any]]] = {}
    for name, part in _parts(found, ""):
        zone, _, patch = name.replace("/Surfaces/", "/Patches/").partition("/Patches/")
        parts.setdefault(zone.removesuffix("/Internal"), []).append((patch, part))
    points, cells, arrays, cell_arrays, patches, first, count = [], [], [], [], {}, 0, 0
    for owned in parts.values():
        own = None
        for patch, part in sorted(owned, key=lambda item: item[0] != ""):
            places = vtk_to_numpy(part.GetPoints().GetData()).reshape(-1, 3)
            if own is None:
                own = places
                points.append(places)
                arrays.append(_arrays(part.GetPointData(), len(places)))
            elif not np.array_equal(own, places):
                continue  # a window of a structured zone: its cells are the boundary's
            block = _cells(part)
            if block["face cells"].size:
                raise ValueError("its cells are polyhedra; convert the mesh to .vtu first")
            cells.append((block["kinds"], block["sizes"], block["corners"] + first))
            cell_arrays.append(_arrays(part.GetCellData(), len(block["kinds"])))
            if patch:
                patches.setdefault(patch, []).append(np.arange(count, count + len(block["kinds"])))
            count += len(block["kinds"])
        first += len(own) if own is not None else 0
    if not points:
        raise ValueError("there are no points in it: empty or damaged")
    kinds, sizes, corners = (np.concatenate(column) for column in zip(*cells, strict=True))
    dataset = grid(
        np.concatenate(points),
        kinds,
        sizes,
        corners,
        _joined(arrays, [len(own) for own in points]),
        _joined(cell_arrays, [len(own) for own, _, _ in cells]),
    )
    return dataset, {name: np.concatenate(rows) for name, rows in patches.items()}, False


def _joined(parts: list[dict[str, Any]], counts: list[int]) -> dict[str, Any]:
    """Arrays of parts one after another; NaN where a part does not have one."""
    widths = {name: values.shape[1:] for own in parts for name, values in own.items()}
    return {
        name: np.concatenate(
            [own.get(name, np.full((n, *width), np.nan)) for own, n in zip(parts, counts, strict=True)]
        )
        for name, width in widths.items()
        if all(own[name].shape[1:] == width for own in parts if name in own)
    }


def _single(found: Any) -> tuple[Any, dict[str, Any], bool]:
    """A dataset with points and cells of its own, the cells of its parts by name, and whether it is the file's own.

    The parts of a file that names several stand one after another, and no points are merged.
    """
    from vtkmodules.vtkFiltersCore import vtkAppendFilter

    if found.GetClassName() in _WRITERS:
        return found, {}, True
    parts = list(_parts(found, ""))
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
    return append.GetOutput(), patches if len(patches) > 1 else {}, False


def _parts(found: Any, name: str) -> Any:
    """The datasets of a composite one, with their names."""
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
        yield from _parts(child, f"{name}/{own}" if name else own)


def _cells(dataset: Any) -> dict[str, Any]:
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


def _arrays(attributes: Any, n: int) -> dict[str, Any]:
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


def packed(title: str, arrays: dict[str, Any]) -> dict[str, Any]:
    """Named arrays as entries of a message: names may be any text, which entries of an archive may not."""
    names = list(arrays)
    return {f"{title}s": np.array(names, np.str_), **{f"{title} {i}": arrays[name] for i, name in enumerate(names)}}


def unpacked(title: str, message: dict[str, Any]) -> dict[str, Any]:
    """Named arrays from a message."""
    return {str(name): message[f"{title} {i}"] for i, name in enumerate(message[f"{title}s"])}


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


# --- meshio ----------------------------------------------------------------------------------------------------------


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
            raise ValueError("there are no points in it: empty or damaged")
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
        mesh.points = narrow(moved[:, :width], data_type)
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
    word = re.sub(r"^vtk_(lagrange|bezier)_", "", str(name).lower()).rstrip("0123456789")
    straight, count, curved = _KIND_OF.get(word, (_UNKNOWN, 0, _UNKNOWN))
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


# --- the program -----------------------------------------------------------------------------------------------------


KINDS = {"vtk": VtkFile, "meshio": MeshioFile}


def _main() -> None:
    # What a library prints must not get between the messages.
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        file = KINDS[sys.argv[1]](Path(sys.argv[2]))
        send(replies, file.reply)
        request = receive(sys.stdin.buffer)
        notes = file.write(request["moved"], request["displacement"], Path(str(request["out"])))
        send(replies, {"notes": np.array(notes, dtype=np.str_)})
    except EOFError:
        return
    except (Exception, SystemExit) as error:  # loaders raise whatever they like on a damaged file
        send(replies, {"problem": problem(error)})


def problem(error: BaseException) -> str:
    """What a library's error means to the user of the file, in one line."""
    if isinstance(error, ModuleNotFoundError):
        return f"meshio needs {error.name} for this format: pip install {error.name}"
    message = " ".join(str(error).split())[:300] or type(error).__name__
    return message if isinstance(error, ValueError) else f"damaged, or not of this format ({message})"


if __name__ == "__main__":
    _main()
