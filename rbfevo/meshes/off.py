"""OFF in text, also with colours, normals or texture coordinates (COFF, NOFF, STOFF, MeshLab's NCOFF).

Coordinates are put in place, all other bytes stay as they are.
"""

from __future__ import annotations

import re

from rbfevo.meshes.mesh import Cells, FormatError, Mesh, stale_normals, written_as
from rbfevo.meshes.places import Places, integers, lines


def read_off(content: bytes) -> Mesh:
    """OFF in text: the first three numbers of every vertex count.

    Raises:
        FormatError: if it is damaged, binary, or has another number of coordinates.
    """
    listed = list(lines(content, b"#"))
    if not listed:
        raise FormatError("it holds no points; is it empty or damaged?")
    header, first = b"", listed[0][1].split()
    if not first[0].isdigit():
        header = first[0].upper()
        if not re.fullmatch(rb"(ST|C|N)*OFF", header) or any(field.upper() == b"BINARY" for field in first):
            raise FormatError("only text files with three coordinates a point are read")
        first = first[1:]
        listed = listed if first else listed[1:]
        first = first or (listed[0][1].split() if listed else [])
    try:
        n, f = int(first[0]), int(first[1])
    except (IndexError, ValueError):
        raise FormatError("the numbers of vertices and faces are missing") from None
    if n < 0 or f < 0 or len(listed) < 1 + n + f:
        raise FormatError(f"cut off: it announces {n} vertices and {f} faces, a line each, and has {len(listed) - 1}")
    if len(listed) > 1 + n + f:
        raise FormatError(f"it announces {n} vertices and {f} faces, a line each, and has {len(listed) - 1} lines")
    places = Places(content)
    for offset, line in listed[1 : 1 + n]:
        places.add(offset, line)
    polygons = []
    for _, line in listed[1 + n :]:
        fields = line.split()
        size = integers(fields[0], "a face")[0]
        corners = integers(b" ".join(fields[1 : 1 + max(size, 0)]), "a face")
        if len(corners) != size:
            raise FormatError("a face has fewer corners than it announces")
        polygons.append(corners)
    kept = stale_normals(b"N" in header)
    return Mesh(places.points(), written_as(places.rewritten), Cells.polygons(polygons), kept=kept)
