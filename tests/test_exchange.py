"""Meshes of every format: points are moved, and everything else that the file holds stays."""

from __future__ import annotations

import io
import re
import struct
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import pyvista
import trimesh
import trimesh.visual
from hypothesis import given, settings
from hypothesis import strategies as st

from rbfevo import meshes
from rbfevo.commands.center_rows import read_rows
from rbfevo.errors import UserError
from rbfevo.meshes import cells, nastran

CUBE = np.array([[x, y, z] for x in (0, 0.5, 1) for y in (0, 0.5, 1) for z in (0, 0.5, 1)])


def bend(points: Any) -> Any:
    """Some smooth displacement [q, 3]."""
    x, y, z = np.asarray(points, np.float64).T
    return np.stack([0.1 * y * z, 0.2 * np.sin(x), 0.05 * x * x + 0.01], axis=1)


def deform(source: Path, out: Path, move: Any = bend) -> list[str]:
    with meshes.opened(source) as mesh:
        displacement = move(mesh.points)
        return meshes.write(mesh, source, mesh.points + displacement, displacement, out)


def triangles(mesh: meshes.Mesh) -> list[list[int]]:
    return cells.surface(mesh.points, mesh.cells).triangles.tolist()


def numbers(text: bytes) -> Any:
    return np.array(re.findall(rb"[-+]?\d+\.?\d*(?:e[-+]?\d+)?", text), dtype=float)


# --- text: every other byte stays ------------------------------------------------------------------------------------

V = ["0 0 0", "1.5 0 1e-3", "\t0  1   0 ", "1 1 .25"]
OBJ = (
    "# made by hand\r\nmtllib a.mtl\no Büste\n{0}\n{1} 0.5 0.25 1\n{2}\nvt 0.1 0.2\nvn 0 0 1\ng wing\n{3}\n"
    "usemtl red\ns 1\nf 1/1/1 2/1/1 3//1\nf -1 -2 -3\nl 1 2\n"
)
OFF = "COFF # of four\n\n4 2 0\n{0} 255 0 0 255\n{1}\n# between\n{2}\n{3}\n3 0 1 2 0.1 0.2\n3 1 3 2\n"
PLY = (
    "ply\nformat ascii 1.0\ncomment a scan\nelement vertex 4\nproperty uchar red\nproperty float x\nproperty double y\n"
    "property float z\nproperty float nx\nelement face 1\nproperty list uchar int vertex_indices\nproperty int part\n"
    "end_header\n7 {0} 0.5\n7 {1} 1\n8 {2} 0\n9 {3} 0\n4 0 1 3 2 5\n"
)
SU2 = (
    "% by hand\nNDIME= 3\nNELEM= 1\n10 0 1 2 3 0\nNPOIN= 4 4\n{0} 0\n{1} 1\n{2} 2 % last\n{3} 3\nNMARK= 1\n"
    "MARKER_TAG= wing\nMARKER_ELEMS= 2\n5 0 1 2\n5 0 1 3\nFFD_NBOX= 1\n"
)
TEXTS = {
    ".su2": (SU2, "{}"),
    ".obj": (OBJ, "v {}"),
    ".off": (OFF, "{}"),
    ".ply": (PLY, "{}"),
    ".xyz": ("4\n# scan\n{0} 3 7\n{1} 1 7\n{2} 0 0\n{3} a b\n", "{}"),
}


