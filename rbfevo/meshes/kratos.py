"""Kratos' model part files (.mdpa): the coordinates of nodes are put in place, all other bytes stay."""

from __future__ import annotations

import re

from rbfevo.meshes.mesh import FormatError, Mesh, written_as
from rbfevo.meshes.numbered import Numbered
from rbfevo.meshes.places import Places, integers, lines

_NAMED = re.compile(r".*?(?P<dimension>[23])D(?P<nodes>\d+)N?$")
_SURFACE = re.compile(r"shell|membrane|surface|plate|face|skin|quadrilateral|triangle", re.IGNORECASE)
_FLAT = {3: 5, 4: 9, 6: 22, 8: 23, 9: 28}
_SOLID = {4: 10, 5: 14, 6: 13, 8: 12, 10: 24, 13: 27, 15: 26, 20: 25}
_BLOCKS = ("Elements", "Conditions", "Geometries")


def read_kratos(content: bytes) -> Mesh:
    """The nodes, elements, conditions and geometries of a model part; patches are its sub model parts.

    Raises:
        FormatError: if it is damaged, or has elements that are not read, with their number.
    """
    places, numbered = Places(content, (1, 2, 3)), Numbered()
    stack: list[list[str]] = []
    sets: list[tuple[str, str, list[int]]] = []
    unknown: dict[str, int] = {}
    for offset, line in lines(content, b"//"):
        fields = line.decode("latin-1").split()
        if fields[0] == "Begin":
            stack.append(fields[1:])
            continue
        if fields[0] == "End":
            if not stack or stack[-1][:1] != fields[1:2]:
                raise FormatError(f"'End {' '.join(fields[1:])}' ends nothing that has begun")
            stack.pop()
            continue
        block = stack[-1] if stack else [""]
        if block[0] == "Nodes":
            places.add(offset, line)
            numbered.node(integers(line.split(None, 1)[0], "a node")[0], (0.0, 0.0, 0.0))
        elif block[0] in _BLOCKS:
            name = block[1] if len(block) > 1 else ""
            number, *nodes = integers(line, "an element")
            nodes = nodes if block[0] == "Geometries" else nodes[1:]  # its property stands before
            kind = _kind(name, len(nodes), block[0])
            if kind is None:
                unknown[name] = unknown.get(name, 0) + 1
            else:
                numbered.cell(number, kind, nodes, collection=block[0])
        elif block[0].startswith("SubModelPart") and block[0].removeprefix("SubModelPart") in _BLOCKS:
            path = "/".join(entry[1] for entry in stack if entry[0] == "SubModelPart" and len(entry) > 1)
            sets.append((path, block[0].removeprefix("SubModelPart"), integers(line, "a sub model part")))
    if stack:
        raise FormatError(f"cut off: 'End {stack[-1][0]}' is missing")
    if unknown:
        raise FormatError(
            f"it has elements that are not read: {', '.join(f'{n} {name}' for name, n in unknown.items())}"
        )
    for path, collection, members in sets:
        numbered.patch(path, members, collection=collection)
    mesh = numbered.mesh()
    return Mesh(places.points(), written_as(places.rewritten), mesh.cells, patches=mesh.patches, numbers=mesh.numbers)


def _kind(name: str, nodes: int, block: str) -> int | None:
    """VTK's kind by the name of an element, as Element3D4N; conditions are parts of a surface or curve."""
    found = _NAMED.fullmatch(name)
    if not found or int(found["nodes"]) != nodes:
        return None
    if nodes == 1:
        return 1
    if nodes == 2:
        return 3
    if nodes == 3 and ((found["dimension"] == "2" and block == "Conditions") or name.lower().startswith("line")):
        return 21
    flat = nodes == 3 or found["dimension"] == "2" or block == "Conditions" or bool(_SURFACE.search(name))
    return (_FLAT if flat else _SOLID).get(nodes)
