"""Templates: each format's surface and arrays, what is left out and said, and one clear line for every bad file."""

import contextlib
import importlib.util
import subprocess
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from rbfevo.errors import UserError
from rbfevo.meshes import ENDINGS, OWN, FormatError, foreign
from rbfevo.meshes.worker import serve
from rbfevo.scenarios.templates import Template, read_template

BALL = trimesh.creation.icosphere(subdivisions=1, radius=3.0)
VERTICES, TRIANGLES = np.array(BALL.vertices), np.array(BALL.faces, np.int64)
HEAT = np.sin(VERTICES[:, 0])
SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
TETRA = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]])
CORNERS = "0 0 0\n2 0 0\n2 2 0\n0 2 0\n"

PLY = "ply\nformat ascii 1.0\nelement vertex {n}\nproperty double x\nproperty double y\nproperty double z\n"
PLY_FACES = "element face {f}\nproperty list uchar int vertex_indices\n"


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def write_vtk(path: Path, cells: dict[int, list[list[int]]], points: np.ndarray, **arrays: np.ndarray) -> Path:
    """An UnstructuredGrid of cells by VTK's number of their kind, written by VTK."""
    import pyvista

    listed = [(kind, cell) for kind, several in cells.items() for cell in several]
    flat = [number for _, cell in listed for number in (len(cell), *cell)]
    grid = pyvista.UnstructuredGrid(np.array(flat), np.array([kind for kind, _ in listed], np.uint8), points)
    for name, values in arrays.items():
        (grid.cell_data if len(values) == len(listed) else grid.point_data)[name] = values
    grid.save(path)
    return path


def write_meshio(path: Path, points: np.ndarray, cells: list, **arrays: np.ndarray) -> Path:
    options = {"file_format": "gmsh22" if len(cells) > 1 else "gmsh"} if path.suffix == ".msh" else {}
    meshio.write(path, meshio.Mesh(points, cells, point_data={**arrays}), **options)
    return path


def su2(points: np.ndarray, faces: np.ndarray, kind: int = 5) -> str:
    return "\n".join(
        [f"NDIME= {points.shape[1]}", f"NELEM= {len(faces)}"]
        + [f"{kind} {' '.join(map(str, face))} {k}" for k, face in enumerate(faces.tolist())]
        + [f"NPOIN= {len(points)}"]
        + [f"{' '.join(map(repr, point))} {k}" for k, point in enumerate(points.tolist())]
        + ["NMARK= 0\n"]
    )


def nastran(points: np.ndarray, faces: np.ndarray, kind: str = "CTRIA3", system: str = "") -> str:
    return "\n".join(
        ["SOL 101", "CEND", "BEGIN BULK"]
        + [f"GRID,{k + 11},{system},{','.join(map(repr, point))}" for k, point in enumerate(points.tolist())]
        + [f"{kind},{k + 1},1,{','.join(str(corner + 11) for corner in face)}" for k, face in enumerate(faces.tolist())]
        + ["ENDDATA\n"]
    )


@pytest.fixture
def here(monkeypatch) -> None:
    """Run the worker's readers in this process: a second saved for each sound file."""

    @contextlib.contextmanager
    def read(kind: str, path: Path):
        try:
            reply = serve.KINDS[kind](path).reply
        except (Exception, SystemExit) as error:
            raise FormatError(serve.problem(error)) from None
        yield foreign.mesh_of(reply, lambda *_: [], [])

    monkeypatch.setattr(foreign, "foreign", read)


