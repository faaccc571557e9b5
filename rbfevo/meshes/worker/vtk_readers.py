"""Which of VTK's readers reads a file, and what it complains of."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rbfevo.meshes.worker import cgns

_XML_KIND = re.compile(rb'<VTKFile[^>]*\btype\s*=\s*["\'](\w+)["\']')
_ASCII = re.compile(rb"[^\n]*\n[^\n]*\n\s*ascii\b", re.IGNORECASE)
_OLD = re.compile(rb"# vtk DataFile Version [1-4]\.", re.IGNORECASE)
# An infinite value makes VTK write a range that it cannot read again; nothing else is lost with it.
_HARMLESS = re.compile(r"ERROR: In [^\n]*\n[^\n]*Error reading InformationKey[^\n]*")


def read(path: Path) -> tuple[Any, dict[str, bool]]:
    """The dataset in a file, and of a .vtk file whether it is in text (`ascii`) and of an old version (`old`).

    Raises:
        ValueError: if VTK cannot read all of it.
    """
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    complaints, settings = vtkStringOutputWindow(), {}
    vtkOutputWindow.SetInstance(complaints)
    ending = path.suffix.lower()
    if ending == ".vtk":
        reader, settings = _legacy(path)
    elif ending in (".case", ".encas"):
        reader = _ensight(path)
    elif ending == ".cgns":
        reader = cgns.reader(path, "BndPatch")
    else:
        reader = _xml(path)
    reader.Update()
    if ending == ".cgns" and cgns.lacks_patches(reader.GetOutput(), complaints.GetOutput()):
        reader = cgns.reader(path, "SurfacePatch")
        reader.Update()
    dataset = reader.GetOutputDataObject(0)
    message = _HARMLESS.sub("", complaints.GetOutput())
    if dataset is None or "ERROR:" in message or "Error reading" in message or "ERR|" in message:
        raise ValueError("damaged: VTK cannot read all of it")
    return dataset, settings


def _legacy(path: Path) -> tuple[Any, dict[str, bool]]:
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader

    content = path.read_bytes()
    settings = {"ascii": _ASCII.match(content) is not None, "old": _OLD.match(content) is not None}
    if settings["ascii"]:
        # VTK 9.7 fills up numbers that a truncated file lacks with whatever memory holds, without a complaint; an empty
        # field at the end stops it, and means nothing otherwise.
        content += b"\nFIELD end 0\n"
    reader: Any = vtkGenericDataObjectReader()
    reader.ReadFromInputStringOn()
    reader.SetInputString(content, len(content))
    for kind in ("Scalars", "Vectors", "Normals", "Tensors", "ColorScalars", "TCoords", "Fields"):
        getattr(reader, f"ReadAll{kind}On")()
    return reader, settings


def _ensight(path: Path) -> Any:
    from vtkmodules.vtkIOEnSight import vtkGenericEnSightReader

    reader: Any = vtkGenericEnSightReader()
    reader.SetCaseFileName(str(path))
    return reader


def _xml(path: Path) -> Any:
    from vtkmodules import vtkIOXML

    with path.open("rb") as file:
        kind = _XML_KIND.search(file.read(4096))
    name = {"vtkMultiBlockDataSet": "MultiBlockData"}.get(kind[1].decode(), kind[1].decode()) if kind else ""
    reader = getattr(vtkIOXML, f"vtkXML{name}Reader", None)
    if reader is None or not kind:
        raise ValueError("it is not one of VTK's XML files: damaged, or of another format")
    reader = reader()
    reader.SetFileName(str(path))
    return reader