@pytest.mark.parametrize("ending", TEXTS)
def test_text_formats_keep_every_other_byte(ending: str, tmp_path: Path) -> None:
    frame, vertex = TEXTS[ending]
    source, out = tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    source.write_bytes(frame.format(*(vertex.format(v) for v in V)).encode())
    notes = deform(source, out)
    X = np.array([[float(n) for n in v.split()] for v in V])
    # The file with marks in the places of the coordinates, made without looking at what was written.
    marked = frame.format(*(vertex.format(re.sub(r"\S+", "@", v)) for v in V)).encode()
    pattern = re.escape(marked).replace(b"@", rb"(\S+)")
    found = re.fullmatch(pattern, out.read_bytes())
    assert found, out.read_bytes()
    np.testing.assert_array_equal(np.array(found.groups(), float).reshape(-1, 3), X + bend(X))
    assert any("normals" in note for note in notes) == (ending in (".obj", ".ply"))
    with meshes.opened(source) as mesh:
        faces = {
            ".obj": [[0, 1, 2], [3, 2, 1]],
            ".off": [[0, 1, 2], [1, 3, 2]],
            ".ply": [[0, 1, 3], [0, 3, 2]],
            ".su2": [[0, 1, 2], [0, 1, 3]],
        }
        assert triangles(mesh) == faces.get(ending, [])


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        (b"name,z,x,y\na,3,1,2\nb,6,4.5,5\n", b"name,z,x,y\na,{2},{0},{1}\nb,{5},{3},{4}\n"),
        (b"1;2;3;x\n4,5;5;6;y\n", b"{0};{1};{2};x\n{3};{4};{5};y\n"),
        (b"\xef\xbb\xbf1,2,3\n4.5,5,6\n", b"\xef\xbb\xbf{0},{1},{2}\n{3},{4},{5}\n"),
    ],
)
def test_tables_keep_their_other_columns(text: bytes, columns: bytes, tmp_path: Path) -> None:
    source, out = tmp_path / "a.csv", tmp_path / "b.csv"
    source.write_bytes(text)
    deform(source, out)
    X = np.array([[1.0, 2, 3], [4.5, 5, 6]])
    comma = b";" in text
    expected = columns
    for place, number in enumerate((X + bend(X)).ravel().tolist()):
        formatted = repr(number).replace(".", ",") if comma else repr(number)
        expected = expected.replace(b"{%d}" % place, formatted.encode())
    assert out.read_bytes() == expected


# --- binary ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quads", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("real", ["f4", "f8"])
def test_binary_ply_keeps_every_other_byte(real: str, order: str, quads: bool, tmp_path: Path) -> None:
    kind = {"f4": "float", "f8": "double"}[real]
    row = np.dtype([("q", order + "i2"), ("x", order + real), ("y", order + real), ("c", "u1"), ("z", order + real)])
    vertices = np.zeros(27, row)
    vertices["q"], vertices["c"] = np.arange(27), np.arange(27) + 100
    for column, axis in enumerate("xyz"):
        vertices[axis] = CUBE[:, column]
    corners = [[0, 1, 2, 4], [3, 4, 5]] if quads else [[0, 1, 2], [3, 4, 5]]
    faces = b"".join(struct.pack(f"{order}B{len(c)}if", len(c), *c, 0.5) for c in corners)
    header = (
        f"ply\nformat binary_{'little' if order == '<' else 'big'}_endian 1.0\nelement odd 2\n"
        f"property list uchar short entries\nelement vertex 27\nproperty short q\n"
        f"property {kind} x\nproperty {kind} y\nproperty uchar c\nproperty {kind} z\nelement face 2\n"
        "property list uchar int vertex_indices\nproperty float area\nelement tail 1\nproperty uchar t\nend_header\n"
    ).encode()
    odd = struct.pack(f"{order}BhBhh", 1, -5, 2, 6, 7)
    source, out = tmp_path / "a.ply", tmp_path / "b.ply"
    source.write_bytes(header + odd + vertices.tobytes() + faces + b"\x7f")
    with meshes.opened(source) as mesh:
        np.testing.assert_array_equal(mesh.points, CUBE)
        expected = [[0, 1, 2], [0, 2, 4], [3, 4, 5]] if quads else corners
        assert triangles(mesh) == expected
    deform(source, out)
    for column, axis in enumerate("xyz"):
        vertices[axis] = (CUBE + bend(CUBE))[:, column]
    assert out.read_bytes() == header + odd + vertices.tobytes() + faces + b"\x7f"


