"""SU2's native mesh format: coordinates are put in place, so that markers, FFD boxes and all else stay."""

from __future__ import annotations

import re

import numpy as np

from rbfevo.exchange.lines import WORD, Places
from rbfevo.exchange.mesh import FormatError, Mesh, fans

_KEYWORD = re.compile(rb"\s*(NDIME|NPOIN|NELEM|MARKER_ELEMS|NZONE)\s*=\s*(-?\d+)")
_CORNERS = {5: 3, 9: 4, 10: 4}  # triangle, quadrilateral, tetrahedron


def read_su2(content: bytes) -> Mesh:
    """One zone of an SU2 mesh, in two or three dimensions.

    Raises:
        FormatError: if it is damaged, or has several zones.
    """
    places, dimension, polygons, tetrahedra = Places(content), 0, [], []
    offset, points, elements = 0, 0, 0  # how many lines of points and of elements are still to come
    for line in content.splitlines(keepends=True):
        begin, offset = offset, offset + len(line)
        text = line.split(b"%")[0]
        if not text.strip():
            continue
        if points:
            words = list(WORD.finditer(text))
            if len(words) < dimension:
                raise FormatError(f"point {len(places.points)} (from 0) has fewer than {dimension} coordinates")
            places.add(words[:dimension], begin)
            points -= 1
        elif elements:
            kind, *corners = _whole_numbers(text)
            if kind in _CORNERS:
                corners = corners[: _CORNERS[kind]]
                if len(corners) < _CORNERS[kind]:
                    raise FormatError("an element has fewer corners than its type says")
                (tetrahedra if kind == 10 else polygons).append(corners)
            elements -= 1
        elif found := _KEYWORD.match(text):
            name, number = found[1], int(found[2])
            if name == b"NDIME" and number in (2, 3):
                dimension = number
            elif name == b"NPOIN" and dimension and not places.points and number > 0:
                points = number
            elif name in (b"NELEM", b"MARKER_ELEMS") and number >= 0:
                elements = number
            elif name != b"NZONE" or number != 1:
                raise FormatError(f"its line {text.strip()[:40].decode('latin-1')!r} is not understood here")
    if points or elements:
        raise FormatError("cut off: points or elements are missing")
    mesh = places.mesh(fans(polygons), [])
    solid = np.array(tetrahedra, dtype=np.int64).reshape(-1, 4)
    if solid.size and (solid.min() < 0 or solid.max() >= len(mesh.points)):
        raise FormatError(f"an element refers to a point that is not there (there are {len(mesh.points)})")
    return Mesh(mesh.points, mesh.triangles, solid if len(solid) else None, mesh.dimension, [], mesh.write)


def _whole_numbers(text: bytes) -> list[int]:
    try:
        return [int(word) for word in text.split()]
    except ValueError:
        raise FormatError("an element has a number that is not whole") from None
