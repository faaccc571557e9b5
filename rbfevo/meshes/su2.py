"""SU2's native mesh format: coordinates are put in place, so that markers, FFD boxes and all else stay."""

from __future__ import annotations

import re

import numpy as np

from rbfevo.meshes.mesh import Cells, FormatError, Mesh, written_as
from rbfevo.meshes.places import Places, integers, lines

_KEYWORD = re.compile(rb"\s*(\w+)\s*=\s*(.*?)\s*$", re.DOTALL)
_CORNERS = {3: 2, 5: 3, 9: 4, 10: 4, 12: 8, 13: 6, 14: 5}  # VTK's numbers: lines, triangles ... pyramids
_SEND = "SEND_RECEIVE"  # no part of the surface: what processes send each other


def read_su2(content: bytes) -> Mesh:
    """One zone of an SU2 mesh, in two or three dimensions; patches are its markers.

    Raises:
        FormatError: if it is damaged, has several zones, or elements of another type.
    """
    places, dimension = Places(content), 0
    kinds: list[int] = []
    corners: list[list[int]] = []
    patches: dict[str, list[int]] = {}
    marker, notes, section = "", {}, ""
    points, elements, skipped = 0, 0, 0  # how many lines of points, of elements, of vertices to send are to come
    for offset, line in lines(content, b"%"):
        if points:
            places.add(offset, line)
            points -= 1
        elif elements:
            if marker:
                patches[marker].append(len(corners))
            kind, *own = integers(line, "an element")
            if kind not in _CORNERS:
                raise FormatError(f"an element has the type {kind}, which SU2's format does not have")
            if len(own) < _CORNERS[kind]:
                raise FormatError("an element has fewer corners than its type says")
            kinds.append(kind)
            corners.append(own[: _CORNERS[kind]])
            elements -= 1
        elif skipped and b"=" not in line:
            skipped -= 1
        elif found := _KEYWORD.match(line):
            name, value = found[1].decode("latin-1").upper(), found[2]
            section = name
            if name == "NDIME" and not places:
                dimension = _number(name, value)
                if dimension not in (2, 3):
                    raise FormatError(f"NDIME= {dimension}: two or three dimensions are expected")
                places = Places(content, range(dimension))
            elif name == "NPOIN":
                if not dimension or places:
                    raise FormatError("NPOIN stands before NDIME, or twice: several zones are not read")
                points = _number(name, value.split()[0] if value else b"")
            elif name == "NELEM":
                elements, marker = _number(name, value), ""
            elif name == "MARKER_TAG":
                marker = value.decode("utf-8", "replace")
                patches.setdefault(marker, [])
            elif name == "MARKER_ELEMS":
                count = _number(name, value)
                elements, skipped = (0, count) if marker == _SEND else (count, 0)
                section = name if marker != _SEND else ""
            elif name == "NZONE" and _number(name, value) != 1:
                raise FormatError("it has several zones; write a file for each")
            elif name == "FFD_TAG":
                notes["FFD boxes"] = "the file has FFD boxes, which stay as they are"
        elif section in ("NPOIN", "NELEM", "MARKER_ELEMS"):
            raise FormatError(f"{section} announces fewer lines than there are")
    if points or elements:
        raise FormatError("cut off: points or elements are missing")
    patches.pop(_SEND, None)
    return Mesh(
        places.points(),
        written_as(places.rewritten),
        Cells.of(kinds, corners),
        patches={name: np.array(cells, np.int64) for name, cells in patches.items()},
        dimension=dimension,
        notes=notes,
    )


def _number(name: str, value: bytes) -> int:
    try:
        number = int(value)
    except ValueError:
        number = -1
    if number < 0:
        raise FormatError(f"{name}= {value[:40].decode('latin-1')}: a number is expected")
    return number