@pytest.mark.parametrize("text", [False, True])
def test_stl_gets_new_normals_and_keeps_the_rest(text: bool, tmp_path: Path) -> None:
    box: Any = trimesh.creation.box()
    content: Any = box.export(file_type="stl_ascii" if text else "stl")
    if not text:
        facets = bytearray(content)
        facets[:80] = b"a header of its own".ljust(80)
        facets[84 + 48 : 84 + 50] = b"\x12\x34"  # a colour, as some programs write it
        content = bytes(facets)
    content = content.encode() if text else content
    source, out = tmp_path / "a.stl", tmp_path / "b.stl"
    source.write_bytes(content)
    deform(source, out)
    before: Any = trimesh.load(source, process=False)
    after: Any = trimesh.load(out, process=False)
    X = np.asarray(before.triangles).reshape(-1, 3)
    np.testing.assert_allclose(np.asarray(after.triangles).reshape(-1, 3), X + bend(X), atol=1e-7)
    again = out.read_bytes()
    if text:
        places = rb"(vertex|normal) .*"
        assert re.sub(places, b"", again) == re.sub(places, b"", source.read_bytes())
        normals = np.array(re.findall(rb"normal (\S+) (\S+) (\S+)", again), float)
    else:
        assert len(again) == len(content)
        assert again[:84] == content[:84]
        assert again[132:134] == b"\x12\x34"
        normals = np.stack([np.frombuffer(again, "<f4", 3, 84 + 50 * i) for i in range(12)])
    a, b, c = np.moveaxis((X + bend(X)).reshape(-1, 3, 3), 1, 0)
    expected = np.cross(b - a, c - a)
    np.testing.assert_allclose(normals, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-6)


def test_glb_keeps_parts_materials_and_texture_coordinates(tmp_path: Path) -> None:
    ball: Any = trimesh.creation.icosphere(subdivisions=1)
    uv = np.random.default_rng(0).uniform(size=(len(ball.vertices), 2))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255], name="paint")
    ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    box: Any = trimesh.creation.box()
    scene: Any = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.5, [0, 0, 1], [1, 2, 3])
    scene.add_geometry(ball, node_name="head", geom_name="head", transform=turn)
    scene.add_geometry(box, node_name="body", geom_name="body")
    source, out = tmp_path / "a.glb", tmp_path / "b.glb"
    source.write_bytes(scene.export(file_type="glb"))
    assert any("written anew" in note for note in deform(source, out))
    again: Any = trimesh.load_scene(out, process=False)
    for name, part, transform in (("head", ball, turn), ("body", box, np.eye(4))):
        X = trimesh.transform_points(part.vertices, transform)
        place, geometry = again.graph[name]
        np.testing.assert_array_equal(place, np.eye(4))
        found = again.geometry[geometry]
        np.testing.assert_allclose(found.vertices, X + bend(X), atol=2e-6)
        np.testing.assert_array_equal(found.faces, part.faces)
    head = again.geometry[again.graph["head"][1]]
    np.testing.assert_allclose(head.visual.uv, uv, atol=1e-6)
    assert head.visual.material.name == "paint"


