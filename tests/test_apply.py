"""`python -m rbfevo.apply` deforms meshes as the written-out sum over the centers says."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from test_columns import MIRRORS, field
from test_exchange import CUBE, tetrahedra
from test_export import CASES, a_run, spatial

from rbfevo import apply, export, meshes
from rbfevo.commands import doubts
from rbfevo.meshes.mesh import Cells, Faces
from rbfevo.recorded.record import Record, read


def moves(run: Path, row: int = 0, seed: int = 0, *, on: int = 0) -> tuple[Record, Any]:
    """Random displacements [m, 3] that a setup of this run can follow."""
    record = read(run)
    rows = 0.1 * np.random.default_rng(seed).normal(size=(len(record.centers[row]), 3))
    if record.summary["symmetry"] is not None:
        rows[:on, "xyz".index(record.summary["symmetry"]["axis"])] = 0.0
    return record, rows


def points_of(d: int, q: int = 300) -> Any:
    points = np.random.default_rng(7).uniform(-1, 1, (q, 3))
    return points if d == 3 else (points + np.array([1, 2, 0])) * [0.5, 0.5, 1]


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("what", ["weights", "displacements"])
def test_a_cloud_follows_the_centers(what: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, on = a_run(tmp_path / "run", **CASES[name]), CASES[name].get("on", 0)
    record, rows = moves(run, on=on)
    C, d = record.centers[0], record.centers.shape[2]
    # The centers themselves are the last points of the cloud.
    points = np.concatenate([points_of(d), spatial(C)])
    np.save(tmp_path / "a.npy", points)
    np.savez(tmp_path / "rows.npz", **{what: rows})
    arguments = [f"--{what}", str(tmp_path / "rows.npz"), "--mesh", str(tmp_path / "a.npy")]
    assert apply.main([str(run), "--pick", "index:0", *arguments, "--out", str(tmp_path / "b.npy")]) == 0
    output = capsys.readouterr().out
    found = np.load(tmp_path / "b.npy") - points
    if what == "weights":
        np.testing.assert_allclose(found, field(record, 0, points[:, :d], rows), atol=1e-12)
    else:
        np.testing.assert_allclose(found[-len(C) :], rows, atol=1e-9)
        linear = [field(record, 0, C, e.reshape(rows.shape)).ravel() for e in np.eye(rows.size)]
        weights = np.linalg.lstsq(np.stack(linear, axis=1), rows.ravel(), rcond=1e-13)[0].reshape(rows.shape)
        np.testing.assert_allclose(found, field(record, 0, points[:, :d], weights), atol=1e-7)
    assert f"{len(points)} points moved by at most {np.linalg.norm(found, axis=1).max():.6g}" in output
    assert f"written: {tmp_path / 'b.npy'}" in output


@pytest.mark.parametrize("kernel", ["wendland", "triharmonic"])
def test_a_mirrored_run_keeps_a_symmetric_mesh_symmetric(kernel: str, tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", kernel=kernel, symmetry=MIRRORS[1], on=2)
    _, rows = moves(run, on=2)
    half = points_of(3)
    np.save(tmp_path / "a.npy", np.concatenate([half, half * [1, -1, 1], half * [1, 0, 1]]))
    np.save(tmp_path / "rows.npy", rows)
    arguments = ["--displacements", str(tmp_path / "rows.npy"), "--mesh", str(tmp_path / "a.npy"), "--quiet"]
    assert apply.main([str(run), "--pick", "index:0", *arguments, "--out", str(tmp_path / "b.npy")]) == 0
    one, other, middle = np.split(np.load(tmp_path / "b.npy"), 3)
    np.testing.assert_allclose(other, one * [1, -1, 1], atol=1e-12)
    np.testing.assert_array_equal(middle[:, 1], 0.0)
    assert np.abs(one - half).max() > 0.01


def test_a_volume_mesh_and_a_conversion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run")
    record, rows = moves(run)
    np.save(tmp_path / "rows.npy", rows)
    tetrahedra(np.float64).save(tmp_path / "a.vtu")
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "a.stl")
    common = [str(run), "--pick", "index:0", "--weights", str(tmp_path / "rows.npy")]
    assert apply.main([*common, "--mesh", str(tmp_path / "a.vtu"), "--out", str(tmp_path / "b.vtu")]) == 0
    again: Any = pyvista.read(tmp_path / "b.vtu")
    np.testing.assert_allclose(again.points, CUBE + field(record, 0, CUBE, rows), atol=1e-12)
    np.testing.assert_array_equal(again.cell_data["region"], [4, 5, 6])
    assert apply.main([*common, "--mesh", str(tmp_path / "a.stl"), "--out", str(tmp_path / "b.vtp")]) == 0
    assert "note: converted to .vtp" in capsys.readouterr().out
    surface: Any = pyvista.read(tmp_path / "b.vtp")
    assert surface.n_cells == 80
    assert set(surface.point_data) == {"displacement"}


def test_heights_of_the_plane(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run", d=2, kernel="triharmonic")
    record, heights = read(run), np.linspace(-0.2, 0.3, 6)[:, None]
    (tmp_path / "h.csv").write_text("\n".join(str(h) for h in heights.ravel()))
    grid = record.vertices[:4]
    np.save(tmp_path / "a.npy", grid)
    common = [str(run), "--pick", "index:2", "--weights", str(tmp_path / "h.csv"), "--mesh", str(tmp_path / "a.npy")]
    assert apply.main([*common, "--out", str(tmp_path / "b.npy")]) == 2  # two coordinates cannot hold a height
    assert "have no z" in capsys.readouterr().err
    assert apply.main([*common, "--out", str(tmp_path / "b.vtp")]) == 0
    again: Any = pyvista.read(tmp_path / "b.vtp")
    np.testing.assert_array_equal(again.points[:, :2], grid)
    np.testing.assert_allclose(again.points[:, 2:], field(record, 2, grid, heights), atol=1e-12)


# --- warnings --------------------------------------------------------------------------------------------------------


def warned(run: Path, mesh: Path, rows: Any, capsys: pytest.CaptureFixture[str]) -> list[str]:
    np.save(run.parent / "rows.npy", rows)
    arguments = ["--displacements", str(run.parent / "rows.npy"), "--mesh", str(mesh), "--quiet", "--overwrite"]
    assert (
        apply.main([str(run), "--pick", "index:0", *arguments, "--out", str(mesh.with_name(f"out{mesh.suffix}"))]) == 0
    )
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert all(line.startswith("warning: ") for line in lines)
    return [line.removeprefix("warning: ") for line in lines]


def test_a_global_kernel_moves_the_far_field(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.concatenate([points_of(3, 20), [[3.0, 0, 0], [0, -5, 0]]])
    np.save(tmp_path / "a.npy", points)
    run = a_run(tmp_path / "cubic", kernel="triharmonic")
    _, rows = moves(run)
    (line,) = warned(run, tmp_path / "a.npy", rows, capsys)
    farthest = np.linalg.norm(np.load(tmp_path / "out.npy") - points, axis=1)[-2:].max()
    assert "2 points outside the box of the run move by more than 1 %" in line
    assert line.endswith(f"at most by {farthest:.4g}")
    assert warned(a_run(tmp_path / "compact"), tmp_path / "a.npy", rows, capsys) == []
    np.save(tmp_path / "a.npy", points[:20])
    assert warned(run, tmp_path / "a.npy", rows, capsys) == []


def test_a_mesh_in_another_place_or_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "a.npy", 1000 * points_of(3) + 5000)
    compact, wide = a_run(tmp_path / "compact"), a_run(tmp_path / "wide", kernel="triharmonic")
    _, rows = moves(compact)
    (line,) = warned(compact, tmp_path / "a.npy", rows, capsys)
    assert "no point of the mesh lies within the support radius 0.9" in line
    assert "box of the run: x -1 .. 1, y -1 .. 1, z -1 .. 1" in line
    assert "Mesh: x 40" in line
    lines = warned(wide, tmp_path / "a.npy", rows, capsys)
    assert lines[0].startswith(
        "the mesh lies outside the box of the run; is the mesh in another place or unit than the run?"
    )
    assert "300 points outside the box" in lines[1]


def test_inverted_triangles_and_tetrahedra(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run")
    record, rows = moves(run)
    ball: Any = trimesh.creation.icosphere(subdivisions=2)
    ball.export(tmp_path / "a.off")
    assert warned(run, tmp_path / "a.off", 0.1 * rows, capsys) == []
    (line,) = warned(run, tmp_path / "a.off", 30 * rows, capsys)
    after: Any = trimesh.load(tmp_path / "out.off", process=False)
    before: Any = trimesh.load(tmp_path / "a.off", process=False)
    turned = ((after.triangles_cross * before.triangles_cross).sum(axis=1) < 0).sum()
    assert turned > 0
    assert line.startswith(f"{turned} of 320 triangles turn by more than 90 degrees")
    grid: Any = pyvista.PolyData(record.centers[0]).delaunay_3d()
    grid.save(tmp_path / "a.vtu")
    np.save(tmp_path / "rows.npy", 30 * rows)
    arguments = ["--displacements", str(tmp_path / "rows.npy"), "--mesh", str(tmp_path / "a.vtu"), "--quiet"]
    arguments = [str(run), "--pick", "index:0", *arguments, "--out", str(tmp_path / "deformed.vtu")]
    assert apply.main(arguments) == 2
    refused = capsys.readouterr().err
    assert not (tmp_path / "deformed.vtu").exists()
    assert apply.main([*arguments, "--force"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    corners = grid.cells.reshape(-1, 5)[:, 1:]
    volumes = [
        np.linalg.det(places[corners][:, 1:] - places[corners][:, :1])
        for places in (record.centers[0], record.centers[0] + 30 * rows)
    ]
    inverted = int((np.sign(volumes[0]) != np.sign(volumes[1])).sum())
    assert inverted > 0
    said = f"the displacements turn {inverted} of {len(corners)} tetrahedra (the worst to"
    assert line.startswith(f"warning: {said}")
    assert said in refused
    assert refused.endswith("or add --force to write the mesh anyway\n")
    limit = float(re.search(r"multiply the displacements by less than ([\d.e-]+),", refused)[1])  # pyright: ignore[reportOptionalSubscript]
    for share, code in ((0.999 * limit, 0), (1.02 * limit, 2)):
        np.save(tmp_path / "rows.npy", share * 30 * rows)
        assert apply.main([*arguments, "--overwrite"]) == code


# --- mistakes --------------------------------------------------------------------------------------------------------

GIVEN = "RUN --pick index:0 --displacements ROWS --mesh MESH --out OUT"
MISTAKES = {
    "RUN --pick index:0 --mesh MESH --out OUT": "one of the arguments --displacements --weights is required",
    GIVEN + " --weights ROWS": "not allowed with",
    GIVEN.replace("--pick index:0 ", ""): "--pick",
    GIVEN.replace("index:0", "index:99"): "choose one from 0 to 3",
    GIVEN.replace("RUN", "PLACE"): "setups.npz is missing",
    GIVEN.replace("ROWS", "PLACE/gone.csv"): "--displacements PLACE/gone.csv: no such file",
    GIVEN.replace("ROWS", "MESH"): "for 6 centers [6, 3] is expected",
    GIVEN.replace("MESH", "PLACE/gone.obj").replace("OUT", "PLACE/b.obj"): "gone.obj: no such file",
    GIVEN.replace("MESH", "PLACE/a.docx").replace("OUT", "PLACE/b.docx"): "unknown ending '.docx'",
    GIVEN.replace("MESH", "PLACE/nan.npy"): "1 of 2 points have coordinates that are not finite",
    GIVEN.replace("OUT", "PLACE/b.ply"): "choose the ending of the mesh, .npy, or one of .vtp, .vtu, .vtk",
    GIVEN.replace("OUT", "MESH"): "already exists: choose another file, or add --overwrite",
    GIVEN.replace("OUT", "PLACE/gone/b.npy"): "/gone does not exist; create it first",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_is_one_clear_line(arguments: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run")
    np.save(tmp_path / "mesh.npy", points_of(3))
    np.save(tmp_path / "rows.npy", np.zeros((6, 3)))
    (tmp_path / "a.docx").touch()
    np.save(tmp_path / "nan.npy", [[1.0, 2, 3], [np.nan, 2, 3]])
    places = {"RUN": run, "ROWS": "rows.npy", "MESH": "mesh.npy", "OUT": "out.npy", "PLACE": ""}
    before = sorted(tmp_path.rglob("*"))
    line, message = arguments, MISTAKES[arguments].replace("PLACE", str(tmp_path))
    for name, place in places.items():
        line = line.replace(name, str(tmp_path / place))
    assert apply.main(line.split()) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1, err
    assert err.startswith("rbfevo.apply: ")
    assert message in err
    assert sorted(tmp_path.rglob("*")) == before


def test_centers_stay_on_the_plane_and_singular_ones_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = a_run(tmp_path / "run", symmetry=MIRRORS[1], on=1)
    np.save(tmp_path / "rows.npy", np.full((6, 3), 0.5))
    np.save(tmp_path / "a.npy", points_of(3))
    files = ["--mesh", str(tmp_path / "a.npy"), "--out", str(tmp_path / "b.npy")]
    for what in ("displacement", "weight"):
        assert apply.main([str(run), "--pick", "index:0", f"--{what}s", str(tmp_path / "rows.npy"), *files]) == 2
        err = capsys.readouterr().err
        assert f"rows.npy: center 0 lies on the symmetry plane y = 0 and cannot leave it: its {what} along y" in err
        assert len(err.splitlines()) == 1
    run = a_run(tmp_path / "single", kernel="triharmonic", m=1)
    np.save(tmp_path / "rows.npy", np.full((1, 3), 0.5))
    assert apply.main([str(run), "--pick", "index:0", "--displacements", str(tmp_path / "rows.npy"), *files]) == 2
    assert "numerically singular" in capsys.readouterr().err
    np.save(tmp_path / "rows.npy", np.full((1, 3), 1e308))
    assert apply.main([str(run), "--pick", "index:0", "--weights", str(tmp_path / "rows.npy"), *files]) == 2
    assert "its values are so large that deformed points are not finite" in capsys.readouterr().err
    assert not (tmp_path / "b.npy").exists()


def test_overwriting_takes_a_word(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run")
    record, rows = moves(run)
    np.save(tmp_path / "a.npy", points_of(3))
    np.save(tmp_path / "rows.npy", rows)
    mesh = str(tmp_path / "a.npy")
    arguments = [str(run), "--pick", "index:0", "--weights", str(tmp_path / "rows.npy"), "--mesh", mesh, "--out", mesh]
    assert apply.main([*arguments, "--quiet"]) == 2
    np.testing.assert_array_equal(np.load(mesh), points_of(3))
    assert apply.main([*arguments, "--overwrite", "--quiet"]) == 0
    np.testing.assert_allclose(np.load(mesh), points_of(3) + field(record, 0, points_of(3), rows), atol=1e-12)


def test_the_help_names_formats_and_files() -> None:
    reply = subprocess.run([sys.executable, "-m", "rbfevo.apply", "--help"], capture_output=True, text=True, check=True)
    for word in ("vtu", "msh", "--overwrite", "displacements.csv", "knee", "RUN"):
        assert word in reply.stdout


@settings(max_examples=30)
@given(st.binary(max_size=40) | st.text("0123456789.,;-\n", max_size=40).map(str.encode))
def test_whatever_bytes_come_in_the_answer_is_0_or_a_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    place = tmp_path_factory.mktemp("fuzz")
    run = a_run(place / "run", m=2)
    np.save(place / "a.npy", points_of(3, 5))
    (place / "rows").write_bytes(content)
    arguments = ["--displacements", str(place / "rows"), "--mesh", str(place / "a.npy"), "--out", str(place / "b.npy")]
    code = apply.main([str(run), "--pick", "index:0", *arguments, "--quiet"])
    assert code in (0, 2)
    assert (place / "b.npy").exists() == (code == 0)


@pytest.mark.parametrize("at", [0.0, 0.1, 0.3])
def test_apply_takes_what_export_wrote_for_centers_on_the_plane(
    at: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = a_run(tmp_path / "run", symmetry={"axis": "x", "at": at}, on=3, kernel="triharmonic", m=9)
    arguments = [str(run), "--pick", "index:0"]
    assert export.main([*arguments, "--quiet", "--out", str(tmp_path / "out")]) == 0
    np.save(tmp_path / "a.npy", points_of(3))
    for what in ("displacements", "weights"):
        files = [f"--{what}", str(tmp_path / "out" / f"{what}.csv"), "--mesh", str(tmp_path / "a.npy")]
        assert apply.main([*arguments, *files, "--out", str(tmp_path / f"{what}.npy")]) == 0, capsys.readouterr().err
    one, other = (np.load(tmp_path / f"{what}.npy") for what in ("displacements", "weights"))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-8)


SOLIDS = {
    10: [[0, 1, 2, 4]],
    11: [[0, 1, 3, 2, 4, 5, 7, 6]],
    12: [list(range(8))],
    13: [[0, 1, 3, 4, 5, 7]],
    14: [[0, 1, 2, 3, 4]],
}
NAMES = {10: "tetrahedra", 11: "voxels", 12: "hexahedra", 13: "wedges", 14: "pyramids", 42: "polyhedra"}
BOX = np.array([[x, y, z] for z in (0.0, 1.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
SIDES = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [2, 1, 5, 6], [2, 3, 7, 6], [3, 0, 4, 7]]  # one wound inwards


def solid(kind: int) -> meshes.Mesh:
    """A box, or a part of it, as one cell of a kind, beside a triangle."""
    if kind == 42:
        faces = Faces(np.zeros(6, np.int64), np.full(6, 4), np.array(SIDES).ravel())
        cells = Cells(np.array([42], np.uint8), np.array([8]), np.arange(8), faces)
    else:
        cells = Cells.of([kind, 5], [*SOLIDS[kind], [0, 1, 2]])
    return meshes.Mesh(BOX, lambda *_: [], cells)


@pytest.mark.parametrize("kind", NAMES)
def test_solids_of_every_kind_that_turn_inside_out_are_counted(kind: int) -> None:
    mesh = solid(kind)
    assert doubts.inverted(mesh, BOX * [2.0, 3.0, 0.01]) == ""
    assert doubts.inverted(mesh, BOX * [1.0, 1.0, -0.5]) == (
        f"the displacements turn 1 of 1 {NAMES[kind]} (the worst to -0.5 times its volume) inside out or flat, and no "
        "solver can use such a mesh; multiply the displacements by less than 0.667"
    )
    assert f"1 of 1 {NAMES[kind]} (the worst to 0 times" in doubts.inverted(mesh, BOX * [1.0, 1.0, 0.0])
    turned = BOX[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]
    assert doubts.inverted(mesh, turned) == ""  # a quarter turn about z
    ((_, before, after, share),) = meshes.cells.volumes(BOX, BOX * 2.0, mesh.cells)
    expected = {10: 1 / 6, 13: 1 / 2, 14: 1 / 3}.get(kind, 1.0)
    assert abs(before[0]) == pytest.approx(expected)
    assert after[0] == pytest.approx(8.0 * before[0])
    assert share == 1.0


def test_a_hexahedron_with_one_corner_pulled_through_is_measured_by_its_bilinear_faces() -> None:
    """Against the volume of the trilinear cell by Gauss' quadrature."""
    moved = BOX.copy()
    moved[6] = [-0.5, -0.4, -0.9]
    at = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
    weight = np.array([5, 8, 5]) / 18
    total = 0.0
    for (x, u), (y, v), (z, w) in itertools.product(zip(at, weight, strict=True), repeat=3):
        lines = [((1 - x, x), (-1, 1)), ((1 - y, y), (-1, 1)), ((1 - z, z), (-1, 1))]
        place = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
        slopes = [[np.prod([lines[k][k == d][i[k]] for k in range(3)]) for i in place] for d in range(3)]
        total += u * v * w * np.linalg.det(np.array(slopes) @ moved)
    ((_, _, after, _),) = meshes.cells.volumes(BOX, moved, solid(12).cells)
    assert after[0] == pytest.approx(total)