def refusal(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        read_template(path)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text


def area(template: Template) -> float:
    a, b, c = np.moveaxis(template.vertices[template.triangles], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


def check_template(template: Template) -> None:
    """Assert what holds for every template, whatever its file."""
    n = len(template.vertices)
    assert template.vertices.dtype == np.float64
    assert template.triangles.dtype == template.rows.dtype == np.int64
    assert template.vertices.shape == (n, 3)
    assert np.isfinite(template.vertices).all()
    assert template.rows.shape == (n,)
    assert (np.diff(template.rows) > 0).all()
    assert template.rows[0] >= 0
    assert template.rows[-1] < template.count
    assert np.unique(template.triangles).tolist() == list(range(n))
    assert area(template) > 0.0
    for values in template.arrays.values():
        assert values.dtype == np.float64
        assert values.ndim in (1, 2)
        assert len(values) == n
    assert all("\n" not in note for note in template.notes.values())


# formats


@pytest.mark.parametrize("ending", ["ply", "obj", "off", "glb"])
def test_written_by_trimesh(tmp_path, ending):
    BALL.export(tmp_path / f"ball.{ending}")
    template = read_template(tmp_path / f"ball.{ending}")
    check_template(template)
    np.testing.assert_allclose(template.vertices, VERTICES, atol=1e-6)
    np.testing.assert_array_equal(template.triangles, TRIANGLES)
    assert (template.count, template.notes, template.arrays) == (42, {}, {})


def test_stl_is_merged_in_order_of_appearance(tmp_path):
    BALL.export(tmp_path / "ball.stl")
    template = read_template(tmp_path / "ball.stl")
    check_template(template)
    assert template.notes == {"merged vertices": "240 points of the STL file, equal ones merged: 42 vertices"}
    assert template.count == 42
    soup, order = VERTICES.astype(np.float32)[TRIANGLES].reshape(-1, 3).tolist(), []
    for point in soup:
        if point not in order:
            order.append(point)
    np.testing.assert_array_equal(template.vertices, order)
    np.testing.assert_array_equal(template.vertices[template.triangles], np.reshape(soup, (-1, 3, 3)))


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("ending", ["vtk", "vtp", "vtu"])
def test_vtk_with_arrays(tmp_path, here, ending, binary):
    import pyvista

    mesh: pyvista.PolyData | pyvista.UnstructuredGrid = pyvista.PolyData.from_regular_faces(VERTICES, TRIANGLES)
    mesh.point_data["heat"] = HEAT
    mesh.point_data["count"] = np.arange(42)
    mesh.point_data["flow"] = VERTICES * 2.0
    mesh.point_data["other"] = HEAT.astype(np.float32)
    mesh.cell_data["stress"] = np.arange(80.0)
    path = tmp_path / f"ball.{ending}"
    (mesh.cast_to_unstructured_grid() if ending == "vtu" else mesh).save(path, binary=binary)
    template = read_template(path)
    check_template(template)
    np.testing.assert_array_equal(template.triangles, TRIANGLES)
    np.testing.assert_allclose(template.vertices, VERTICES, atol=1e-12)
    assert set(template.arrays) >= {"heat", "count", "flow", "other"}
    np.testing.assert_allclose(template.arrays["heat"], HEAT, atol=1e-6)
    np.testing.assert_array_equal(template.arrays["count"], np.arange(42))
    np.testing.assert_allclose(template.arrays["flow"], VERTICES * 2.0, atol=1e-6)
    assert "stress" in template.cell_arrays


@pytest.mark.parametrize("ending", ["msh", "inp", "bdf", "nas", "su2", "mesh", "meshb", "tec", "avs"])
def test_what_meshio_reads(tmp_path, here, ending):
    keeps, path = ending in ("msh", "tec", "avs"), tmp_path / f"ball.{ending}"
    if ending in ("su2", "bdf", "nas"):
        path.write_text(su2(VERTICES, TRIANGLES) if ending == "su2" else nastran(VERTICES, TRIANGLES))
    else:
        write_meshio(path, VERTICES, [("triangle", TRIANGLES)], **({"heat": HEAT} if keeps else {}))
    template = read_template(path)
    check_template(template)
    np.testing.assert_allclose(template.vertices, VERTICES, atol=1e-6)
    np.testing.assert_array_equal(template.triangles, TRIANGLES)
    assert template.count == 42
    if keeps:
        np.testing.assert_allclose(template.arrays["heat"], HEAT, atol=1e-9)


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_ply_properties(tmp_path, form):
    named = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("u", "<f4"), ("v", "<f4"), ("red", "u1"), ("heat", "<f8")]
    rows = np.zeros(4, named)
    for axis, name in enumerate("xyz"):
        rows[name] = SQUARE[:, axis]
    rows["u"], rows["v"], rows["red"], rows["heat"] = [1, 2, 3, 4], [0, 0, 1, 1], [9, 8, 7, 6], [0.5, -1, 2, 1e-3]
    kinds = {"<f8": "double", "<f4": "float", "u1": "uchar"}
    head = f"ply\nformat {form}{'_little_endian' * (form == 'binary')} 1.0\nelement vertex 4\n"
    head += "".join(f"property {kinds[kind]} {name}\n" for name, kind in named)
    head += "element face 2\nproperty list uchar int vertex_indices\nproperty float stress\nend_header\n"
    if form == "ascii":
        body = "".join(" ".join(str(cell) for cell in row.tolist()) + "\n" for row in rows).encode()
        body += b"3 0 1 2 5\n3 0 2 3 6\n"
    else:
        faces = np.zeros(2, [("n", "u1"), ("v", "<i4", 3), ("s", "<f4")])
        faces["n"], faces["v"] = 3, [[0, 1, 2], [0, 2, 3]]
        faces["s"] = [5, 6]
        body = rows.tobytes() + faces.tobytes()
    template = read_template(write(tmp_path, "square.ply", head.encode() + body))
    check_template(template)
    np.testing.assert_array_equal(template.vertices, SQUARE)
    assert set(template.arrays) == {"u", "v", "red", "heat"}
    np.testing.assert_array_equal(template.arrays["heat"], [0.5, -1, 2, 1e-3])
    np.testing.assert_array_equal(template.arrays["u"], [1, 2, 3, 4])
    assert template.cell_arrays["stress"].tolist() == [5.0, 6.0]


HEXAGON = np.array([[1.0, 0, 0], [2, 1, 0], [2, 2, 0], [1, 3, 0], [0, 2, 0], [0, 1, 0], [1, 1, 5], [8, 8, 8]])
MIXED = [[0, 1, 2, 3, 4, 5], [0, 1, 6], [6, 1, 2, 3]]


@pytest.mark.parametrize("form", ["ascii.ply", "binary.ply", "obj", "off", "vtp", "vtu"])
def test_polygons_of_any_size(tmp_path, here, form):
    points = "".join(" ".join(map(str, point)) + "\n" for point in HEXAGON.tolist())
    faces = "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in MIXED)
    head = PLY.format(n=8) + PLY_FACES.format(f=3) + "end_header\n"
    path = tmp_path / f"mixed.{form}"
    if form == "ascii.ply":
        path.write_text(head + points + faces)
    elif form == "binary.ply":
        body = b"".join(bytes([len(face)]) + np.array(face, "<i4").tobytes() for face in MIXED)
        path.write_bytes(
            head.replace("ascii", "binary_little_endian").encode() + HEXAGON.astype("<f8").tobytes() + body
        )
    elif form == "obj":
        path.write_text("".join(f"v {row}\n" for row in points.splitlines()))
        with path.open("a") as file:
            file.writelines("f " + " ".join(str(corner + 1) for corner in face) + "\n" for face in MIXED)
    elif form == "off":
        path.write_text(f"OFF\n8 3 0\n{points}{faces}")
    else:
        write_vtk(path.with_suffix(".vtu"), {7: MIXED}, HEXAGON)
        if form == "vtp":
            import pyvista

            flat = [number for face in MIXED for number in (len(face), *face)]
            pyvista.PolyData(HEXAGON, np.array(flat)).save(path)
    template = read_template(path)
    check_template(template)
    assert len(template.triangles) == 4 + 1 + 2
    np.testing.assert_array_equal(template.vertices, HEXAGON[:7])
    assert template.count == 8
    hexagon = template.triangles[(template.triangles < 6).all(axis=1)]
    normals = np.cross(*np.moveaxis(np.diff(HEXAGON[hexagon], axis=1), 1, 0))
    assert normals[:, 2].sum() / 2.0 == pytest.approx(4.0)


OBJ = """mtllib gone.mtl
v 0 0 0
v 2 0 0
v 2 2 0 # a corner
v 0 2 0
v 7 7 7
vt 0 0
vt 1 1
vn 0 0 1
o one
usemtl red
f 1/1/1 2/2/1 \\
3/1/1
o two
usemtl blue
f 1/2/1 3/2/1 4/1/1
"""


def test_obj_keeps_its_vertices_whatever_its_materials_and_seams(tmp_path):
    template = read_template(write(tmp_path, "two.obj", OBJ))
    check_template(template)
    np.testing.assert_array_equal(template.vertices, SQUARE)
    assert sorted(template.triangles.tolist()) == [[0, 1, 2], [0, 2, 3]]
    assert template.count == 5


def test_obj_that_counts_backwards(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n"
    assert read_template(write(tmp_path, "a.obj", text)).triangles.tolist() == [[0, 1, 2]]
    twice = read_template(write(tmp_path, "b.obj", text + text.replace(" 0\n", " 5\n")))
    assert twice.triangles.tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize(
    ("kind", "cell", "area_"),
    [
        (6, [0, 1, 3, 2], 4.0),  # strip
        (8, [0, 1, 3, 2], 4.0),  # pixel
        (9, [0, 1, 2, 3], 4.0),
        (22, [0, 1, 2, 4, 5, 6], 2.0),
        (23, [0, 1, 2, 3, 4, 5, 6, 7], 4.0),
        (28, [0, 1, 2, 3, 4, 5, 6, 7, 8], 4.0),
        (34, [0, 1, 2, 4, 5, 6, 8], 2.0),
        (36, [0, 1, 2, 3, 4, 5, 6, 7], 4.0),
        (70, [0, 1, 2, 3, 4, 5, 6, 7, 8], 4.0),
    ],
)
def test_cells_of_vtu(tmp_path, here, kind, cell, area_):
    middles = [[1.0, 0, 0], [2, 1, 0], [1, 2, 0], [0, 1, 0], [1, 1, 0]]
    template = read_template(
        write_vtk(tmp_path / "a.vtu", {kind: [cell], 3: [[0, 8]]}, np.concatenate([SQUARE, middles]))
    )
    check_template(template)
    assert area(template) == pytest.approx(area_)
    normals = np.cross(*np.moveaxis(np.diff(template.vertices[template.triangles], axis=1), 1, 0))
    assert (normals[:, 2] > 0.0).all()
    assert ("second-order cells" in template.notes) == (kind > 9)
    assert "unused points" in template.notes


@pytest.mark.parametrize(
    ("name", "cell"), [("triangle6", [0, 1, 2, 4, 5, 6]), ("quad8", range(8)), ("quad9", range(9))]
)
def test_second_order_cells_of_gmsh(tmp_path, here, name, cell):
    middles = [[1.0, 0, 0], [2, 1, 0], [1, 2, 0], [0, 1, 0], [1, 1, 0]]
    path = write_meshio(tmp_path / "a.msh", np.concatenate([SQUARE, middles]), [(name, np.array([list(cell)]))])
    template = read_template(path)
    check_template(template)
    assert area(template) == pytest.approx(2.0 if name == "triangle6" else 4.0)
    assert template.notes["second-order cells"].startswith("1 curved cells are taken by their corners")


def test_a_flat_mesh_of_two_coordinates(tmp_path, here):
    template = read_template(write(tmp_path, "a.su2", su2(SQUARE[:, :2], np.array([[0, 1, 2, 3]]), kind=9)))
    np.testing.assert_array_equal(template.vertices, SQUARE)
    assert template.notes == {"two coordinates": "its points have two coordinates; the third is taken as 0"}


def test_coordinate_systems_of_nastran(tmp_path, here):
    quad = np.array([[0, 1, 2, 3]])
    assert read_template(write(tmp_path, "a.bdf", nastran(SQUARE, quad, "CQUAD4"))).notes == {}
    assert read_template(write(tmp_path, "b.bdf", nastran(SQUARE, quad, "CQUAD4", "0"))).notes == {}
    message = refusal(write(tmp_path, "c.bdf", nastran(SQUARE, quad, "CQUAD4", "7")))
    assert "4 of its 4 GRID points lie in coordinate systems of their own (CP)" in message


# what is left out, and said


def test_triangles_without_area_and_unused_points(tmp_path, here):
    far = SQUARE + np.array([1e6, 0.0, 0.0])
    points = np.concatenate([far, [[1e6 + 1.0, 0, 0], [np.nan, 0, 0], [1e6, 2, 0], [1, 2, 3]]])
    cells = np.array([[0, 1, 2], [0, 4, 1], [0, 0, 3], [0, 2, 3], [2, 3, 0], [0, 3, 6], [0, 3, 2]])
    path = write_vtk(tmp_path / "a.vtu", {5: cells.tolist()}, points, heat=np.arange(8.0))
    template = read_template(path)
    check_template(template)
    assert template.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 2]]
    assert template.rows.tolist() == [0, 1, 2, 3]
    assert template.arrays["heat"].tolist() == [0, 1, 2, 3]
    assert template.count == 8
    assert template.notes == {
        "dropped triangles": "3 of 7 triangles have no area and are left out",
        "repeated triangles": "1 triangles repeat another one and are left out",
        "unused points": "4 of 8 points are in no triangle and are left out",
    }