@pytest.mark.parametrize("width", [2, 3])
@pytest.mark.parametrize("dtype", ["<f4", ">f8"])
def test_npy_keeps_its_precision(dtype: str, width: int, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", CUBE[:, :width].astype(dtype))
    deform(tmp_path / "a.npy", tmp_path / "b.npy")
    again = np.load(tmp_path / "b.npy")
    full = CUBE * ([1, 1, 0] if width == 2 else 1)
    assert again.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(again, (full + bend(full))[:, :width].astype(dtype))


# --- VTK -------------------------------------------------------------------------------------------------------------


def tetrahedra(dtype: Any = np.float32) -> Any:
    cells = np.array([[4, 0, 1, 3, 9], [4, 1, 3, 9, 10], [4, 13, 14, 16, 22]]).ravel()
    grid: Any = pyvista.UnstructuredGrid(cells, [10, 10, 10], CUBE.astype(dtype))
    grid.cell_data["region"] = np.array([4, 5, 6], np.int32)
    grid.point_data["pressure"] = np.linspace(0, 1, 27)
    grid.point_data["velocity"] = CUBE[:, ::-1].astype(np.float32)
    grid.field_data["time"] = np.array([2.5])
    grid.field_data["name"] = ["volume"]
    return grid


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("ending", [".vtu", ".vtk"])
def test_a_volume_mesh_keeps_cells_arrays_and_fields(ending: str, dtype: Any, tmp_path: Path) -> None:
    grid = tetrahedra(dtype)
    source, out = tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    grid.save(source, binary=dtype == np.float32)
    notes = deform(source, out)
    again: Any = pyvista.read(out)
    X = CUBE.astype(dtype)
    assert again.points.dtype == dtype
    np.testing.assert_array_equal(again.points, (X + bend(X)).astype(dtype))
    np.testing.assert_array_equal(again.cells, grid.cells)
    np.testing.assert_array_equal(again.celltypes, grid.celltypes)
    np.testing.assert_allclose(again["displacement"], bend(X), atol=1e-15)
    for attributes in ("point_data", "cell_data"):
        kept = {key: np.asarray(value) for key, value in getattr(grid, attributes).items()}
        found = getattr(again, attributes)
        assert set(found) - {"displacement"} == set(kept)
        for key, value in kept.items():
            assert found[key].dtype == value.dtype
            np.testing.assert_allclose(found[key], value, rtol=1e-10)  # the text file's own digits
    assert again.field_data["time"].tolist() == [2.5]
    assert list(again.field_data["name"]) == ["volume"]
    assert ("binary" in " ".join(notes)) == (ending == ".vtk" and dtype == np.float64)


@pytest.mark.parametrize("ending", [".vtp", ".vtk"])
def test_polydata_keeps_lines_and_several_scalars(ending: str, tmp_path: Path) -> None:
    made: Any = pyvista.PolyData(CUBE, faces=[4, 0, 1, 4, 3, 3, 9, 10, 12], lines=[2, 0, 26])
    made.point_data["a"], made.point_data["b"] = np.arange(27.0), np.arange(27, dtype=np.int16)
    made.cell_data["c"] = [1.0, 2.0, 3.0]
    made.point_data.active_normals = np.tile([0.0, 0.0, 1.0], (27, 1))
    source, out = tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    made.save(source)
    assert any("normals" in note for note in deform(source, out))
    again: Any = pyvista.read(out)
    np.testing.assert_array_equal(again.points, CUBE + bend(CUBE))
    np.testing.assert_array_equal(again.faces, made.faces)
    np.testing.assert_array_equal(again.lines, made.lines)
    for key in ("a", "b"):
        np.testing.assert_array_equal(again.point_data[key], made.point_data[key])
    np.testing.assert_array_equal(again.cell_data["c"], [1, 2, 3])
    with meshes.opened(source) as mesh:
        assert triangles(mesh) == [[0, 1, 4], [0, 4, 3], [9, 10, 12]]


def test_a_structured_grid_is_deformed_and_an_image_is_refused(tmp_path: Path) -> None:
    grid: Any = pyvista.ImageData(dimensions=(3, 4, 2)).cast_to_structured_grid()
    grid.save(tmp_path / "a.vts")
    deform(tmp_path / "a.vts", tmp_path / "b.vts")
    again: Any = pyvista.read(tmp_path / "b.vts")
    assert again.dimensions == (3, 4, 2)
    np.testing.assert_allclose(again.points, grid.points + bend(grid.points), atol=1e-6)
    pyvista.ImageData(dimensions=(3, 4, 2)).save(tmp_path / "a.vti")
    with pytest.raises(UserError, match="such a file is read, but not written"):
        deform(tmp_path / "a.vti", tmp_path / "b.vti")


def test_damaged_vtk_files_are_one_line(tmp_path: Path) -> None:
    tetrahedra().save(tmp_path / "a.vtk", binary=False)
    content = (tmp_path / "a.vtk").read_bytes()
    (tmp_path / "a.vtk").write_bytes(content[: len(content) // 3])
    bad = tetrahedra()
    bad.GetCells().GetConnectivityArray().SetValue(2, 999)
    bad.save(tmp_path / "b.vtu")
    for name in ("a.vtk", "b.vtu"):
        with pytest.raises(UserError, match=r"not a readable VT[KU] file"):
            deform(tmp_path / name, tmp_path / f"out{Path(name).suffix}")
    assert {path.name for path in tmp_path.iterdir()} == {"a.vtk", "b.vtu"}


# --- meshio ----------------------------------------------------------------------------------------------------------


def volume(ending: str, dtype: Any = np.float64) -> Any:
    cells: Any = [("tetra", np.array([[0, 1, 3, 9], [1, 3, 9, 10]])), ("triangle", np.array([[0, 1, 3], [1, 3, 9]]))]
    mesh: Any = meshio.Mesh(CUBE.astype(dtype), cells)
    if ending == ".msh":
        tags = [np.array([7, 7]), np.array([3, 4])]
        mesh.cell_data = {"gmsh:physical": tags, "gmsh:geometrical": [np.array([1, 1]), np.array([1, 2])]}
        mesh.field_data = {"solid": np.array([7, 3]), "wing": np.array([3, 2]), "tail": np.array([4, 2])}
    if ending == ".inp":
        mesh.cell_sets = {"SKIN": [np.array([], int), np.array([0, 1])]}
        mesh.point_sets = {"ROOT": np.array([0, 3])}
    return mesh


@pytest.mark.parametrize("ending", [".msh", ".inp", ".bdf", ".mesh", ".xdmf", ".vol"])
def test_meshio_formats_keep_cells_and_groups(ending: str, tmp_path: Path) -> None:
    if ending == ".xdmf":
        pytest.importorskip("h5py")
    mesh = volume(ending)
    source, out = tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    options: dict[str, Any] = {".xdmf": {"data_format": "XML"}, ".msh": {"file_format": "gmsh22", "binary": False}}
    meshio.write(source, mesh, **options.get(ending, {}))
    notes = deform(source, out)
    tolerance = 1e-6 if ending == ".bdf" else 1e-15
    before, again = meshio.read(source), meshio.read(out)
    np.testing.assert_allclose(again.points, CUBE + bend(CUBE), atol=tolerance)
    for was, now in zip(before.cells, again.cells, strict=True):
        assert was.type == now.type
        np.testing.assert_array_equal(was.data, now.data)
    for what in ("cell_data", "field_data", "cell_sets", "point_sets"):
        was, now = getattr(before, what), getattr(again, what)
        assert set(was) <= set(now)  # meshio's Netgen adds names of domains
        for key in was:
            assert [np.asarray(part).tolist() for part in was[key]] == [np.asarray(part).tolist() for part in now[key]]
    if ending == ".msh":
        assert set(again.field_data) == {"solid", "wing", "tail"}
        assert out.read_bytes().split()[1:4] == [b"2.2", b"0", b"8"]
    assert ("round" in " ".join(notes)) == (ending == ".bdf")
    assert ("written anew by meshio" in " ".join(notes)) == (ending in (".mesh", ".xdmf", ".vol"))
    assert {path.name for path in tmp_path.iterdir()} == {source.name, out.name}


def test_a_mesh_that_meshio_would_lose_or_cannot_read_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.msh").write_text("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n")
    (tmp_path / "a.med").write_bytes(b"nothing")
    (tmp_path / "a.bdf").write_bytes(b"GRID,1,nothing")
    for name in ("a.msh", "a.bdf", "a.med"):
        with pytest.raises(UserError, match="not a readable") as error:
            deform(tmp_path / name, tmp_path / f"b{Path(name).suffix}")
        assert "\n" not in str(error.value)


def test_meshio_that_reads_for_ever_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "worker.py").write_text("import sys, time; sys.stdout.flush(); time.sleep(600)")
    monkeypatch.setattr("rbfevo.meshes.foreign.WORKER", tmp_path / "worker.py")
    monkeypatch.setattr("rbfevo.meshes.foreign.PATIENCE", 0.5)
    (tmp_path / "a.msh").write_bytes(b"anything")
    with pytest.raises(UserError, match=r"meshio did not finish reading within \d+ s: damaged"):
        deform(tmp_path / "a.msh", tmp_path / "b.msh")


# --- conversions -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wanted", [".vtp", ".vtu", ".vtk"])
@pytest.mark.parametrize("given", [".obj", ".vtp", ".msh", ".npy"])
def test_conversions(given: str, wanted: str, tmp_path: Path) -> None:
    source, out = tmp_path / f"a{given}", tmp_path / f"b{wanted}"
    if given == ".npy":
        np.save(source, CUBE)
    elif given == ".vtp":
        pyvista.PolyData(CUBE, faces=[3, 0, 1, 3]).save(source)
    elif given == ".msh":
        meshio.write(source, volume(given), "gmsh22")
    else:
        source.write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in CUBE.tolist()) + "f 1 2 4\n")
    if (given, wanted) == (".msh", ".vtp"):
        with pytest.raises(UserError, match=r"choose an ending of \.vtu or \.vtk"):
            deform(source, out)
        assert not out.exists()
        return
    deform(source, out)
    again: Any = pyvista.read(out)
    np.testing.assert_array_equal(again.points, CUBE + bend(CUBE))
    np.testing.assert_allclose(again["displacement"], bend(CUBE), atol=1e-15)
    assert again.n_cells == {".npy": 27, ".msh": 4}.get(given, 1)


