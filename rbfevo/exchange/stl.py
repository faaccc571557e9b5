"""STL in binary and in text: corners are put in place and facet normals made anew, all else stays."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from rbfevo.exchange.lines import WORD, Places
from rbfevo.exchange.mesh import FormatError, Mesh, narrowed, written_as
from rbfevo.record import Array

FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NUMBER = rb"[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)"
_LINES = re.compile(rb"^[ \t]*(?:(facet[ \t]+normal)|(vertex))" + _NUMBER, re.IGNORECASE | re.MULTILINE)


def read_stl(content: bytes) -> Mesh:
    """STL: three corners a facet, in the file's order.

    Raises:
        FormatError: if it is damaged.
    """
    if len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little"):
        return _binary(content)
    if content.lstrip()[:5].lower() == b"solid":
        return _text(content)
    raise FormatError("it is neither a text file nor as long as it announces: damaged or cut off")


def _binary(content: bytes) -> Mesh:
    facets = np.frombuffer(content, FACET, offset=84)
    points = facets["corners"].astype(np.float64).reshape(-1, 3)

    def rewritten(moved: Array) -> bytes:
        changed = bytearray(content)
        rows = np.frombuffer(changed, FACET, offset=84)
        rows["corners"] = narrowed(moved, np.dtype("f4")).reshape(-1, 3, 3)
        rows["normal"] = normals(moved)
        return bytes(changed)

    return _mesh(points, rewritten)


def _text(content: bytes) -> Mesh:
    places, is_normal = Places(content), []  # normals and corners in turn, as they stand
    for line in _LINES.finditer(content):
        places.add(list(WORD.finditer(line[0]))[-3:], line.start())
        is_normal.append(line[1] is not None)
    if is_normal != [True, False, False, False] * (len(is_normal) // 4):
        raise FormatError("its facets do not have a normal and three corners each: damaged or cut off")
    if not re.search(rb"^[ \t]*endsolid", content, re.IGNORECASE | re.MULTILINE):
        raise FormatError("cut off: its end is missing")

    def rewritten(moved: Array) -> bytes:
        facets = np.concatenate([normals(moved)[:, None], moved.reshape(-1, 3, 3)], axis=1)
        return places.rewritten(facets.reshape(-1, 3))

    return _mesh(np.array(places.points).reshape(-1, 4, 3)[:, 1:].reshape(-1, 3), rewritten)


def _mesh(points: Array, rewritten: Callable[[Array], bytes]) -> Mesh:
    if not len(points):
        raise FormatError("there are no points in it: empty or damaged")
    return Mesh(points, np.arange(len(points)).reshape(-1, 3), None, 3, [], written_as(rewritten))


def normals(points: Array) -> Array:
    """Unit normals [f, 3] of triangles whose corners are points [3 f, 3]; 0 where one has no area."""
    a, b, c = np.moveaxis(points.reshape(-1, 3, 3), 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(length > 0, length, 1.0)
