"""Files as people's programs write them: template, target and apply see the same mesh, or one clear line."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from rbfevo import meshes
from rbfevo.commands.mesh_report import reported
from rbfevo.errors import UserError
from rbfevo.meshes import __main__ as report
from rbfevo.meshes import cells, polygons
from rbfevo.scenarios.reading import read_surface
from rbfevo.scenarios.templates import read_template


def ring(n: int = 8, rows: int = 3) -> tuple[np.ndarray, list[list[int]], list[list[int]]]:
    """A closed barrel: vertices, its caps' triangles and its side's quadrilaterals, wound outwards."""
    turn = 2 * np.pi * np.arange(n) / n
    points = [[0.0, 0.0, -1.5]]
    for row in range(rows):
        radius = 1.0 + 0.25 * (row % 2)
        points += np.column_stack([radius * np.cos(turn), 0.5 * radius * np.sin(turn), np.full(n, row - 1.0)]).tolist()
    points.append([0.25, 0.0, 1.5])
    at = lambda row, i: 1 + row * n + i % n  # noqa: E731
    caps = [[0, at(0, i + 1), at(0, i)] for i in range(n)] + [
        [len(points) - 1, at(rows - 1, i), at(rows - 1, i + 1)] for i in range(n)
    ]
    sides = [[at(j, i), at(j, i + 1), at(j + 1, i + 1), at(j + 1, i)] for j in range(rows - 1) for i in range(n)]
    return np.round(points, 7), caps, sides


POINTS, CAPS, SIDES = ring()
FACES = CAPS + SIDES
# A prism with the outline of a U: two concave ends of eight corners, area 22.
U = np.array([[x, y, z] for z in (0.0, 1) for x, y in ((0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3))])
PRISM = [list(range(7, -1, -1)), list(range(8, 16)), *([i, (i + 1) % 8, (i + 1) % 8 + 8, i + 8] for i in range(8))]


def area(points: Any, triangles: Any) -> float:
    a, b, c = np.moveaxis(np.asarray(points)[triangles], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


def exact(points: Any, faces: list[list[int]]) -> float:
    """The area of planar polygons, by their outlines; a warped quadrilateral by its first diagonal."""
    total = 0.0
    for face in faces:
        p = np.asarray(points)[face]
        if len(face) == 4:
            total += area(p, np.array([[0, 1, 2], [0, 2, 3]]))
        else:
            total += float(np.linalg.norm(np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0)) / 2.0)
    return total


AREA = exact(POINTS, FACES)
PLAIN = [" ".join(map(repr, point)) for point in POINTS.tolist()]
COMMAS = [", ".join(map(repr, point)) for point in POINTS.tolist()]


def numbered(rows: list[list[int]], first: int, between: str = " ", base: int = 1) -> list[str]:
    return [between.join(map(str, [k + first, *(i + base for i in row)])) for k, row in enumerate(rows)]


def obj(
    faces: list[list[int]], corner: Callable[[int], str], end: str = "\n", points: list[str] | None = None
) -> bytes:
    lines = ["# by hand", "mtllib a.mtl", *(f"v {p}" for p in points or PLAIN), "vt 0.5 0.5", "vn 0 0 1", "g skin"]
    return end.join([*lines, *("f " + " ".join(map(corner, face)) for face in faces), ""]).encode()


def ply(faces: list[list[int]], points: list[str]) -> bytes:
    head = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property double {a}" for a in "xyz")]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join([*head, *points, *(f"{len(f)} {' '.join(map(str, f))}" for f in faces), ""]).encode()


def nastran(card: Callable[[str, list[Any]], str], *, head: str = "BEGIN BULK", tail: str = "ENDDATA") -> bytes:
    lines = [head] * bool(head)
    lines += [card("GRID", [i + 1, "", *point]) for i, point in enumerate(POINTS.tolist())]
    lines += [card("CTRIA3", [i + 1, 7, *(k + 1 for k in face), 0.5]) for i, face in enumerate(CAPS)]
    lines += [card("CQUAD4", [i + 101, 8, *(k + 1 for k in face), 3, 0.25]) for i, face in enumerate(SIDES)]
    return "\n".join([*lines, tail, ""]).encode()


def free(name: str, fields: list[Any]) -> str:
    return ",".join([name, *(str(field) for field in fields)])


def small(name: str, fields: list[Any]) -> str:
    return f"{name:<8}" + "".join(f"{field!s:>8.8}" for field in fields)


def large(name: str, fields: list[Any]) -> str:
    padded = [f"{field!s:>16.16}" for field in fields] + [" " * 16] * (-len(fields) % 4)
    rows = ["".join(padded[i : i + 4]) for i in range(0, len(padded), 4)]
    return f"{name + '*':<8}" + "\n*       ".join(rows)


def mixed(name: str, fields: list[Any]) -> str:
    return (large if name == "GRID" or fields[0] % 2 else small)(name, fields)


def abaqus(*blocks: str) -> bytes:
    return "\n".join(["*Heading", "** by hand", *blocks, ""]).encode()


NODES = "\n".join(f"{i + 1}, {p}" for i, p in enumerate(COMMAS))
SHELLS = "\n".join(
    [
        "*Element, type=S3R, elset=caps",
        *numbered(CAPS, 1, ", "),
        "*ELEMENT, TYPE=S4R, ELSET=sides",
        *numbered(SIDES, 101, ", "),
    ]
)
GMSH_ELEMENTS = [f"{i + 1} 2 2 4 1 {' '.join(str(k + 1) for k in f)}" for i, f in enumerate(CAPS)]
GMSH_ELEMENTS += [f"{i + 101} 3 2 5 2 {' '.join(str(k + 1) for k in f)}" for i, f in enumerate(SIDES)]


def gmsh22(nodes: list[str], section: str = "Nodes") -> bytes:
    return "\n".join(
        [
            "$MeshFormat",
            "2.2 0 8",
            "$EndMeshFormat",
            "$PhysicalNames",
            "2",
            '2 4 "caps"',
            '2 5 "sides"',
            "$EndPhysicalNames",
            f"${section}",
            str(len(nodes)),
            *nodes,
            f"$End{section}",
            "$Elements",
            str(len(GMSH_ELEMENTS)),
            *GMSH_ELEMENTS,
            "$EndElements",
            "",
        ]
    ).encode()


def gmsh41(parametric: bool = False) -> bytes:
    n, uv = len(POINTS), " 0.5 0.25" * parametric
    return "\n".join(
        [
            "$MeshFormat",
            "4.1 0 8",
            "$EndMeshFormat",
            "$PhysicalNames",
            "2",
            '2 4 "caps"',
            '2 5 "all"',
            "$EndPhysicalNames",
        ]
        + ["$Entities", "0 0 2 0", "1 -1 -1 -1 1 1 1 2 4 5 0", "2 -1 -1 -1 1 1 1 1 5 0", "$EndEntities"]
        + ["$Nodes", f"1 {n} 1 {n}", f"2 1 {int(parametric)} {n}", *(str(i + 1) for i in range(n))]
        + [p + uv for p in PLAIN]
        + ["$EndNodes", "$Elements", f"2 {len(FACES)} 1 200", f"2 1 2 {len(CAPS)}", *numbered(CAPS, 1)]
        + [f"2 2 3 {len(SIDES)}", *numbered(SIDES, 101), "$EndElements", ""]
    ).encode()


def su2(end: str = "\n", equals: str = "= ", trailing: bool = False) -> bytes:
    row = [f"5 {' '.join(map(str, f))}" for f in CAPS] + [f"9 {' '.join(map(str, f))}" for f in SIDES]
    lines = ["% by hand", f"NDIME{equals}3", f"NELEM{equals}{len(row)}"]
    lines += [f"{r} {i}" if trailing else r for i, r in enumerate(row)]
    lines += [f"NPOIN{equals}{len(PLAIN)} {len(PLAIN)}", *(f"{p}\t{i}" for i, p in enumerate(PLAIN))]
    lines += [f"NMARK{equals}2", f"MARKER_TAG{equals}caps", f"MARKER_ELEMS{equals}{len(CAPS)}", *row[: len(CAPS)]]
    lines += [f"MARKER_TAG{equals}SEND_RECEIVE", f"MARKER_ELEMS{equals}2", f"SEND_TO{equals}1", "1 0 0", "1 1 0"]
    lines += [f"FFD_NBOX{equals}1", f"FFD_TAG{equals}BOX", f"FFD_CORNER_POINTS{equals}2", "0 0 0", "1 0 0"]
    return end.join([*lines, ""]).encode()


def kratos(block: str, three: str, four: str) -> bytes:
    rows = [f"{i + 1} 0 {' '.join(str(k + 1) for k in f)}" for i, f in enumerate(CAPS)]
    other = [f"{i + 101} 0 {' '.join(str(k + 1) for k in f)}" for i, f in enumerate(SIDES)]
    return "\n".join(
        ["Begin ModelPartData", "// by hand", "End ModelPartData", "Begin Nodes"]
        + [f"{i + 1} {p}" for i, p in enumerate(PLAIN)]
        + [
            "End Nodes",
            f"Begin {block} {three}",
            *rows,
            f"End {block}",
            f"Begin {block} {four}",
            *other,
            f"End {block}",
        ]
        + ["Begin SubModelPart skin", f"Begin SubModelPart{block}", "1", "2", f"End SubModelPart{block}"]
        + ["End SubModelPart", ""]
    ).encode()


WHOLE: dict[str, bytes] = {
    "plain.obj": obj(FACES, lambda i: str(i + 1)),
    "v_vt_vn.obj": obj(FACES, lambda i: f"{i + 1}/1/1"),
    "v_vn.obj": obj(FACES, lambda i: f"{i + 1}//1"),
    "v_vt.obj": obj(FACES, lambda i: f"{i + 1}/1"),
    "backwards.obj": obj(FACES, lambda i: f"{i - len(POINTS)}/-1/-1"),
    "cr.obj": obj(FACES, lambda i: f"{i + 1}/1/1", "\r"),
    "crlf.obj": obj(FACES, lambda i: f"{i + 1}/1/1", "\r\n").replace(b"f ", b"f\t"),
    "bom.obj": b"\xef\xbb\xbf" + obj(FACES, lambda i: f"{i + 1}"),
    "continued.obj": obj(FACES, lambda i: f"{i + 1}/1/1").replace(b"f ", b"f \\\n "),
    "colours.obj": obj(FACES, lambda i: str(i + 1), points=[f"{p} 1 0.5 0" for p in PLAIN]),
    "barrel.ply": ply(FACES, PLAIN),
    "crlf.ply": ply(FACES, PLAIN).replace(b"\n", b"\r\n"),
    "free.bdf": nastran(free),
    "lower.bdf": nastran(free).lower(),
    "nobulk.bdf": nastran(free, head="$ by hand", tail=""),
    "small.nas": nastran(small),
    "large.nas": nastran(large),
    "mixed.fem": nastran(mixed),
    "flat.inp": abaqus("*Node, nset=all", NODES, SHELLS, "*Elset, elset=whole", "caps, sides"),
    "split.inp": abaqus("*NODE", NODES[: NODES.index("\n5,")], "*NODE", NODES[NODES.index("\n5,") + 1 :], SHELLS),
    "one_part.inp": abaqus(
        "*Part, name=A", "*Node", NODES, SHELLS, "*End Part", "*Assembly", "*Instance, part=A, name=I"
    ),
    "plain22.msh": gmsh22([f"{i + 1} {p}" for i, p in enumerate(PLAIN)]),
    "parametric22.msh": gmsh22([f"{i + 1} {p} 2 1 0.5 0.25" for i, p in enumerate(PLAIN)], "ParametricNodes"),
    "plain41.msh": gmsh41(),
    "parametric41.msh": gmsh41(parametric=True),
    "plain.su2": su2(),
    "crlf.su2": su2("\r\n", " = ", trailing=True),
    "shell.mdpa": kratos("Elements", "ShellThinElement3D3N", "ShellThinElement3D4N"),
    "conditions.mdpa": kratos("Conditions", "LoadCondition3D3N", "LoadCondition3D4N"),
    "geometries.off": "\n".join(
        ["OFF", f"{len(PLAIN)} {len(FACES)} 0", *PLAIN, *(f"{len(f)} {' '.join(map(str, f))}" for f in FACES), ""]
    ).encode(),
}
ROUNDED = {"small.nas": 1e-5, "large.nas": 1e-12, "free.bdf": 1e-12, "lower.bdf": 1e-12, "nobulk.bdf": 1e-12}
ROUNDED["mixed.fem"] = 1e-12


def bend(points: Any) -> Any:
    x, y, z = np.asarray(points, np.float64).T
    return np.stack([0.1 * y * z + 1 / 3, 0.2 * np.sin(x), 0.05 * x * x], axis=1)


@pytest.mark.parametrize("name", WHOLE)
def test_template_target_and_apply_see_the_same_mesh(name: str, tmp_path: Path) -> None:
    path, out = tmp_path / name, tmp_path / f"out{Path(name).suffix}"
    path.write_bytes(WHOLE[name])
    accuracy = ROUNDED.get(name, 0.0)
    template = read_template(path)
    np.testing.assert_allclose(template.vertices, POINTS, atol=accuracy, rtol=0)
    assert area(template.vertices, template.triangles) == pytest.approx(AREA, abs=1e-4)
    assert len(template.triangles) == len(CAPS) + 2 * len(SIDES)
    points, triangles = read_surface(path)
    np.testing.assert_array_equal(points, template.vertices)
    assert triangles is not None
    once = np.sort(np.unique(triangles, return_index=True, axis=0)[1])  # SU2 names a marker's elements twice
    np.testing.assert_array_equal(triangles[once], template.triangles)
    with meshes.opened(path) as mesh:
        displacement = bend(mesh.points)
        meshes.write(mesh, path, mesh.points + displacement, displacement, out)
    again = read_template(out)
    np.testing.assert_allclose(again.vertices, points + bend(points), atol=accuracy, rtol=0)
    np.testing.assert_array_equal(again.triangles, template.triangles)
    # All else stays: without their numbers with a point, the two files are the same, but for Nastran's fields.
    if Path(name).suffix not in (".bdf", ".nas", ".fem"):
        number = re.compile(rb"-?\d+\.\d*(?:e-?\d+)?")
        assert number.sub(b"@", out.read_bytes()) == number.sub(b"@", WHOLE[name])
    else:
        others = [
            [line for line in content.splitlines() if line[:4].upper() not in (b"GRID", b"*   ")]
            for content in (out.read_bytes(), WHOLE[name])
        ]
        assert others[0] == others[1]


def test_large_fields_of_nastran_keep_all_but_the_coordinates(tmp_path: Path) -> None:
    """Names of continuations, other systems of displacements, and blanks."""
    grid = "GRID*   {0:>16}                {1:>16}{2:>16}*G{0}\n*G{0:<6}{3:>16}               3\n"
    content = "".join(grid.format(i + 1, *point) for i, point in enumerate([[0.0, 0, 0], [1.5, 0, 0], [0, 2.5, 0]]))
    path, out = tmp_path / "a.bdf", tmp_path / "b.bdf"
    path.write_text(f"BEGIN BULK\n{content}CTRIA3,1,1,1,2,3\nENDDATA\n")
    with meshes.opened(path) as mesh:
        meshes.write(mesh, path, mesh.points + 1.0, 0.0 * mesh.points, out)
    moved = "".join(grid.format(i + 1, *point) for i, point in enumerate([[1.0, 1, 1], [2.5, 1, 1], [1, 3.5, 1]]))
    number = re.compile(r"(?<= )-?\d+(?:\.\d*)?")
    assert number.sub("@", out.read_text()).split() == number.sub("@", path.read_text()).split()
    assert [float(n) for n in number.findall(out.read_text())] == [
        float(n) for n in number.findall(f"BEGIN BULK\n{moved}CTRIA3,1,1,1,2,3\nENDDATA\n")
    ]


PATCHES = {
    "v_vt_vn.obj": {"skin": len(FACES)},
    "free.bdf": {"property 7": len(CAPS), "property 8": len(SIDES)},
    "flat.inp": {"caps": len(CAPS), "sides": len(SIDES), "whole": len(FACES)},
    "plain22.msh": {"caps": len(CAPS), "sides": len(SIDES)},
    "plain41.msh": {"caps": len(CAPS), "all": len(FACES)},
    "crlf.su2": {"caps": len(CAPS)},
    "shell.mdpa": {"skin": 2},
}


@pytest.mark.parametrize("name", PATCHES)
def test_patches_are_named_and_chosen(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(WHOLE[name])
    assert reported(path)["patches"] == PATCHES[name]
    first = next(iter(PATCHES[name]))
    template = read_template(path, [first])
    expected = FACES if first == "skin" and name.endswith("obj") else CAPS[: PATCHES[name][first]]
    assert area(template.vertices, template.triangles) == pytest.approx(exact(POINTS, expected), abs=1e-6)
    with pytest.raises(UserError, match=f"there is no such patch.*there are {first}"):
        read_template(path, ["hull"])


def test_numbers_of_nodes_are_those_of_the_file(tmp_path: Path) -> None:
    order = np.random.default_rng(0).permutation(len(POINTS))
    path = tmp_path / "a.msh"
    content = gmsh22([f"{10 * i + 7} {PLAIN[i]}" for i in order])
    path.write_bytes(
        re.sub(
            rb"(?m)^(\d+ [23] 2 \d \d) ([\d ]+)$",
            lambda m: m[1] + b" " + b" ".join(b"%d" % (10 * int(k) - 3) for k in m[2].split()),
            content,
        )
    )
    template = read_template(path)
    np.testing.assert_array_equal(template.vertices, POINTS[order])
    assert template.numbers is not None
    np.testing.assert_array_equal(template.numbers, 10 * order + 7)
    assert area(template.vertices, template.triangles) == pytest.approx(AREA)


CONCAVE: dict[str, Callable[[Path], Any]] = {
    "a.obj": lambda path: (
        path.write_bytes(obj(PRISM, lambda i: f"{i + 1}/1/1", points=[" ".join(map(repr, p)) for p in U.tolist()]))
        and None
    ),
    "a.ply": lambda path: path.write_bytes(ply(PRISM, [" ".join(map(repr, p)) for p in U.tolist()])),
    "a.off": lambda path: (
        path.write_text(
            "\n".join(
                ["OFF", f"{len(U)} {len(PRISM)} 0", *(" ".join(map(repr, p)) for p in U.tolist())]
                + [f"{len(f)} {' '.join(map(str, f))}" for f in PRISM]
            )
        )
        and None
    ),
    "a.vtp": lambda path: pyvista.PolyData(U, faces=[k for f in PRISM for k in (len(f), *f)]).save(path),
    "a.vtu": lambda path: (
        pyvista.PolyData(U, faces=[k for f in PRISM for k in (len(f), *f)]).cast_to_unstructured_grid().save(path)
    ),
}


@pytest.mark.parametrize("name", CONCAVE)
def test_concave_polygons_are_covered_once(name: str, tmp_path: Path) -> None:
    CONCAVE[name](tmp_path / name)
    found = reported(tmp_path / name)
    assert found["area"] == pytest.approx(22.0 + 8.0)
    assert found["volume"] == pytest.approx(7.0)


@settings(max_examples=60)
@given(
    radii=st.lists(st.floats(0.2, 3.0), min_size=3, max_size=12),
    normal=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: np.linalg.norm(n) > 0.1),
    turned=st.booleans(),
)
def test_any_star_shaped_polygon_is_covered_once(radii: list[float], normal: Any, turned: bool) -> None:
    """By the formula of the outline, in any plane, from any corner."""
    turn = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.array(radii)[:, None] * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    axes = np.linalg.qr(np.column_stack([normal, np.eye(3)[:, :2] + 0.1]))[0]
    points = flat @ axes.T + 5.0
    corners = np.arange(len(radii))[:: -1 if turned else 1]
    cut, owner = polygons.triangles(points, np.array([len(radii)]), corners)
    whole = np.cross(points[corners] - 5.0, np.roll(points[corners], -1, axis=0) - 5.0).sum(axis=0) / 2.0
    a, b, c = np.moveaxis(points[cut], 1, 0)
    parts = np.cross(b - a, c - a) / 2.0
    assert len(cut) == len(radii) - 2
    np.testing.assert_allclose(parts.sum(axis=0), whole, atol=1e-9)
    assert np.linalg.norm(parts, axis=1).sum() == pytest.approx(np.linalg.norm(whole))
    assert (owner == 0).all()


BOX: Any = trimesh.creation.box()
REFUSED: dict[str, tuple[bytes, str]] = {
    "comma.obj": (b"v 0,5 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "point 0 (from 0) has a decimal comma, '0,5'"),
    "surf.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\ncstype bezier\nsurf 0 1 0 1 1 2 3\n", "2 of its lines are free-form"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "a face has the corner 0"),
    "far.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 9\n", "1 of its 2 faces or cells refer to a point"),
    "star.obj": (
        b"".join(b"v %f %f 0\n" % (np.cos(4 * np.pi * i / 5), np.sin(4 * np.pi * i / 5)) for i in range(5))
        + b"f 1 2 3 4 5\n",
        "1 of its polygons cross themselves",
    ),
    "short.stl": (b"\0" * 80 + struct.pack("<I", 2) + b"\0" * 50, "2 facets, 134 bytes"),
    "unknown.bdf": (nastran(free).replace(b"CTRIA3,1,", b"CTRIAX6,1,"), "elements that are not read: 1 CTRIAX6"),
    "system.bdf": (
        nastran(free).replace(b"GRID,3,,", b"GRID,3,5,"),
        "1 of its 26 GRID points lie in coordinate systems",
    ),
    "include.bdf": (b"INCLUDE 'other.bdf'\n" + nastran(free, head=""), "includes other files"),
    "few.bdf": (nastran(free).replace(b"CTRIA3,1,7,1,3,2", b"CTRIA3,1,7,1,3,"), "CTRIA3 1 has fewer nodes"),
    "unknown.inp": (abaqus("*Node", NODES, "*Element, type=XYZ3", "1, 1, 2, 3", "2, 1, 2, 3"), "not read: 2 XYZ3"),
    "generated.inp": (abaqus("*Node", NODES, "*NGEN", "1, 5"), "it uses *NGEN"),
    "moved.inp": (
        abaqus("*Part, name=A", "*Node", NODES, SHELLS, "*End Part", "*Assembly", "*Instance, part=A", "1., 0., 0."),
        "its instances move parts",
    ),
    "lost.inp": (abaqus("*Node", NODES, "*Element, type=S3", "1, 1, 2, 999"), "1 nodes that are not there, as 999"),
    "short.inp": (abaqus("*Node", NODES, "*Element, type=S8R", "1, 1, 2, 3, 4"), "has 4 nodes instead of 8"),
    "zones.su2": (b"NZONE= 2\n" + su2(), "several zones"),
    "more.su2": (su2().replace(b"NELEM= 32", b"NELEM= 31"), "NELEM announces fewer lines than there are"),
    "type.su2": (su2().replace(b"NELEM= 32\n5 ", b"NELEM= 32\n7 "), "the type 7, which SU2's format does not have"),
    "old.msh": (b"$MeshFormat\n4.0 0 8\n$EndMeshFormat\n", "version 4.0; versions 2 and 4.1 are read"),
    "short.msh": (gmsh41().replace(b"2 1 2 16", b"2 1 2 15"), "$Elements"),
    "kind.mdpa": (kratos("Elements", "Strange3D3N", "Odd3D7N"), "elements that are not read: 16 Odd3D7N"),
    "ffd.xyz": (b"1\n2 2 2\n" + b"0 1 0 1 0 1 0 1\n" * 3, "PLOT3D lattice (2 x 2 x 2 points)"),
    "two.csv": (b"x,y,value\n1,2,3\n4,5,6\n", "does not name x, y and z"),
    "word.csv": (b"x,y,z\n1,2,3\n4,a,6\n", "row 1 (from 0) has 'a' where a number is expected"),
    "cut.glb": (bytes(BOX.export(file_type="glb"))[:-40], "cut off: it announces"),
    "line.obj": (b"v 0 0 0\nv 1 0 0\nl 1 2\n", "holds a curve (1 lines) and no faces"),
    "other.vtu": (b"<VTKFile type='Nonsense'></VTKFile>", "not one of VTK's XML files"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_whole_is_refused_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content, message = REFUSED[name]
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(UserError) as caught:
        read_template(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    if name != "line.obj":  # a curve has points to move
        assert report.main([str(path)]) == 2
        err = capsys.readouterr().err
        assert message in err
        assert len(err.splitlines()) == 1


def scene(*nodes: dict[str, Any]) -> bytes:
    """A GLB whose nodes share one mesh, of the barrel's caps."""
    points, corners = POINTS.astype("<f4").tobytes(), np.array(CAPS, "<u4").tobytes()
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": len(POINTS), "type": "VEC3"}
        | {"min": POINTS.min(axis=0).tolist(), "max": POINTS.max(axis=0).tolist()},
        {"bufferView": 1, "componentType": 5125, "count": 3 * len(CAPS), "type": "SCALAR"},
    ]
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": len(points)}]
    views.append({"buffer": 0, "byteOffset": len(points), "byteLength": len(corners)})
    head = json.dumps(
        {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes}
        | {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}], "accessors": accessors}
        | {"bufferViews": views, "buffers": [{"byteLength": len(points) + len(corners)}]}
    ).encode()
    head += b" " * (-len(head) % 4)
    body = points + corners
    total = 28 + len(head) + len(body)
    return struct.pack("<4sII", b"glTF", 2, total) + b"".join(
        struct.pack("<I4s", len(part), kind) + part for part, kind in ((head, b"JSON"), (body, b"BIN\0"))
    )