def test_thin_triangles_stay(tmp_path, here):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-12, 0], [0.5, 1e-17, 0]])
    path = write_vtk(tmp_path / "a.vtu", {5: [[0, 1, 2], [0, 1, 3]]}, points)
    assert read_template(path).triangles.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("size", [1e-90, 1e90])
def test_any_unit(tmp_path, here, size):
    template = read_template(write_vtk(tmp_path / "a.vtu", {9: [[0, 1, 2, 3]]}, SQUARE * size))
    assert len(template.triangles) == 2


def test_coincident_vertices_count_by_themselves(tmp_path, here):
    points, cells = np.concatenate([SQUARE, SQUARE[:2] - [0.0, 0.0, 0.0]]), [[0, 1, 2], [4, 2, 3], [5, 4, 3]]
    template = read_template(write_vtk(tmp_path / "a.vtu", {5: cells}, points))
    check_template(template)
    assert template.count == len(template.vertices) == 6
    assert template.notes == {"coincident vertices": "2 vertices coincide with others; each is counted separately"}


def test_arrays_may_have_gaps(tmp_path, here):
    template = read_template(
        write_vtk(tmp_path / "a.vtu", {9: [[0, 1, 2, 3]]}, SQUARE, a=np.array([1, np.inf, np.nan, 2]))
    )
    np.testing.assert_array_equal(template.arrays["a"], [1, np.inf, np.nan, 2])