def test_endings(tmp_path: Path) -> None:
    meshes.refuse_ending(Path("a.PLY"), Path("b.ply"))
    meshes.refuse_ending(Path("a.stl"), Path("b.vtu"))
    with pytest.raises(UserError, match=r"choose the ending of the mesh, \.stl, or one of \.vtp"):
        meshes.refuse_ending(Path("a.stl"), Path("b.ply"))
    (tmp_path / "a.docx").touch()
    with pytest.raises(UserError, match="unknown ending"):
        deform(tmp_path / "a.docx", tmp_path / "b.docx")
    with pytest.raises(UserError, match="no such file"):
        deform(tmp_path / "a.vtu", tmp_path / "b.vtu")


@pytest.mark.parametrize("ending", [".ply", ".stl", ".npy", ".vtp"])
def test_points_too_large_for_the_file_are_one_line(ending: str, tmp_path: Path) -> None:
    source, out = tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    if ending == ".npy":
        np.save(source, CUBE.astype("f4"))
    elif ending == ".vtp":
        pyvista.PolyData(CUBE.astype("f4")).save(source)
    else:
        trimesh.creation.box().export(source)
    with pytest.raises(UserError, match="too large for the 32-bit numbers"):
        deform(source, out, lambda points: np.full(points.shape, 1e50))
    assert not out.exists()