def test_glb_has_the_order_of_its_nodes(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    nodes = [{"mesh": 0, "name": "a", "translation": [k, 0, 0]} for k in (0.0, 4.0, 8.0)]
    path.write_bytes(scene(*nodes))
    with meshes.opened(path) as mesh:
        n = len(POINTS)
        assert [mesh.points[k * n, 0] for k in range(3)] == [0.0, 4.0, 8.0]
        meshes.write(mesh, path, mesh.points + 1.0, 0.0 * mesh.points, tmp_path / "b.glb")
    with meshes.opened(tmp_path / "b.glb") as again:
        np.testing.assert_allclose(again.points, mesh.points + 1.0, atol=1e-6)
        np.testing.assert_array_equal(again.cells.corners, mesh.cells.corners)
    names = scene({"mesh": 0, "name": "left"}, {"mesh": 0, "name": "right", "translation": [9, 0, 0]})
    path.write_bytes(names)
    assert reported(path)["patches"] == {"left": len(CAPS), "right": len(CAPS)}


def test_files_of_several_parts(tmp_path: Path) -> None:
    """A multi-block file, a parallel one and an EnSight case: all parts, one after another."""
    for name, shift in (("one", 0.0), ("two", 5.0)):
        faces = [k for face in CAPS for k in (3, *face)]
        pyvista.PolyData(np.add(POINTS, [shift, 0, 0]), faces=faces).save(tmp_path / f"{name}.vtp")
    blocks = "".join(f'<DataSet index="{i}" name="{n}" file="{n}.vtp"/>' for i, n in enumerate(("one", "two")))
    kind = "vtkMultiBlockDataSet"
    (tmp_path / "a.vtm").write_text(f'<VTKFile type="{kind}" version="1.0"><{kind}>{blocks}</{kind}></VTKFile>')
    pieces = "".join(f'<Piece Source="{n}.vtp"/>' for n in ("one", "two"))
    points = '<PPoints><PDataArray type="Float64" NumberOfComponents="3"/></PPoints>'
    (tmp_path / "a.pvtp").write_text(
        f'<VTKFile type="PPolyData" version="1.0"><PPolyData GhostLevel="0">{points}{pieces}</PPolyData></VTKFile>'
    )
    (tmp_path / "a.case").write_text("FORMAT\ntype: ensight gold\nGEOMETRY\nmodel: a.geo\n")
    rows = "".join(f"{value:12.5e}\n" for value in POINTS.T.ravel())
    corners = "".join("".join(f"{k + 1:10d}" for k in face) + "\n" for face in CAPS)
    (tmp_path / "a.geo").write_text(
        f"a\nb\nnode id off\nelement id off\npart\n{1:10d}\nskin\ncoordinates\n{len(POINTS):10d}\n{rows}tria3\n"
        f"{len(CAPS):10d}\n{corners}"
    )
    for name, times in (("a.vtm", 2), ("a.pvtp", 2), ("a.case", 1)):
        found = reported(tmp_path / name)
        assert (found["points"], found["triangles"]) == (times * len(POINTS), times * len(CAPS))
        assert found["area"] == pytest.approx(times * exact(POINTS, CAPS), rel=1e-5)
    assert reported(tmp_path / "a.vtm")["patches"] == {"one": len(CAPS), "two": len(CAPS)}
    with meshes.opened(tmp_path / "a.vtm") as mesh:
        meshes.write(mesh, tmp_path / "a.vtm", mesh.points + 1.0, 0.0 * mesh.points, tmp_path / "b.vtu")
    refused = pytest.raises(UserError, match=r"choose a name that ends in \.vtu")
    with meshes.opened(tmp_path / "a.vtm") as mesh, refused:
        meshes.write(mesh, tmp_path / "a.vtm", mesh.points, 0.0 * mesh.points, tmp_path / "b.vtm")
    again: Any = pyvista.read(tmp_path / "b.vtu")
    np.testing.assert_array_equal(again.points, mesh.points + 1.0)


def cgns(path: Path, families: tuple[str, ...]) -> None:
    """A CGNS file by hand: two hexahedra, the six faces of them in x = 0 and x = 2 and y = 0, and two conditions."""
    h5py = pytest.importorskip("h5py")
    text = lambda word: np.frombuffer(word, np.int8)  # noqa: E731
    kinds = {"int8": b"C1", "int32": b"I4", "float32": b"R4", "float64": b"R8"}

    def node(parent: Any, name: str, label: bytes, values: Any = None) -> Any:
        made = parent.create_group(name)
        kind = b"MT" if values is None else kinds[values.dtype.name]
        for key, word, length in (("name", name.encode(), 33), ("label", label, 33), ("type", kind, 3)):
            made.attrs.create(key, np.bytes_(word), dtype=f"S{length}")
        made.attrs["flags"] = np.array([1], np.int32)
        if values is not None:
            made[" data"] = values
        return made

    with h5py.File(path, "w") as file:
        for key, word, length in (
            ("name", b"HDF5 MotherNode", 33),
            ("label", b"Root Node of HDF5 File", 33),
            ("type", b"MT", 3),
        ):
            file.attrs.create(key, np.bytes_(word), dtype=f"S{length}")
        file[" format"] = text(b"IEEE_LITTLE_32\0")
        file[" hdf5version"] = text(b"HDF5 Version 1.14.0".ljust(33, b"\0"))
        node(file, "CGNSLibraryVersion", b"CGNSLibraryVersion_t", np.array([3.3], np.float32))
        base = node(file, "Base", b"CGNSBase_t", np.array([3, 3], np.int32))
        zone = node(base, "Zone", b"Zone_t", np.array([[12], [2], [0]], np.int32))
        node(zone, "ZoneType", b"ZoneType_t", text(b"Unstructured"))
        grid = node(zone, "GridCoordinates", b"GridCoordinates_t")
        for axis, values in zip(
            "XYZ", np.array([[i, j, k] for k in (0.0, 1) for j in (0, 1) for i in range(3)]).T, strict=True
        ):
            node(grid, f"Coordinate{axis}", b"DataArray_t", np.ascontiguousarray(values))
        hexes = [[i, i + 1, i + 4, i + 3, i + 6, i + 7, i + 10, i + 9] for i in (1, 2)]
        faces = [[1, 7, 10, 4], [3, 6, 12, 9], [1, 2, 8, 7], [2, 3, 9, 8]]
        for name, kind, first, rows in (
            ("Cells", 17, 1, hexes),
            ("inlet", 7, 3, faces[:2]),
            ("floor", 7, 5, faces[2:]),
        ):
            section = node(zone, name, b"Elements_t", np.array([kind, 0], np.int32))
            node(section, "ElementRange", b"IndexRange_t", np.array([first, first + len(rows) - 1], np.int32))
            node(section, "ElementConnectivity", b"DataArray_t", np.ravel(rows).astype(np.int32))
        conditions = node(zone, "ZoneBC", b"ZoneBC_t")
        for name, rows in (("ends", [3, 4]), ("bottom", [5, 6])):
            condition = node(conditions, name, b"BC_t", text(b"FamilySpecified" if name in families else b"BCInflow"))
            node(condition, "PointRange", b"IndexRange_t", np.array([[rows[0]], [rows[1]]], np.int32))
            node(condition, "GridLocation", b"GridLocation_t", text(b"FaceCenter"))
            if name in families:
                node(condition, "FamilyName", b"FamilyName_t", text(name.encode()))
                node(base, name, b"Family_t")


@pytest.mark.parametrize(
    ("families", "names"),
    [(("ends", "bottom"), ["ends", "bottom"]), ((), ["inlet", "floor"]), (("ends",), ["inlet", "floor"])],
)
def test_cgns_has_its_boundary_conditions_or_its_sections_as_patches(
    families: tuple[str, ...], names: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "a.cgns"
    cgns(path, families)
    with meshes.opened(path) as mesh:
        np.testing.assert_array_equal(mesh.points[:4], [[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]])
        assert sorted(mesh.patches) == sorted(names)
        assert (mesh.cells.kinds[mesh.patches[names[0]]] == 9).all()
        with pytest.raises(UserError, match=r"choose a name that ends in \.vtu"):
            meshes.write(mesh, path, mesh.points, 0.0 * mesh.points, tmp_path / "b.cgns")
    with meshes.opened(path) as mesh:
        meshes.write(mesh, path, mesh.points + 1.0, 0.0 * mesh.points + 1.0, tmp_path / "b.vtu")
    whole = reported(path)
    assert (whole["area"], whole["volume"]) == (pytest.approx(10.0), pytest.approx(2.0))
    with meshes.opened(tmp_path / "b.vtu") as again:
        np.testing.assert_array_equal(again.points, mesh.points + 1.0)
        np.testing.assert_array_equal(again.cells.corners, mesh.cells.corners)
    floor = read_template(path, patches=(names[1],))
    assert floor.vertices[:, 1].max() == 0.0
    assert area(floor.vertices, floor.triangles) == pytest.approx(2.0)


def test_a_structured_surface_has_faces(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.linspace(0, 2, 5), np.linspace(0, 1, 4))
    pyvista.StructuredGrid(x, y, 0.0 * x).save(tmp_path / "a.vts")
    assert reported(tmp_path / "a.vts")["area"] == pytest.approx(2.0)


def test_the_report_is_right_for_people_and_programs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    box: Any = pyvista.ImageData(dimensions=(3, 3, 2), spacing=(1.0, 0.5, 2.0)).cast_to_unstructured_grid()
    box.point_data["heat"] = np.r_[np.nan, np.arange(17.0)]
    box.cell_data["force"] = np.arange(12.0).reshape(4, 3)
    box.save(tmp_path / "a.vtu")
    assert report.main([str(tmp_path / "a.vtu"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cells"] == {"voxels": 4}
    assert (found["points"], found["vertices"], found["triangles"], found["pieces"]) == (18, 18, 32, 1)
    assert found["area"] == pytest.approx(2 * (2 * 1 + 2 * 2 + 1 * 2))
    assert found["volume"] == pytest.approx(4.0)
    assert found["box"] == [[0, 0, 0], [2, 1, 2]]
    assert found["arrays"] == {"heat": {"components": 1, "lowest": 0.0, "highest": 16.0, "not_finite": 1}}
    assert found["cell_arrays"]["force"] == {"components": 3, "lowest": 0.0, "highest": 11.0, "not_finite": 0}
    assert found["notes"]["volume mesh"].startswith("the boundary of 4 voxels is taken, 16 faces")
    assert report.main([str(tmp_path / "a.vtu")]) == 0
    output = capsys.readouterr().out
    assert "surface: 18 vertices, 32 triangles, 1 piece, area 16, volume 4" in output
    assert "  heat: 0 to 16, 1 rows not finite" in output
    assert report.main([str(tmp_path / "gone.vtu")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_every_kind_of_cell_is_known_by_vtk() -> None:
    """The corners of solids and their faces against VTK's own cells."""
    from vtkmodules.vtkCommonDataModel import vtkGenericCell

    for name, kinds in cells.SOLIDS.items():
        if name in ("prisms", "polyhedra"):
            continue
        cell: Any = vtkGenericCell()
        cell.SetCellType(kinds[0])
        faces = []
        for i in range(cell.GetNumberOfPoints()):
            cell.GetPointIds().SetId(i, i)
        for i in range(cell.GetNumberOfFaces()):
            face = cell.GetFace(i)
            faces.append(frozenset(face.GetPointId(k) for k in range(face.GetNumberOfPoints())))
        assert {frozenset(face) for face in cells._FACES[name]} == set(faces)
        assert cell.GetNumberOfPoints() == cells._CORNERS[kinds[0]]


def test_a_text_stl_is_written_with_numbers_that_vtk_reads(tmp_path: Path) -> None:
    corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 1e-60], [0.0, 1.0, -1e-50]]
    rows = "".join(f"vertex {x!r} {y!r} {z!r}\n" for x, y, z in corners)
    path, out = tmp_path / "a.stl", tmp_path / "b.stl"
    path.write_text(f"solid a\nfacet normal 0 0 1\nouter loop\n{rows}endloop\nendfacet\nendsolid a\n")
    with meshes.opened(path) as mesh:
        meshes.write(mesh, path, np.add(mesh.points, [2.0, 0.0, 0.0]), 0.0 * mesh.points, out)
    again: Any = pyvista.read(out)
    np.testing.assert_allclose(again.points, np.add(corners, [2.0, 0.0, 0.0]), atol=1e-7)