@pytest.mark.parametrize("ending", ["vtu", "vtk"])
def test_the_boundary_of_a_volume_mesh(tmp_path, here, ending):
    """Two tetrahedra that share a face, and a hexahedron apart: 6 triangles and 6 quadrilaterals, outwards."""
    box = np.array([[x, y, z] for z in (3.0, 4.0) for x, y in ((3, 3), (4, 3), (4, 4), (3, 4))])
    points = np.concatenate([TETRA, [[2.0, 2, 2]], box])
    cells = {10: [[0, 1, 2, 3], [1, 4, 2, 3]], 12: [list(range(5, 13))], 5: [[0, 2, 1]]}
    template = read_template(write_vtk(tmp_path / f"a.{ending}", cells, points))
    check_template(template)
    assert template.notes["volume mesh"] == "the boundary of 2 tetrahedra, 1 hexahedra is taken, 12 faces"
    assert len(template.triangles) == 6 + 12
    a, b, c = np.moveaxis(template.vertices[template.triangles], 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(8 / 6 + 16 / 6 + 1.0)


@pytest.mark.parametrize("ending", ["msh", "inp", "mesh", "avs"])
def test_volume_cells_beside_flat_ones(tmp_path, here, ending):
    cells = [("triangle", np.array([[0, 1, 2]])), ("tetra", np.array([[0, 1, 2, 3]]))]
    template = read_template(write_meshio(tmp_path / f"a.{ending}", TETRA, cells))
    assert sorted(map(sorted, template.triangles.tolist())) == [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]


# what is refused


def test_clouds(tmp_path, here):
    assert "holds 4 points but no faces" in refusal(
        write(tmp_path, "a.ply", PLY.format(n=4) + "end_header\n" + CORNERS)
    )
    assert "holds 4 points but no faces" in refusal(write(tmp_path, "a.xyz", CORNERS))
    assert "holds a curve (1 lines) and no faces" in refusal(write_vtk(tmp_path / "a.vtu", {3: [[0, 1]]}, SQUARE[:2]))


@pytest.mark.parametrize(
    ("points", "cells", "message"),
    [
        ([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], "none of its 1 triangles has any area"),
        ([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 1]], "none of its 1 triangles has any area"),
        ([[0.0, 0, 0]] * 3, [[0, 1, 2]], "all 3 points coincide"),
        ([[0.0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], "1 of 3 vertices of its triangles have coordinates"),
        ([[0.0, 0, 0], [1, 0, 0], [0, np.inf, 0]], [[0, 1, 2]], "1 of 3 vertices of its triangles have coordinates"),
        ([[0.0, 0, 0], [1, 0, 0], [0, 1e101, 0]], [[0, 1, 2]], "check the file's units"),
    ],
)
def test_no_usable_surface(tmp_path, here, points, cells, message):
    assert message in refusal(write_vtk(tmp_path / "a.vtu", {5: cells}, np.array(points)))


def test_missing_package_is_named(tmp_path, here):
    if importlib.util.find_spec("h5py") is None:
        message = refusal(write(tmp_path, "a.med", "x"))
        assert "meshio needs h5py for this format: pip install h5py" in message


def test_parts_of_abaqus(tmp_path, here):
    path = write_meshio(tmp_path / "a.inp", SQUARE, [("quad", np.array([[0, 1, 2, 3]]))])
    text = path.read_text() + "*Node\n1, 5, 5, 5\n*NODE PRINT\nU\n"
    assert "1 numbers of nodes are there twice" in refusal(write(tmp_path, "b.inp", text))


def test_a_reader_that_never_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(foreign, "PATIENCE", 1.0)
    path = write(tmp_path, "a.msh", "(0 grid)\n(10 (1 1 4 1 3)(\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n")
    assert "meshio did not finish reading within 1 s" in refusal(path)


def test_unreadable_files(tmp_path):
    assert "no such file" in refusal(tmp_path / "gone.msh")
    assert "the file is empty" in refusal(write(tmp_path, "a.msh", " \n"))
    text = refusal(write(tmp_path, "a.fbx", "x"))
    assert all(ending[1:].upper() in text for ending in ENDINGS)


# any bytes


def seeds(folder: Path) -> dict[str, bytes]:
    """A sound file for every reader that runs in a process of its own, by its name."""
    import pyvista

    points, faces = np.round(HEXAGON[:7], 3), np.array([[0, 1, 6], [1, 2, 6], [2, 3, 6], [3, 4, 6]])
    mesh = pyvista.PolyData.from_regular_faces(points, faces)
    mesh.point_data["heat"] = np.arange(7.0)
    for form, binary in (("ascii", False), ("binary", True)):
        mesh.save(folder / f"{form}.vtk", binary=binary)
        mesh.save(folder / f"{form}.vtp", binary=binary)
        mesh.cast_to_unstructured_grid().save(folder / f"{form}.vtu", binary=binary)
    block: list = [("triangle", faces)]
    for ending in ("msh", "tec", "avs"):
        write_meshio(folder / f"a.{ending}", points, block, heat=np.arange(7.0))
    meshio.write(folder / "old.msh", meshio.Mesh(points, block), file_format="gmsh22", binary=False)
    meshio.write(folder / "fluent.msh", meshio.Mesh(points, block), file_format="ansys", binary=False)
    for ending in ("inp", "mesh", "meshb", "mdpa", "xml", "dato", "vol"):
        write_meshio(folder / f"a.{ending}", points, block)
    write(folder, "a.su2", su2(points, faces))
    write(folder, "a.bdf", nastran(points, faces))
    rows = [" ".join(map(str, point)) for point in HEXAGON.tolist()]
    rows += [f"{len(face)} {' '.join(map(str, face))}" for face in MIXED]
    write(folder, "a.off", "\n".join(["OFF", "8 3 0", *rows, ""]))
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> dict[str, bytes]:
    return seeds(tmp_path_factory.mktemp("seeds"))


BATCH = """
import runpy, signal, sys
import numpy as np
from pathlib import Path
worker, *paths = sys.argv[1:]
runpy.run_path(worker)["enter"]()
from rbfevo.meshes.worker.serve import KINDS, problem
def late(*_):
    raise TimeoutError("no end of it")
signal.signal(signal.SIGALRM, late)
for path in map(Path, paths):
    kind = "vtk" if path.suffix[:3] in (".vt", ".pv", ".ca", ".en") else "meshio"
    Path(f"{path}.tried").touch()
    signal.setitimer(signal.ITIMER_REAL, 0.5)
    try:
        reply = KINDS[kind](path).reply
    except (Exception, SystemExit) as error:
        reply = {"problem": problem(error)}
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    np.savez(f"{path}.npz", **reply)
"""


def answered(paths: list[Path]) -> None:
    """Have all `paths` read in one process, or, where a file ends it, in one more for the rest."""
    left = [path for path in paths if path.suffix not in OWN]
    while left:
        command = [sys.executable, "-P", "-c", BATCH, str(foreign.WORKER), *map(str, left)]
        subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=300)
        before, left = left, [path for path in left if not Path(f"{path}.tried").exists()]
        assert len(left) < len(before)


