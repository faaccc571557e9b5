"""Back to a case: the points of a time, or the displacement of its points for OpenFOAM's own mesh mover."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.files import write_whole

CONSTRAINTS = ("symmetryPlane", "symmetry", "empty", "wedge", "cyclic", "cyclicAMI", "cyclicACMI", "processor")
POINT_DISPLACEMENT = "pointDisplacement"


class Patch(NamedTuple):
    """A patch: its type, its first face, and how many it has."""

    kind: str
    start: int
    size: int


def writer(patches: Mapping[str, Patch], sizes: Ints, corners: Ints) -> Callable[[Array, Array, Path], list[str]]:
    """The `write` of a case's mesh: `out` is a time's directory, or its pointDisplacement.

    Args:
        patches: by name; sizes: [f], corners: of all faces.
    """

    def write(moved: Array, displacement: Array, out: Path) -> list[str]:
        """Write TIME/polyMesh/points, or the field TIME/pointDisplacement; return notes."""
        if out.name == POINT_DISPLACEMENT:
            content = point_displacement(displacement, patches, sizes, corners, out.parent.name)
            out.parent.mkdir(parents=True, exist_ok=True)
            write_whole(out, content)
            return ["points inside are left to OpenFOAM: the field holds the displacement of the patches' points"]
        target = out / "polyMesh" / "points"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_whole(target, points(moved, f"{out.name}/polyMesh"))
        return [f"points are in {target}; the solver takes them if it starts from time {out.name}"]

    return write


def points(values: Array, location: str) -> bytes:
    """The file of points [n, 3], each number as short as it can be read back to the bit."""
    return _header("vectorField", location, "points") + _listed(values) + b"\n"


def point_displacement(
    displacement: Array, patches: Mapping[str, Patch], sizes: Ints, corners: Ints, location: str
) -> bytes:
    """The boundary condition of a mesh mover: displacements of each patch's points in the order in which OpenFOAM has
    them, that of their first appearance in the patch's faces.

    Args:
        displacement: [n, 3] of all points; patches, sizes, corners: of the case's faces.
    """
    ends, parts = np.cumsum(sizes), []
    for name, patch in patches.items():
        if patch.kind in CONSTRAINTS:
            parts.append(f"    {_keyword(name)}\n    {{\n        type            {patch.kind};\n    }}\n".encode())
            continue
        first = int(ends[patch.start] - sizes[patch.start]) if patch.size else 0
        last = int(ends[patch.start + patch.size - 1]) if patch.size else 0
        own = displacement[in_order(corners[first:last])]
        value = b"uniform (0 0 0)" if not own.any() else b"nonuniform List<vector>\n" + _listed(own)
        head = f"    {_keyword(name)}\n    {{\n        type            fixedValue;\n        value           ".encode()
        parts.append(head + value + b";\n    }\n")
    body = b"dimensions      [0 1 0 0 0 0 0];\n\ninternalField   uniform (0 0 0);\n\nboundaryField\n{\n"
    return _header("pointVectorField", location, POINT_DISPLACEMENT) + body + b"".join(parts) + b"}\n"


def in_order(corners: Ints) -> Ints:
    """The points of a patch in the order of their first appearance in its faces."""
    found, first = np.unique(corners, return_index=True)
    return found[np.argsort(first)]


def _keyword(name: str) -> str:
    """A patch's name as the key of an entry: in quotes it would be a pattern."""
    return name if re.fullmatch(r"[A-Za-z_][\w.:+-]*", name) else f'"{re.escape(name)}"'


def _header(kind: str, location: str, name: str) -> bytes:
    return (
        f"FoamFile\n{{\n    version     2.0;\n    format      ascii;\n    class       {kind};\n"
        f'    location    "{location}";\n    object      {name};\n}}\n\n'
    ).encode()


def _listed(values: Array) -> bytes:
    rows = "\n".join(f"({x!r} {y!r} {z!r})" for x, y, z in values.tolist())
    return f"{len(values)}\n(\n{rows}\n)".encode()
