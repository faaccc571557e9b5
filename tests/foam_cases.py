"""OpenFOAM cases of a box of hexahedra, written anew: ASCII or binary, labels of 32 or 64 bits, gzip or not."""

from __future__ import annotations

import dataclasses
import gzip
from pathlib import Path

import numpy as np

PATCHES = {  # by side: axis and end
    "inlet": (0, 0),
    "outlet": (0, 1),
    "symmetry": (1, 0),
    "far": (1, 1),
    "bottom": (2, 0),
    "lid": (2, 1),
}
TYPES = {
    "inlet": "patch",
    "outlet": "patch",
    "symmetry": "symmetryPlane",
    "far": "patch",
    "bottom": "wall",
    "lid": "wall",
    "body": "wall",
}
DICTIONARY = """FoamFile { version 2.0; format ascii; class dictionary; object optimisationDict; }
// a comment with { and ;
area yes;
optimisation
{
    sensitivities
    {
        type %(type)s; /* of the adjoint */
        patches (lid);
        %(area)s
    }
}
"""


@dataclasses.dataclass(frozen=True)
class Box:
    """The mesh of a box [0, 4] x [0, 1] x [0, 1], as polyMesh has it."""

    points: np.ndarray
    faces: list[list[int]]
    owner: np.ndarray
    neighbour: np.ndarray
    patches: dict[str, tuple[int, int]]  # start, size

    def corners(self, name: str) -> list[list[int]]:
        """The faces of a patch."""
        start, size = self.patches[name]
        return self.faces[start : start + size]


def box(nx: int = 6, ny: int = 3, nz: int = 3) -> Box:
    """The box with an uneven lid, so that no two coordinates are round."""
    axes = [np.linspace(0.0, length, n + 1) for length, n in ((4.0, nx), (1.0, ny), (1.0, nz))]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    points[..., 2] *= 1.0 + 0.1 * np.sin(points[..., 0]) / 3.0
    points = points.reshape(-1, 3)

    def at(i: int, j: int, k: int) -> int:
        return (i * (ny + 1) + j) * (nz + 1) + k

    def cell(i: int, j: int, k: int) -> int:
        return (i * ny + j) * nz + k

    inner, outer = [], {name: [] for name in PATCHES}
    size = (nx, ny, nz)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                for axis in range(3):
                    for end in (0, 1):
                        low = [i, j, k]
                        low[axis] += end
                        a, b = [x for x in range(3) if x != axis]
                        ring = []
                        for s, t in ((0, 0), (1, 0), (1, 1), (0, 1)):
                            corner = list(low)
                            corner[a] += s
                            corner[b] += t
                            ring.append(at(*corner))
                        if (axis == 1) != (end == 0):  # outwards
                            ring = ring[::-1]
                        there = [i, j, k]
                        there[axis] += 1 if end else -1
                        if 0 <= there[axis] < size[axis]:
                            if end:
                                inner.append((cell(i, j, k), cell(*there), ring))
                        else:
                            name = next(n for n, side in PATCHES.items() if side == (axis, end))
                            outer[name].append((cell(i, j, k), ring))
    inner.sort(key=lambda face: face[:2])
    faces, owner, patches = [face[2] for face in inner], [face[0] for face in inner], {}
    for name, own in outer.items():
        patches[name] = (len(faces), len(own))
        faces += [ring for _, ring in own]
        owner += [first for first, _ in own]
    return Box(points, faces, np.array(owner), np.array([face[1] for face in inner]), patches)


def renumbered(mesh: Box, cell: int) -> Box:
    """The mesh with a cell as the last one; faces are wound from the lower to the higher number."""
    last = int(max(mesh.owner.max(), mesh.neighbour.max()))
    numbers = np.arange(last + 1)
    numbers[cell + 1 :] -= 1
    numbers[cell] = last
    owner, neighbour = numbers[mesh.owner], numbers[mesh.neighbour]
    faces = [list(face) for face in mesh.faces]
    for i, own in enumerate(neighbour):
        if owner[i] > own:
            owner[i], neighbour[i] = own, owner[i]
            faces[i] = faces[i][::-1]
    return Box(mesh.points, faces, owner, neighbour, mesh.patches)


def hollow(mesh: Box, cell: int) -> Box:
    """The mesh without a cell in its inside, whose faces become the patch `body`, the last one."""
    last, inner = renumbered(mesh, cell), len(mesh.neighbour)
    gone = last.neighbour == last.neighbour.max()
    hole = np.flatnonzero(gone)
    kept = [*np.flatnonzero(~gone), *range(inner, len(last.faces)), *hole]
    patches = {name: (start - len(hole), size) for name, (start, size) in last.patches.items()}
    patches["body"] = (len(last.faces) - len(hole), len(hole))
    return Box(last.points, [last.faces[i] for i in kept], last.owner[kept], last.neighbour[~gone], patches)