def check_accepted_or_refused(path: Path) -> bool:
    """Assert that a file is either read as a valid template or refused in one line; return whether it was read."""
    try:
        template = read_template(path)
    except UserError as error:
        if "\n" in str(error) or not str(error).startswith(f"{path}: "):
            raise AssertionError(f"not one clear line: {error}") from None
        return False
    check_template(template)
    return True


def check_batch(folder: Path, files: list[tuple[str, bytes]]) -> int:
    """Check many files, each read as `read_template` reads it; return how many were accepted."""
    paths = [write(folder, f"{k} {name}", content) for k, (name, content) in enumerate(files)]
    answered(paths)

    @contextlib.contextmanager
    def read(kind: str, path: Path):
        reply = Path(f"{path}.npz")
        if not reply.exists():
            raise FormatError("damaged: it cannot be read")
        with np.load(reply, allow_pickle=False) as archive:
            found = dict(archive)
        if "problem" in found:
            raise FormatError(str(found["problem"]))
        yield foreign.mesh_of(found, lambda *_: [], [])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(foreign, "foreign", read)
        accepted = sum(check_accepted_or_refused(path) for path in paths)
    for path in folder.iterdir():
        path.unlink()
    return accepted


def test_the_seeds_are_sound(tmp_path, sound):
    assert check_batch(tmp_path, list(sound.items())) == len(sound)