# --- damage ----------------------------------------------------------------------------------------------------------


def a_file(ending: str) -> bytes:
    box: Any = trimesh.creation.box()
    if ending in TEXTS:
        frame, vertex = TEXTS[ending]
        return frame.format(*(vertex.format(v) for v in V)).encode()
    if ending == ".csv":
        return b"x,y,z\n1,2,3\n4,5,6\n"
    if ending == ".npy":
        buffer = io.BytesIO()
        np.save(buffer, CUBE)
        return buffer.getvalue()
    return box.export(file_type=ending.strip("+."))


def damaged(content: bytes, cut: int, place: int, patch: bytes) -> bytes:
    place %= len(content) + 1
    return (content[:place] + patch + content[place + len(patch) :])[: max(1, cut % (len(content) + 1))]


def check_survival(ending: str, content: bytes, place: Path) -> None:
    """Assert that the mesh is deformed or refused in one line, and that no other file is left behind."""
    source, out = place / f"a{ending}", place / f"b{ending}"
    source.write_bytes(content)
    out.unlink(missing_ok=True)
    try:
        message = " ".join(deform(source, out, lambda points: 0.5 * np.tanh(points)))
        assert out.exists()
    except UserError as error:
        message = str(error)
        assert not out.exists()
    assert "\n" not in message
    assert {path.name for path in place.iterdir()} <= {source.name, out.name}