@dataclasses.dataclass(frozen=True)
class Form:
    """How numbers are written."""

    binary: bool = False
    packed: bool = False
    label: int = 32
    scalar: int = 64
    order: str = "LSB"

    def write(self, path: Path, kind: str, parts: list[tuple[str, np.ndarray | None]]) -> None:
        """Write a file: pieces of text, each perhaps followed by a list."""
        arch = f'arch "{self.order};label={self.label};scalar={self.scalar}"; ' if self.binary else ""
        form = "binary" if self.binary else "ascii"
        head = f"FoamFile {{ version 2.0; format {form}; class {kind}; {arch}object {path.name}; }}"
        content = f"/* banner */\n{head}\n".encode()
        for text, values in parts:
            content += text.encode() + (b"" if values is None else self._list(values))
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.packed:
            path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(content))
        else:
            path.write_bytes(content)

    def _list(self, values: np.ndarray) -> bytes:
        values = np.asarray(values)
        if not self.binary:
            rows = [f"({' '.join(map(repr, row))})" if isinstance(row, list) else repr(row) for row in values.tolist()]
            return f"{len(values)}\n(\n".encode() + "\n".join(rows).encode() + b"\n)\n"
        sign = "<" if self.order == "LSB" else ">"
        kind = f"{sign}i{self.label // 8}" if values.dtype.kind == "i" else f"{sign}f{self.scalar // 8}"
        return f"{len(values)}\n(".encode() + values.astype(kind).tobytes() + b")\n"


def write_mesh(root: Path, mesh: Box, form: Form = Form(), types: dict[str, str] | None = None) -> None:
    """Write constant/polyMesh."""
    where = root / "constant" / "polyMesh"
    form.write(where / "points", "vectorField", [("", mesh.points)])
    if form.binary:
        starts = np.cumsum([0, *(len(face) for face in mesh.faces)])
        flat = np.array([corner for face in mesh.faces for corner in face])
        form.write(where / "faces", "faceCompactList", [("", starts), ("", flat)])
    else:
        rows = "\n".join(f"{len(face)}({' '.join(map(str, face))})" for face in mesh.faces)
        form.write(where / "faces", "faceList", [(f"{len(mesh.faces)}\n(\n{rows}\n)\n", None)])
    form.write(where / "owner", "labelList", [("", mesh.owner)])
    form.write(where / "neighbour", "labelList", [("", mesh.neighbour)])
    kinds = {**TYPES, **(types or {})}
    entries = "".join(
        f"    {name}\n    {{\n        type {kinds[name]};\n        inGroups 1({kinds[name]});\n"
        f"        nFaces {size};\n        startFace {start};\n    }}\n"
        for name, (start, size) in mesh.patches.items()
    )
    Form(packed=form.packed).write(
        where / "boundary", "polyBoundaryMesh", [(f"{len(mesh.patches)}\n(\n{entries})\n", None)]
    )
    (root / "system").mkdir(exist_ok=True)


def write_dictionary(root: Path, kind: str = "surfacePoints", area: str = "includeSurfaceArea $area;") -> None:
    """Write system/optimisationDict."""
    (root / "system").mkdir(parents=True, exist_ok=True)
    (root / "system" / "optimisationDict").write_text(DICTIONARY % {"type": kind, "area": area})


def write_points_field(root: Path, time: str, name: str, values: np.ndarray, form: Form = Form()) -> None:
    """Write a field of points."""
    vector = values.ndim > 1
    kind = "pointVectorField" if vector else "pointScalarField"
    head = f"dimensions [0 0 0 0 0 0 0];\ninternalField nonuniform List<{'vector' if vector else 'scalar'}>\n"
    tail = ';\nboundaryField { ".*" { type calculated; } }\n'
    form.write(root / time / name, kind, [(head, values), (tail, None)])


def write_faces_field(root: Path, time: str, name: str, of_patches: dict[str, np.ndarray], form: Form = Form()) -> None:
    """Write a volume field with values on some patches."""
    vector = next(iter(of_patches.values())).ndim > 1
    kind, entry = ("volVectorField", "vector") if vector else ("volScalarField", "scalar")
    zero = "(0 0 0)" if vector else "0"
    parts: list[tuple[str, np.ndarray | None]] = [
        (f"dimensions [0 0 0 0 0 0 0];\ninternalField uniform {zero};\nboundaryField\n{{\n", None),
        ("inlet { type calculated; }\n", None),
    ]
    for name_of, values in of_patches.items():
        parts += [
            (f"{name_of}\n{{\n    type calculated;\n    value nonuniform List<{entry}> ", values),
            (";\n}\n", None),
        ]
    parts.append(
        (f"symmetry {{ type symmetryPlane; }}\nbottom {{ type calculated; value uniform {zero}; }}\n}}\n", None)
    )
    form.write(root / time / name, kind, parts)