PUT = st.one_of(st.binary(max_size=8), st.sampled_from([b"-1", b"9", b"99999999999", b"nan", b"inf", b"1e300", b"\n"]))
DAMAGE = st.tuples(st.integers(0, 10**6), st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 20), PUT)
QUIET = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]


def damaged(sound: dict[str, bytes], many: list[tuple[int, float, int, bytes]]) -> list[tuple[str, bytes]]:
    files = []
    for k, (which, place, cut, put) in enumerate(many):
        name = sorted(sound)[(which + k) % len(sound)]
        start = int(place * len(sound[name]))
        files.append((name, sound[name][:start] + put + sound[name][start + cut :]))
    return files


@settings(max_examples=2, suppress_health_check=QUIET, phases=[Phase.generate])
@given(many=st.lists(DAMAGE, min_size=100, max_size=100))
def test_damaged_files(tmp_path, sound, many):
    check_batch(tmp_path, damaged(sound, many))


@pytest.mark.slow
@settings(max_examples=30, suppress_health_check=QUIET)
@given(many=st.lists(DAMAGE, min_size=200, max_size=200))
def test_many_more_damaged_files(tmp_path, sound, many):
    check_batch(tmp_path, damaged(sound, many))


@pytest.mark.slow
@settings(max_examples=20, suppress_health_check=QUIET)
@given(contents=st.lists(st.binary(min_size=1, max_size=200), min_size=80, max_size=80))
def test_any_bytes_under_any_ending(tmp_path, contents):
    endings = sorted(ENDINGS)
    check_batch(tmp_path, [(f"any{endings[k % len(endings)]}", content) for k, content in enumerate(contents)])


@settings(max_examples=12, suppress_health_check=QUIET)
@given(damage=DAMAGE, raw=st.one_of(st.none(), st.binary(min_size=1, max_size=100)))
def test_nothing_is_printed(tmp_path, capfd, sound, damage, raw):
    ((name, content),) = damaged(sound, [damage])
    check_accepted_or_refused(write(tmp_path, name, content if raw is None else raw))
    assert capfd.readouterr() == ("", "")
