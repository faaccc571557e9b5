"""Read a Gmsh file: its version, and its sections one after another."""

from __future__ import annotations

import re
from collections.abc import Callable

from rbfevo.meshes.gmsh import common, version2, version4
from rbfevo.meshes.gmsh.assembly import mesh_of
from rbfevo.meshes.gmsh.parsed import Parsed
from rbfevo.meshes.gmsh.section import Section
from rbfevo.meshes.mesh import FormatError, Mesh
from rbfevo.meshes.places import Places

Reader = Callable[[Section, Parsed, Places], int | None]  # of one section; it may return where the section ends
_SECTION = re.compile(rb"^\$(\w+)[ \t]*\r?\n", re.MULTILINE)


def read_gmsh(content: bytes) -> Mesh:
    """A Gmsh mesh: points in the order of the file, cells in the order of its elements.

    Patches are its physical groups, by name, or else its entities. Elements of third and higher order are taken as
    straight ones.

    Raises:
        FormatError: if it is damaged, or of another version.
    """
    head = re.match(rb"\s*\$MeshFormat\s+(\S+)\s+(\d)\s+(\d)[ \t]*\r?\n", content)
    if head is None:
        raise FormatError("it does not begin with $MeshFormat")
    version, binary = head[1].decode("latin-1"), head[2] == b"1"
    if version.split(".")[0] not in ("2", "4") or version.startswith("4.0"):
        raise FormatError(f"it is of version {version}; versions 2 and 4.1 are read: save it as one of these")
    if head[3] != b"8":
        raise FormatError(f"it has numbers of {head[3].decode()} bytes; 8 are expected")
    order = "<"
    if binary:
        order = "<" if content[head.end() : head.end() + 4] == b"\1\0\0\0" else ">"
    new = version.startswith("4")
    places = Places(content, (0, 1, 2) if new else (1, 2, 3))
    parsed = Parsed()
    readers = (_binary_sections if binary else _text_sections)(new)
    at = head.end()
    while section := _SECTION.search(content, at):
        name, begin = section[1].decode("latin-1"), section.end()
        if name == "ParametricNodes" and binary:
            raise FormatError("it has binary $ParametricNodes, which are not read; save it in text")
        read = readers.get(name)
        if read is None:
            at = begin
            continue
        end = content.find(b"$End" + section[1], begin)
        if end < 0:
            raise FormatError(f"cut off: $End{name} is missing")
        stop = read(Section(content, begin, end, order, binary, name), parsed, places)
        end = content.find(b"$End" + section[1], stop) if stop is not None else end
        if end < 0 or (stop is not None and content[stop:end].strip()):
            raise FormatError(f"its section ${name} has more or less in it than it announces")
        at = end
    return mesh_of(content, parsed, places)


def _text_sections(new: bool) -> dict[str, Reader]:
    """The readers of the sections of a file in text, by name; `new`: of version 4."""
    return {
        "PhysicalNames": common.physical_names,
        "Entities": version4.entities,
        "Nodes": version4.nodes if new else version2.nodes,
        "ParametricNodes": version2.nodes,
        "Elements": version4.elements if new else version2.elements,
        "NodeData": common.values,
        "ElementData": common.values,
    }


def _binary_sections(new: bool) -> dict[str, Reader]:
    """The readers of the sections of a binary file, by name; `new`: of version 4."""
    return {
        "PhysicalNames": common.physical_names,
        "Entities": version4.entities_binary,
        "Nodes": version4.nodes_binary if new else version2.nodes_binary,
        "Elements": version4.elements_binary if new else version2.elements_binary,
        "NodeData": common.values,
        "ElementData": common.values,
    }
