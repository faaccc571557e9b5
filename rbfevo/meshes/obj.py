"""Wavefront OBJ: coordinates are put in place, all other bytes stay as they are."""

from __future__ import annotations

import re

import numpy as np

from rbfevo.arrays import Ints
from rbfevo.meshes.mesh import Cells, FormatError, Mesh, stale_normals, written_as
from rbfevo.meshes.places import Places, lines

_CONTINUED = re.compile(rb"\\[ \t]*(?:\r\n|\n|\r)")
_FREE_FORM = (b"curv", b"curv2", b"surf", b"cstype", b"vp", b"bmat", b"con")
_KINDS = {b"f": 7, b"fo": 7, b"l": 4, b"p": 2}
_MARK = b"\xef\xbb\xbf"


def read_obj(content: bytes) -> Mesh:
    """OBJ: `v` lines are the points, in their order; `f`, `l` and `p` the cells, whatever indices stand beside them.

    Corners below zero count back from the last vertex so far. A fourth coordinate, vertex colours, texture
    coordinates and normals stay in the file. Patches are the groups (`g`), or the objects (`o`) where there are none.

    Raises:
        FormatError: if it is damaged, or holds free-form curves or surfaces.
    """
    # A continued line becomes one, with blanks in the place of what continues it, so that every byte keeps its place.
    text = _CONTINUED.sub(lambda found: b" " * len(found[0]), content) if b"\\" in content else content
    places = Places(content, (1, 2, 3))
    kinds: list[int] = []
    corners: list[list[int]] = []
    groups: dict[bytes, dict[str, list[int]]] = {b"g": {}, b"o": {}}
    current: dict[bytes, list[str]] = {b"g": [], b"o": []}
    normals, free = False, 0
    for offset, line in lines(text, b"#", len(_MARK) if content.startswith(_MARK) else 0):
        keyword = line.split(None, 1)[0]
        if keyword == b"v":
            places.add(offset, line)
        elif keyword in _KINDS:
            cell = _corners(line, len(places))
            for kind, names in current.items():
                for name in names:
                    groups[kind].setdefault(name, []).append(len(corners))
            kinds.append(_KINDS[keyword])
            corners.append(cell)
        elif keyword in current:
            names = line.split()[1:]
            current[keyword] = [name.decode("utf-8", "replace") for name in names] or (
                ["default"] if keyword == b"g" else []
            )
        elif keyword == b"vn":
            normals = True
        elif keyword in _FREE_FORM:
            free += 1
    if free:
        raise FormatError(f"{free} of its lines are free-form curves or surfaces, which are not read; export polygons")
    patches = groups[b"g"] if set(groups[b"g"]) - {"default"} else groups[b"o"]
    return Mesh(
        places.points(),
        written_as(places.rewritten),
        Cells.of(kinds, corners),
        patches={name: _numbers(cells) for name, cells in patches.items()},
        kept=stale_normals(normals),
    )


def _numbers(cells: list[int]) -> Ints:
    return np.array(cells, np.int64)


def _corners(line: bytes, count: int) -> list[int]:
    """Corners from 0 of a face, a line or points: the first of the numbers between slashes."""
    fields = line.split()[1:]
    try:
        found = [int(field.split(b"/", 1)[0]) for field in fields]
    except ValueError:
        raise FormatError(f"a face has a corner that is no number: {line.strip()[:40].decode('latin-1')!r}") from None
    if 0 in found:
        raise FormatError("a face has the corner 0, but an OBJ file counts its vertices from 1")
    return [corner - 1 if corner > 0 else corner + count for corner in found]