@settings(max_examples=40)
@given(ending=st.sampled_from([*TEXTS, ".csv", ".npy", ".stl", ".glb", "+.ply"]), damage=st.data())
def test_whatever_bytes_come_in(ending: str, damage: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    content = a_file(ending)
    cut = damage.draw(st.integers(0, len(content)) | st.just(len(content)))
    patch = damage.draw(st.binary(max_size=8))
    place = damage.draw(st.integers(0, len(content)))
    check_survival(ending.strip("+"), damaged(content, cut, place, patch), tmp_path_factory.mktemp("damaged"))


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".vtu", ".vtk", ".vtp", ".msh", ".inp", ".bdf"])
def test_whatever_bytes_come_in_through_a_process(ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.meshes.foreign.PATIENCE", 10.0)
    source = tmp_path / f"whole{ending}"
    if ending == ".vtp":
        pyvista.PolyData(CUBE, faces=[3, 0, 1, 3]).save(source)
    elif ending in (".vtu", ".vtk"):
        tetrahedra().save(source, binary=False)
    else:
        meshio.write(source, volume(ending), *(["gmsh22"] if ending == ".msh" else []))
    content, rng = source.read_bytes(), np.random.default_rng(0)
    source.unlink()
    for _ in range(25):
        cut = int(rng.integers(len(content))) if rng.random() < 0.5 else len(content)
        patch = rng.bytes(int(rng.integers(1, 6)))
        check_survival(ending, damaged(content, cut, int(rng.integers(len(content))), patch), tmp_path)


# --- displacements ---------------------------------------------------------------------------------------------------

CENTERS = np.zeros((3, 3))
ROWS = np.array([[0.5, -1.0, 2.0], [3.0, 4.0, 5.5], [6.0, 7.0, -8.25]])
GOOD = {
    "0.5,-1,2\n3,4,5.5\n6,7,-8.25\n": "three columns",
    "# a comment\n0.5 -1 2\n\n3 4 5.5\n6 7 -8.25": "spaces",
    "0,5;-1;2\n3;4;5,5\n6;7;-8,25\n": "decimal commas",
    "center,dx,dy,dz\n2,6,7,-8.25\n0,0.5,-1,2\n1,3,4,5.5\n": "any order",
    "\ufeffdz, dx ,dy\r\n2,0.5,-1\r\n5.5,3,4\r\n-8.25,6,7\r\n": "named columns",
    '"center";"x";"y";"z"\n1;3;4;5,5\n2;6;7;-8,25\n0;0,5;-1;2': "quoted",
}


@pytest.mark.parametrize("text", GOOD, ids=GOOD.values())
def test_tables_of_displacements(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8", newline="")
    np.testing.assert_array_equal(read_rows(tmp_path / "a.csv", "displacements", CENTERS, heights=False), ROWS)


def test_arrays_of_displacements_and_heights(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", ROWS)
    np.savez(tmp_path / "a.npz", weights=ROWS.astype("f4"), displacements=ROWS + 1)
    heights = np.column_stack([np.zeros((3, 2)), ROWS[:, 2]])
    np.testing.assert_array_equal(read_rows(tmp_path / "a.npy", "weights", CENTERS, heights=False), ROWS)
    np.testing.assert_array_equal(read_rows(tmp_path / "a.npz", "weights", CENTERS, heights=False), ROWS)
    np.testing.assert_array_equal(read_rows(tmp_path / "a.npz", "displacements", CENTERS, heights=True), ROWS + 1)
    for array in (ROWS[:, 2], ROWS[:, 2:]):
        np.save(tmp_path / "b.npy", array)
        np.testing.assert_array_equal(read_rows(tmp_path / "b.npy", "weights", CENTERS, heights=True), heights)
    (tmp_path / "c.csv").write_text("center,dz\n2,-8.25\n1,5.5\n0,2\n")
    np.testing.assert_array_equal(read_rows(tmp_path / "c.csv", "displacements", CENTERS, heights=True), heights)
    with pytest.raises(UserError, match=r"shape is \[3, 1\], but for 3 centers \[3, 3\] is expected"):
        read_rows(tmp_path / "b.npy", "weights", CENTERS, heights=False)


BAD = {
    "": "empty",
    "1,2,3\n4,5,6\n": "shape is [2, 3], but for 3 centers",
    "1,2,3,4\n1,2,3,4\n1,2,3,4\n": "add the header center,dx,dy,dz",
    "1,2,3\n1,2\n1,2,3\n": "row 1 (from 0) has 2 fields instead of 3",
    "1,2,3\n1,a,2\n1,2,3\n": "row 1 (from 0) has 'a' where a number is expected",
    "1,2,3\n1,nan,2\n1,2,3\n": "row 1 (counted from 0) is not finite",
    "1,2,3\n1,2,2\n1,2,1e999\n": "row 2 (counted from 0) is not finite",
    "center,dx,dy,dz\n0,1,2,3\n1,1,2,3\n1,1,2,3\n": "each number from 0 to 2 once",
    "center,dx,dy,dz\n": "there are no lines with numbers in it",
    "center,wx,wy,wz\n0,1,2,3\n1,1,2,3\n2,1,2,3\n": "give it with --weights",
    "a,b,c\n1,2,3\n1,2,3\n1,2,3\n": "must be center,dx,dy,dz",
    "PK\x03\x04 no archive": "cannot be read",
    "\x93NUMPY": "cannot be read",
}


@pytest.mark.parametrize("text", BAD, ids=BAD.values())
def test_a_bad_table_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(UserError) as error:
        read_rows(tmp_path / "a.csv", "displacements", CENTERS, heights=False)
    if "NUMPY" not in text:
        assert BAD[text] in str(error.value)
    assert str(error.value).startswith("--displacements ")
    assert "\n" not in str(error.value)


def test_other_arrays_are_one_line(tmp_path: Path) -> None:
    for name, array, message in (
        ("complex", ROWS + 1j, "are not numbers"),
        ("text", np.array([["a"] * 3] * 3), "are not numbers"),
        ("deep", ROWS[None], r"shape is \[1, 3, 3\]"),
        ("objects", np.array([[None] * 3] * 3), "cannot be read"),
    ):
        np.save(tmp_path / f"{name}.npy", array, allow_pickle=True)
        with pytest.raises(UserError, match=message):
            read_rows(tmp_path / f"{name}.npy", "weights", CENTERS, heights=False)
    np.savez(tmp_path / "a.npz", other=ROWS)
    with pytest.raises(UserError, match="it has no array named weights; its arrays: other"):
        read_rows(tmp_path / "a.npz", "weights", CENTERS, heights=False)
    with pytest.raises(UserError, match="no such file"):
        read_rows(tmp_path / "gone.npz", "weights", CENTERS, heights=False)


@settings(max_examples=80)
@given(st.binary(max_size=60) | st.text("0123456789.,;-eNanxyzd \n", max_size=60).map(str.encode), st.booleans())
def test_whatever_bytes_hold_displacements(tmp_path_factory: Any, content: bytes, heights: bool) -> None:
    path = tmp_path_factory.mktemp("table") / "a.csv"
    path.write_bytes(content)
    try:
        rows, message = read_rows(path, "displacements", np.zeros((2, 3)), heights), ""
    except UserError as error:
        rows, message = np.zeros((2, 3)), str(error)
    assert rows.shape == (2, 3)
    assert np.isfinite(rows).all()
    assert "\n" not in message


def test_nastran_takes_any_coordinates(tmp_path: Path) -> None:
    """A number has 16 characters, which negative and very small ones exceed."""
    points = np.random.default_rng(0).normal(size=(40, 3)) * 10.0 ** np.arange(-20, 20)[:, None]
    points[0] = 0.0
    texts = [nastran.sixteen(number) for number in points.ravel().tolist()]
    assert all(len(text) <= 16 and "." in text for text in texts)
    rounded = np.array([float(text) for text in texts]).reshape(points.shape)
    np.testing.assert_allclose(rounded, points, rtol=1e-9)
    lines = [f"GRID,{i + 1},,{','.join(map(repr, point))}" for i, point in enumerate(points.tolist())]
    (tmp_path / "a.nas").write_text("\n".join(["BEGIN BULK", *lines, "CTRIA3,1,1,1,2,3", "ENDDATA"]) + "\n")
    deform(tmp_path / "a.nas", tmp_path / "b.nas", lambda points: 0.0 * points)
    np.testing.assert_allclose(meshio.read(tmp_path / "b.nas").points, points, rtol=1e-9)


def test_a_conversion_keeps_the_arrays_of_points_and_cells(tmp_path: Path) -> None:
    mesh = volume(".msh")
    heat, mark = np.arange(27.0) ** 2, [np.arange(float(len(block.data))) for block in mesh.cells]
    mesh.point_data["heat"], mesh.cell_data["mark"] = heat, mark
    meshio.write(tmp_path / "a.msh", mesh, "gmsh22")
    deform(tmp_path / "a.msh", tmp_path / "b.vtu")
    again: Any = pyvista.read(tmp_path / "b.vtu")
    np.testing.assert_array_equal(again["heat"], heat)
    np.testing.assert_array_equal(again.cell_data["mark"], np.concatenate(mark))
    np.testing.assert_allclose(again["displacement"], bend(CUBE), atol=1e-15)
