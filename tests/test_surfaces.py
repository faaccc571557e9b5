"""Surfaces from files: every format, cleaning and placing, and one clear line for every kind of bad file."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rbfevo.errors import UserError
from rbfevo.geometry import placement
from rbfevo.meshes import ENDINGS
from rbfevo.scenarios.reading import read_surface

BALL = trimesh.creation.icosphere(subdivisions=1, radius=3.0)
SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])

PLY_HEADER = "ply\nformat ascii 1.0\nelement vertex {n}\nproperty double x\nproperty double y\nproperty double z\n"
LEGACY = "# vtk DataFile Version 3.0\nsquare\nASCII\nDATASET {kind}\nPOINTS 4 double\n0 0 0 2 0 0 2 2 0 0 2 0\n"
POLYGONS = LEGACY.format(kind="POLYDATA")
VTP = (
    '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian"><PolyData>'
    '<Piece NumberOfPoints="4" NumberOfPolys="1"><Points>'
    '<DataArray type="Float64" NumberOfComponents="3" format="ascii">0 0 0 2 0 0 2 2 0 0 2 0</DataArray></Points>'
    '<Polys><DataArray type="Int64" Name="connectivity" format="ascii">0 1 2 3</DataArray>'
    '<DataArray type="Int64" Name="offsets" format="ascii">4</DataArray></Polys></Piece></PolyData></VTKFile>'
)
VTU = (
    VTP.replace("PolyData", "UnstructuredGrid")
    .replace("NumberOfPolys", "NumberOfCells")
    .replace("Polys", "Cells")
    .replace("</Cells>", '<DataArray type="UInt8" Name="types" format="ascii">9</DataArray></Cells>')
)
SQUARES = {
    "ply": PLY_HEADER.format(n=4)
    + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n2 0 0\n2 2 0\n0 2 0\n4 0 1 2 3\n",
    "obj": "mtllib gone.mtl\nv 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nvt 0 0\nusemtl skin\nf 1/1 2/1 3/1 4/1\n",
    "off": "OFF\n4 1 0\n0 0 0\n2 0 0\n2 2 0\n0 2 0\n4 0 1 2 3\n",
    "vtk": POLYGONS + "POLYGONS 1 5\n4 0 1 2 3\n",
    "strip.vtk": POLYGONS + "TRIANGLE_STRIPS 1 5\n4 0 1 3 2\n",
    "grid.vtk": LEGACY.format(kind="UNSTRUCTURED_GRID") + "CELLS 2 8\n2 0 1\n4 0 1 2 3\nCELL_TYPES 2\n3\n9\n",
    "vtp": VTP,
    "vtu": VTU,
    "inp": "*NODE\n5, 0, 0, 0\n6, 2, 0, 0\n7, 2, 2, 0\n9, 0, 2, 0\n*ELEMENT, TYPE=S4R\n1, 5, 6, 7, 9\n",
    "msh": "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n1 0 0 0\n2 2 0 0\n3 2 2 0\n4 0 2 0\n$EndNodes\n"
    "$Elements\n1\n1 3 0 1 2 3 4\n$EndElements\n",
}


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def area(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


def open_edges(triangles: np.ndarray) -> int:
    count: dict[frozenset[int], int] = {}
    for triangle in triangles.tolist():
        for k in range(3):
            edge = frozenset((triangle[k], triangle[(k + 1) % 3]))
            count[edge] = count.get(edge, 0) + 1
    return sum(uses == 1 for uses in count.values())


def message(path: Path | str) -> str:
    with pytest.raises(UserError) as caught:
        read_surface(path)
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    return text


# formats


@pytest.mark.parametrize("name", SQUARES)
def test_quads_become_triangles(tmp_path, name):
    vertices, triangles = read_surface(write(tmp_path, f"square.{name}", SQUARES[name]))
    np.testing.assert_array_equal(vertices, SQUARE)
    assert vertices.dtype == np.float64
    assert triangles is not None
    assert triangles.dtype == np.int64
    assert triangles.shape == (2, 3)
    assert area(vertices, triangles) == pytest.approx(4.0)
    normals = np.cross(*np.moveaxis(np.diff(vertices[triangles], axis=1), 1, 0))
    assert (normals[:, 2] > 0.0).all()


@pytest.mark.parametrize("ending", ["ply", "obj", "stl", "off", "glb", "vtk", "vtp"])
def test_written_by_others(tmp_path, ending):
    path = tmp_path / f"ball.{ending}"
    saved_ball(path, "binary")
    vertices, triangles = read_surface(path)
    assert triangles is not None
    assert len(triangles) == len(BALL.faces)
    assert area(vertices, triangles) == pytest.approx(BALL.area, rel=1e-6)
    vertices, triangles = placement.merge_coincident(vertices, triangles)
    assert vertices.shape == (42, 3)
    assert triangles is not None
    assert open_edges(triangles) == 0


def test_parts_of_a_glb_are_put_in_their_places(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(BALL)
    scene.add_geometry(BALL, transform=trimesh.transformations.translation_matrix([10.0, 0.0, 0.0]))
    path = tmp_path / "two.glb"
    path.write_bytes(scene.export(file_type="glb"))
    vertices, triangles = read_surface(path)
    assert triangles is not None
    assert len(triangles) == 2 * len(BALL.faces)
    assert np.ptp(vertices[:, 0]) == pytest.approx(16.0)
    assert area(vertices, triangles) == pytest.approx(2.0 * BALL.area, rel=1e-6)


CLOUD = np.array([[0.0, 1.5, 2], [3, -4, 5.25], [6, 7, 8e-3]])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("c.xyz", "0 1.5 2\n3 -4 5.25\n6 7 8e-3\n"),
        ("tabs.xyz", "0\t1.5\t2\r\n3\t-4\t5.25\r\n6\t7\t8e-3"),
        ("normals.xyz", "0 1.5 2 0 0 1\n3 -4 5.25 0 0 1\n\n6 7 8e-3 0 0 1\n"),
        ("comment.xyz", "# scanner 7\n// more\n0 1.5 2\n3 -4 5.25\n6 7 8e-3\n"),
        ("count.xyz", "3\n0 1.5 2\n3 -4 5.25\n6 7 8e-3\n"),
        ("header.xyz", "X Y Z\n0 1.5 2\n3 -4 5.25\n6 7 8e-3\n"),
        ("c.csv", "0,1.5,2\n3,-4,5.25\n6,7,8e-3\n"),
        ("header.csv", "x,y,z\n0,1.5,2\n3,-4,5.25\n6,7,8e-3\n"),
        ("named.csv", '"id","z","X","y"\n1,2,0,1.5\n2,5.25,3,-4\n3,8e-3,6,7\n'),
        ("unnamed.csv", "east,north,height\n0,1.5,2\n3,-4,5.25\n6,7,8e-3\n"),
        ("semicolon.csv", "x;y;z\n0;1.5;2\n3;-4;5.25\n6;7;8e-3\n"),
        ("decimal_comma.csv", "0;1,5;2\n3;-4;5,25\n6;7;8e-3\n"),
        ("spaces.csv", "0 1.5 2\n3 -4 5.25\n6 7 8e-3\n"),
        ("mark.csv", "\ufeffx, y, z\n0, 1.5, 2\n3, -4, 5.25\n6, 7, 8e-3\n"),
        ("c.ply", PLY_HEADER.format(n=3) + "end_header\n0 1.5 2\n3 -4 5.25\n6 7 8e-3\n"),
        ("c.inp", "*NODE\n1, 0, 1.5, 2\n2, 3, -4, 5.25\n3, 6, 7, 8e-3\n"),
        (
            "c.vtk",
            "# vtk DataFile Version 3.0\nc\nASCII\nDATASET POLYDATA\nPOINTS 3 double\n0 1.5 2 3 -4 5.25 6 7 8e-3\n",
        ),
    ],
)
def test_clouds(tmp_path, name, text):
    vertices, triangles = read_surface(write(tmp_path, name, text))
    assert triangles is None
    np.testing.assert_array_equal(vertices, CLOUD)


# bad files


def test_missing_file_is_named(tmp_path):
    assert "no such file" in message(tmp_path / "nobody.ply")


def test_directory(tmp_path):
    folder = tmp_path / "scan.ply"
    folder.mkdir()
    assert "is a directory" in message(folder)


def test_unknown_ending_lists_what_there_is(tmp_path):
    text = message(write(tmp_path, "face.fbx", "x"))
    assert all(ending[1:].upper() in text for ending in ENDINGS)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root reads everything")
def test_file_without_permission(tmp_path):
    path = write(tmp_path, "a.xyz", "0 0 0\n")
    path.chmod(0)
    assert "cannot be read" in message(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_empty_file(tmp_path, ending):
    assert "the file is empty" in message(write(tmp_path, f"a{ending}", b" \n"))


@pytest.mark.parametrize("ending", [*ENDINGS, ".msh", ".inp", ".vol.gz"])
def test_garbage_is_refused_in_silence(tmp_path, capfd, ending):
    draw = np.random.default_rng(3)
    message(write(tmp_path, f"a{ending}", b"this is not a surface"))
    message(write(tmp_path, f"b{ending}", draw.bytes(2000)))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.ply", PLY_HEADER.format(n=0) + "element face 0\nproperty list uchar int vertex_indices\nend_header\n"),
        ("empty.obj", "# nothing\n"),
        ("empty.off", "OFF\n0 0 0\n"),
        ("empty.stl", "solid a\nendsolid a\n"),
        ("empty.vtk", "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 0 float\n"),
        ("header.csv", "x,y,z\n"),
    ],
)
def test_empty_surface(tmp_path, name, content):
    assert any(word in message(write(tmp_path, name, content)) for word in ("empty", "no lines", "not a readable"))


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("nan.xyz", "0 0 nan\n1 2 3\ninf 0 0\n4 4 4\n", "2 of 4 points have coordinates that are not finite"),
        ("nan.obj", "v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", "1 of 3 points have coordinates that are not finite"),
        ("nan.vtk", POLYGONS.replace("2 2 0", "nan 2 0") + "POLYGONS 1 4\n3 0 1 3\n", "1 of 4 points"),
        ("one.xyz", "1 2 3\n", "only one point"),
        ("same.csv", "1,2,3\n1,2,3\n1,2,3\n", "all 3 points coincide"),
        ("far.xyz", "1e200 0 0\n0 0 0\n1 1 1\n", "check the file's units"),
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "has any area"),
        ("short.xyz", "1 2\n3 4\n", "not a readable XYZ file"),
        ("ragged.csv", "1,2,3\n4,5\n", "not a readable CSV file"),
        ("words.csv", "1,2,3\n4,five,6\n", "five"),
        ("index.off", SQUARES["off"].replace("4 0 1 2 3", "4 0 1 2 9"), "not a readable OFF file"),
        ("index.ply", SQUARES["ply"].replace("4 0 1 2 3", "4 0 1 2 9"), "not a readable PLY file"),
        ("negative.ply", SQUARES["ply"].replace("4 0 1 2 3", "4 0 1 2 -1"), "not a readable PLY file"),
        ("index.vtk", SQUARES["vtk"].replace("4 0 1 2 3", "4 0 1 2 9"), "refer to a point that is not there"),
        ("index.vtp", VTP.replace("0 1 2 3<", "0 1 2 9<"), "refer to a point that is not there"),
        ("huge.vtp", VTP.replace('Points="4"', 'Points="99999999999"'), "damaged"),
        ("box.vtk", "# vtk DataFile Version 3.0\nx\nASCII\nDATASET FIELD\n", "damaged"),
    ],
)
def test_bad_content(tmp_path, capfd, name, content, reason):
    assert reason in message(write(tmp_path, name, content))
    assert capfd.readouterr() == ("", "")


def saved_ball(path: Path, form: str) -> bytes:
    if path.suffix in (".vtk", ".vtp"):
        import pyvista

        mesh = pyvista.PolyData.from_regular_faces(np.asarray(BALL.vertices), np.asarray(BALL.faces))
        mesh.save(path, binary=form == "binary")
    else:
        BALL.export(path, **({"encoding": form} if path.suffix == ".ply" else {}))
    return path.read_bytes()


@pytest.mark.parametrize(
    ("ending", "form"),
    [
        ("vtk", "ascii"),
        ("vtk", "binary"),
        ("vtp", "binary"),
        ("ply", "ascii"),
        ("ply", "binary"),
        ("off", "ascii"),
        ("stl", "binary"),
        ("glb", "binary"),
    ],
)
def test_files_cut_off(tmp_path, ending, form):
    whole = saved_ball(tmp_path / f"ball.{ending}", form)
    for part in (0.2, 0.9):
        text = message(write(tmp_path, f"part.{ending}", whole[: int(part * len(whole))]))
        assert f"not a readable {ending.upper()} file (" in text


SEEDS = {name: SQUARES[name].encode() for name in ("ply", "obj", "off")} | {
    "stl": BALL.export(file_type="stl"),
    "glb": BALL.export(file_type="glb"),
    "csv": b"x,y,z\n0,1,2\n3,4,5\n6,7,9\n",
    "xyz": b"0 1 2\n3 4 5\n6 7 9\n",
}


def check_accepted_or_refused(path: Path) -> None:
    """Assert that a file is either read as a valid surface or refused in one line."""
    try:
        vertices, triangles = read_surface(path)
    except UserError as error:
        if "\n" in str(error):
            raise AssertionError(f"more than one line: {error}") from None
        return
    assert vertices.ndim == 2
    assert vertices.shape[1] == 3
    assert np.isfinite(vertices).all()
    assert triangles is None or (triangles.min() >= 0 and triangles.max() < len(vertices))
    vertices, triangles = placement.merge_coincident(vertices, triangles)
    if triangles is None or len(triangles):
        placed, _ = placement.fit_box(placement.drop_strays(vertices, triangles)[0])
        assert np.abs(placed).max() <= 1.0


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(ending=st.sampled_from(sorted(SEEDS)), content=st.binary(min_size=1, max_size=300))
def test_any_bytes(tmp_path, ending, content):
    check_accepted_or_refused(write(tmp_path, f"any.{ending}", content))


@settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    ending=st.sampled_from(sorted(SEEDS)),
    place=st.floats(0.0, 1.0, exclude_max=True),
    cut=st.integers(0, 20),
    put=st.one_of(
        st.binary(max_size=8), st.sampled_from([b"-1", b"9", b"99999999999", b"nan", b"inf", b"1e300", b"\n"])
    ),
)
def test_damaged_files(tmp_path, ending, place, cut, put):
    whole = SEEDS[ending]
    start = int(place * len(whole))
    check_accepted_or_refused(write(tmp_path, f"damaged.{ending}", whole[:start] + put + whole[start + cut :]))


# cleaning and placing


def test_seams_leave_no_open_boundary():
    soup = np.asarray(BALL.triangles).reshape(-1, 3)
    noise = np.random.default_rng(0).normal(scale=1e-9, size=soup.shape)
    triangles = np.arange(len(soup)).reshape(-1, 3)
    vertices, merged = placement.merge_coincident(soup + noise, triangles)
    assert vertices.shape == (42, 3)
    assert merged is not None
    assert merged.shape == (80, 3)
    assert open_edges(merged) == 0
    assert area(vertices, merged) == pytest.approx(BALL.area, rel=1e-6)


def test_repeated_and_collapsed_triangles_and_unused_vertices_go():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [9, 9, 9]])
    triangles = np.array([[0, 1, 2], [2, 1, 3], [0, 1, 3]])
    points, kept = placement.merge_coincident(vertices, triangles)
    assert kept is not None
    assert len(points) == 3
    assert len(kept) == 1
    assert area(points, kept) == pytest.approx(0.5)


def test_a_flying_pixel_does_not_set_the_scale():
    cloud = np.random.default_rng(1).uniform(-1.0, 1.0, (500, 3))
    stray = np.concatenate([cloud, [[300.0, 0.0, 0.0]]])
    kept, _, count = placement.drop_strays(stray, None)
    assert count == 1
    np.testing.assert_array_equal(kept, cloud)
    body = np.concatenate([cloud, np.full((20, 3), 300.0)])
    assert placement.drop_strays(body, None)[2] == 0  # 4% of the points are no strays
    assert placement.drop_strays(cloud, None)[2] == 0


def test_strays_take_their_triangles_along():
    vertices = np.concatenate([np.asarray(BALL.vertices), [[500.0, 0.0, 0.0]]])
    vertices = np.concatenate([vertices, np.asarray(BALL.vertices) * 0.5, np.asarray(BALL.vertices) * 0.7])
    triangles = np.concatenate([BALL.faces, BALL.faces + 43, BALL.faces + 85, [[0, 1, 42]]])
    points, kept, count = placement.drop_strays(vertices, triangles)
    assert count == 1
    assert kept is not None
    assert len(points) == 126
    assert len(kept) == 240
    assert np.abs(points).max() <= 3.0


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z", "+x", "Y"])
@pytest.mark.parametrize("front", ["x", "-y", "+z"])
def test_turning_is_a_rotation(up, front):
    letters = {name: name.strip("+-").lower() for name in (up, front)}
    points = np.random.default_rng(2).normal(size=(10, 3))
    if letters[up] == letters[front]:
        with pytest.raises(UserError, match="two different axes"):
            placement.turn(points, up, front)
        return

    def along(name: str) -> np.ndarray:
        return points[:, "xyz".index(letters[name])] * (-1.0 if name.startswith("-") else 1.0)

    turned = placement.turn(points, up, front)
    np.testing.assert_array_equal(turned[:, 1], along(up))
    np.testing.assert_array_equal(turned[:, 2], along(front))
    assert np.linalg.det(placement.turn(np.eye(3), up, front)) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", ["w", "", "xy", "--x", "+", "1", None, 3])
def test_bad_axes(axis):
    with pytest.raises(UserError, match=r"scenario\.up=.*: choose x, y, z, -x, -y or -z"):
        placement.turn(np.eye(3), axis, "z")


@pytest.mark.parametrize("sides", [(2.0, 3.0, 1.0), (1.0, 1.0, 50.0), (1e-4, 2e-5, 0.0)])
def test_fit_box(sides):
    points = np.random.default_rng(4).uniform(size=(200, 3))
    points = (points - points.min(axis=0)) / np.ptp(points, axis=0) * sides + 1000.0
    placed, scale = placement.fit_box(points)
    assert scale == pytest.approx(2.0 / max(sides), rel=1e-6)
    low, high = placed.min(axis=0), placed.max(axis=0)
    assert np.ptp(placed, axis=0).max() == pytest.approx(2.0, rel=1e-6)
    assert low[:2] + high[:2] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert high[2] == pytest.approx(1.0)
    assert low.min() >= -1.0
    assert high.max() <= 1.0
