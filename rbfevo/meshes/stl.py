"""STL in binary and in text: corners are put in place and facet normals made anew, all else stays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.mesh import Cells, FormatError, Mesh, written_as
from rbfevo.meshes.places import Places, lines
from rbfevo.meshes.precision import narrowed

FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(content: bytes) -> Mesh:
    """STL: three points a facet, in the file's order. The format has no vertices that facets share.

    Patches of a text file are its solids.

    Raises:
        FormatError: if it is damaged.
    """
    if len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little"):
        return _binary(content)
    if content.lstrip()[:5].lower() == b"solid":
        return _text(content)
    announced = int.from_bytes(content[80:84], "little") if len(content) >= 84 else 0
    raise FormatError(
        f"it is neither a text file nor as long as it announces ({announced} facets, {len(content)} bytes): "
        "damaged or cut off"
    )


def _binary(content: bytes) -> Mesh:
    facets = np.frombuffer(content, FACET, offset=84)
    points = facets["corners"].astype(np.float64).reshape(-1, 3)

    def rewritten(moved: Array) -> bytes:
        """The bytes of the file with moved points [3 f, 3] and the normals that they have then."""
        changed = bytearray(content)
        rows = np.frombuffer(changed, FACET, offset=84)
        rows["corners"] = narrowed(moved, np.dtype("f4")).reshape(-1, 3, 3)
        rows["normal"] = normals(moved)
        return bytes(changed)

    return _mesh(points, rewritten, {})


def _text(content: bytes) -> Mesh:
    corners, facets = Places(content, (1, 2, 3)), Places(content, (2, 3, 4))
    solids: dict[str, list[int]] = {}
    order, name, ends = [], "", 0  # what stands there in turn: a facet's normal, or a corner
    for offset, line in lines(content):
        keyword = line.split(None, 1)[0].lower()
        if keyword == b"vertex":
            corners.add(offset, line)
            order.append(1)
        elif keyword == b"facet":
            facets.add(offset, line)
            solids.setdefault(name, []).append(len(facets) - 1)
            order.append(0)
        elif keyword == b"solid":
            fields = line.split(None, 1)
            name = fields[1].strip().decode("utf-8", "replace") if len(fields) > 1 else f"solid {len(solids)}"
        elif keyword == b"endsolid":
            ends += 1
    if order != [0, 1, 1, 1] * (len(order) // 4):
        raise FormatError("its facets do not have a normal and three corners each: damaged or cut off")
    if not ends:
        raise FormatError("cut off: its end is missing")

    def rewritten(moved: Array) -> bytes:
        """The bytes of the file with moved points [3 f, 3] and the normals that they have then."""
        return facets.rewritten(_readable(normals(moved)), corners.rewritings(_readable(moved)))

    patches = {name: np.array(facets, np.int64) for name, facets in solids.items()} if len(solids) > 1 else {}
    facets.points()  # a normal that is no number is refused as well
    return _mesh(corners.points(), rewritten, patches)


def _readable(values: Array) -> Array:
    """Values with 0 for those that single precision does not hold: VTK reads a text STL no further than to 1e-40."""
    return np.where(np.abs(values) < np.finfo(np.float32).tiny, 0.0, values)


def _mesh(points: Array, rewritten: Callable[[Array], bytes], patches: dict[str, Ints]) -> Mesh:
    if not len(points):
        raise FormatError("it holds no points; is it empty or damaged?")
    cells = Cells.blocks([(5, np.arange(len(points)).reshape(-1, 3))])
    return Mesh(points, written_as(rewritten), cells, patches=patches)


def normals(points: Array) -> Array:
    """Unit normals [f, 3] of triangles whose corners are points [3 f, 3]; 0 where one has no area."""
    a, b, c = np.moveaxis(points.reshape(-1, 3, 3), 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(length > 0, length, 1.0)
