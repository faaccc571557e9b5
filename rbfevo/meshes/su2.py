"""SU2's native mesh format: coordinates are put in place, so that markers, FFD boxes and all else stay.

Surface positions are what SU2_DEF reads with DV_KIND= SURFACE_FILE: a line for each point, its number from 0 and its
new coordinates.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.meshes.mesh import Cells, FormatError, Mesh, written_as
from rbfevo.meshes.places import Places, integers, lines
from rbfevo.meshes.surface import patch_points

_KEYWORD = re.compile(rb"\s*(\w+)\s*=\s*(.*?)\s*$", re.DOTALL)
_CORNERS = {3: 2, 5: 3, 9: 4, 10: 4, 12: 8, 13: 6, 14: 5}  # VTK's numbers: lines, triangles ... pyramids
_SEND = "SEND_RECEIVE"  # no part of the surface: what processes send each other


def read_su2(content: bytes) -> Mesh:
    """One zone of an SU2 mesh, in two or three dimensions; patches are its markers.

    Raises:
        FormatError: if it is damaged, has several zones, or elements of another type.
    """
    places, dimension, boxes = Places(content), 0, []
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
                boxes.append(value.decode("utf-8", "replace"))
        elif section in ("NPOIN", "NELEM", "MARKER_ELEMS"):
            raise FormatError(f"{section} announces fewer lines than there are")
    if points or elements:
        raise FormatError("cut off: points or elements are missing")
    patches.pop(_SEND, None)
    if boxes:
        notes["FFD boxes"] = f"the file has FFD boxes ({', '.join(boxes)}), which stay as they are"
    return Mesh(
        places.points(),
        written_as(places.rewritten),
        Cells.of(kinds, corners),
        patches={name: np.array(cells, np.int64) for name, cells in patches.items()},
        dimension=dimension,
        notes=notes,
        kept=[_stale(boxes)] if boxes else [],
    )


def surface_positions(mesh: Mesh, moved: Array, markers: Sequence[str] | None) -> tuple[bytes, list[str]]:
    """The surface positions of moved points [n, 3], as SU2_DEF reads them, and notes.

    SU2_DEF moves points of DV_MARKER that are not listed to the origin, and passes over points of other markers: so by
    default those of all markers are listed.

    Args:
        mesh: of a .su2 file; markers: names of some of its markers, None for all.

    Raises:
        UserError: if there is no such marker, or none at all.
    """
    named = list(mesh.patches) if markers is None else list(markers)
    if not named:
        raise UserError("the mesh has no markers, so there are no surface positions to write")
    rows = patch_points(mesh, named, "--patches")
    places = moved[rows, : mesh.dimension]
    listed = [
        f"{row}\t" + "\t".join(map(repr, place)) + "\n"
        for row, place in zip(rows.tolist(), places.tolist(), strict=True)
    ]
    what = f"DV_KIND= SURFACE_FILE, DV_MARKER= ( {', '.join(named)} )"
    part = f"{what}: or some of these markers" if markers is None else f"{what}: these markers and no others"
    return "".join(listed).encode(), [
        f"{len(rows)} of {len(mesh.points)} points, for SU2_DEF with {part}, since it moves points that are not listed "
        "to the origin"
    ]


def _stale(boxes: Sequence[str]) -> str:
    return (
        f"the FFD boxes {', '.join(boxes)} are kept as they were, and the parameters of their surface points do not "
        "fit the deformed surface: run SU2_DEF with DV_KIND= FFD_SETTING before you use them"
    )


def _number(name: str, value: bytes) -> int:
    try:
        number = int(value)
    except ValueError:
        number = -1
    if number < 0:
        raise FormatError(f"{name}= {value[:40].decode('latin-1')}: a number is expected")
    return number
