"""Curves as planar designs: direction, normals and lengths, the files they come from, what they want, whole runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
import torch
from scipy.spatial.distance import cdist
from slabs import HALVES, lifted, ring
from test_planar_runs import METHODS

from rbfevo import apply, export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.figures.view import standpoint
from rbfevo.geometry import curves
from rbfevo.geometry.planar import Plane
from rbfevo.recorded.record import read
from rbfevo.scenarios import mesh
from rbfevo.scenarios.sampling import curve_sampler
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scenarios.templates import read_template

COUNT = 48
FLAT = ring(COUNT)
ROUND = np.stack([np.arange(COUNT), (np.arange(COUNT) + 1) % COUNT], axis=1)
SIDES = np.linalg.norm(np.roll(FLAT, -1, axis=0) - FLAT, axis=1)
LENGTHS = 0.5 * (SIDES + np.roll(SIDES, 1))


def outward() -> np.ndarray:
    chords = np.roll(FLAT, -1, axis=0) - np.roll(FLAT, 1, axis=0)
    return np.stack([chords[:, 1], -chords[:, 0]], axis=1) / np.linalg.norm(chords, axis=1, keepdims=True)


def lines(flat: np.ndarray, segments: np.ndarray, axis: int = 2, height: float = 0.25) -> Any:
    cells = np.hstack([np.full((len(segments), 1), 2), segments]).ravel()
    return pv.PolyData(lifted(flat, axis, height), lines=cells)


def turned(segments: np.ndarray, which: np.ndarray) -> np.ndarray:
    return np.where(which[:, None], segments[:, ::-1], segments)


@pytest.mark.parametrize("backwards", [0.0, 0.3, 0.7, 1.0])
def test_a_closed_curve_runs_counterclockwise(backwards: float) -> None:
    generator = np.random.default_rng(0)
    shuffled = generator.permutation(ROUND)
    which = generator.random(COUNT) < backwards
    found, count = curves.oriented(FLAT, turned(shuffled, which))
    np.testing.assert_array_equal(found, shuffled)
    assert count == which.sum()
    np.testing.assert_allclose(curves.normals(FLAT, found), outward(), atol=1e-12)
    np.testing.assert_allclose(curves.vertex_lengths(FLAT, found), LENGTHS)


def test_a_curve_within_another_keeps_the_direction_of_most_of_its_segments() -> None:
    both = np.concatenate([FLAT, 0.3 * FLAT])
    clockwise = ROUND[:, ::-1] + COUNT
    clockwise[5] = clockwise[5, ::-1]
    found, count = curves.oriented(both, np.concatenate([ROUND, clockwise]))
    assert count == 1
    np.testing.assert_array_equal(found[COUNT:], ROUND[:, ::-1] + COUNT)
    beside = np.concatenate([FLAT, 0.3 * FLAT + [9.0, 0.0]])
    found, count = curves.oriented(beside, np.concatenate([ROUND, clockwise]))
    assert count == COUNT - 1
    np.testing.assert_array_equal(found[COUNT:], ROUND + COUNT)
    assert curves.oddities(both, found) == {"curves": "2 curves between ends and branches"}


def test_open_curves_branches_and_seams() -> None:
    places = np.array([[0.0, 0], [1, 0], [2, 0], [3, 0]])
    found, count = curves.oriented(places, np.array([[1, 0], [1, 2], [2, 3]]))
    assert (found.tolist(), count) == ([[0, 1], [1, 2], [2, 3]], 1)
    found, _ = curves.oriented(places, np.array([[1, 0], [2, 1], [2, 3]]))
    assert found.tolist() == [[1, 0], [2, 1], [3, 2]]
    np.testing.assert_allclose(curves.normals(places, found), np.tile([0.0, 1.0], (4, 1)))
    assert curves.ends(4, found).tolist() == [0, 3]
    assert "2 open ends" in curves.oddities(places, found)["open curve"]
    star = np.array([[0.0, 0], [1, 0], [-1, 0], [0, 1]])
    spokes = np.array([[1, 0], [0, 2], [3, 0]])
    assert curves.oriented(star, spokes)[1] == 0
    assert "at 1 vertices more than two" in curves.oddities(star, spokes)["branches"]
    seam = np.concatenate([FLAT, FLAT[:1]])  # the last point is the first once more
    around = np.stack([np.arange(COUNT), np.arange(1, COUNT + 1)], axis=1)
    found, count = curves.oriented(seam, around[:, ::-1])
    assert count == COUNT
    np.testing.assert_array_equal(found, around)
    np.testing.assert_allclose(curves.normals(seam, found)[[0, -1]], [[1, 0], [1, 0]], atol=1e-12)
    assert curves.oddities(seam, found) == {}


SQUARE_SU2 = """NDIME= 2
NELEM= 2
5 0 1 2 0
5 0 2 3 1
NPOIN= 4
0.0 0.0 0
1.0 0.0 1
1.0 1.0 2
0.0 1.0 3
NMARK= 2
MARKER_TAG= floor
MARKER_ELEMS= 1
3 1 0
MARKER_TAG= walls
MARKER_ELEMS= 3
3 1 2
3 2 3
3 3 0
"""
SQUARE_MSH = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
2
1 1 "floor"
2 2 "area"
$EndPhysicalNames
$Nodes
4
1 0 0 0
2 1 0 0
3 1 1 0
4 0 1 0
$EndNodes
$Elements
4
1 1 2 1 1 1 2
2 1 2 5 2 2 3
3 2 2 2 1 1 2 3
4 2 2 2 1 1 3 4
$EndElements
"""


def test_line_cells_of_many_formats(tmp_path: Path) -> None:
    (tmp_path / "a.su2").write_text(SQUARE_SU2)
    every = read_template(tmp_path / "a.su2", curves=True)
    assert every.segments.tolist() == [[1, 0], [1, 2], [2, 3], [3, 0]]
    assert every.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert (
        "the curve of all 4 lines, not the area of 2 faces; choose of them by scenario.patches" in every.notes["curve"]
    )
    floor = read_template(tmp_path / "a.su2", ("floor",), curves=True)
    assert floor.vertices.tolist() == [[0, 0, 0], [1, 0, 0]]
    assert floor.segments.tolist() == [[1, 0]]
    assert len(read_template(tmp_path / "a.su2").triangles) == 2
    (tmp_path / "a.msh").write_text(SQUARE_MSH)
    floor = read_template(tmp_path / "a.msh", ("floor",), curves=True)
    assert (floor.segments.tolist(), floor.cell.tolist()) == ([[0, 1]], [0])
    assert len(read_template(tmp_path / "a.msh", ("area",), curves=True).triangles) == 2
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 5 5 5\nl 1 2 3\n")
    assert read_template(tmp_path / "a.obj", curves=True).segments.tolist() == [[0, 1], [1, 2]]
    points = lifted(FLAT, 2, 0.0)
    polyline = pv.PolyData(points, lines=np.array([COUNT + 1, *range(COUNT), 0]))
    polyline.save(tmp_path / "a.vtp")
    found = read_template(tmp_path / "a.vtp", curves=True)
    assert found.segments.tolist() == ROUND.tolist()
    assert (found.cell == 0).all()
    grid = pv.UnstructuredGrid(np.array([3, 0, 2, 1, 2, 0, 2, 2, 0, 0]), np.array([21, 3, 3]), np.eye(3) * [1, 1, 0])
    grid.save(tmp_path / "a.vtu")
    found = read_template(
        tmp_path / "a.vtu", curves=True
    )  # a curved line by its ends, a repeated one, one of no length
    assert found.segments.tolist() == [[0, 1]]
    assert "2 of 3 lines have no length or repeat another" in found.notes["dropped lines"]
    assert "1 of 3 points are in no line" in found.notes["unused points"]
    with pytest.raises(UserError, match=r"a\.vtu: it holds a curve \(3 lines\) and no faces: set scenario\.planar=z"):
        read_template(tmp_path / "a.vtu")
    solid = pv.Plane(i_resolution=2, j_resolution=2).extrude((0, 0, 1.0), capping=True)
    edges = pv.PolyData(solid.points, faces=solid.faces, lines=np.array([2, 0, 1]))
    edges.save(tmp_path / "solid.vtp")
    assert not read_template(tmp_path / "solid.vtp", curves=True).curve


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("curves")
    x, y = FLAT.T
    for axis in range(3):
        curve = lines(FLAT, turned(ROUND, np.arange(COUNT) % 3 == 0), axis)
        vector = lifted(np.stack([np.exp(-((x - 1) ** 2)), y], axis=1), axis, 0.0)
        curve.point_data["vector"], curve.point_data["scalar"] = vector, 2.0 + x
        curve.point_data["marks"] = (x < -1.5).astype(float)
        curve.cell_data["force"] = SIDES * (2.0 + 0.5 * (x + np.roll(x, -1)))
        curve.save(directory / f"{'xyz'[axis]}.vtp")
    return directory


def build(folder: Path, axis: str = "z", **settings: Any) -> Scenario:
    return mesh(template=str(folder / f"{axis}.vtp"), planar=axis, **{"sensitivity": "vector", **settings})


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("weights", ["uniform", "area"])
def test_a_scalar_is_taken_along_the_outward_normal_and_per_length(axis: int, weights: str, folder: Path) -> None:
    for kind in ("nodal", "density"):
        made = build(folder, "xyz"[axis], sensitivity="scalar", sensitivity_kind=kind, weights=weights,
                     sensitivity_normal="outward")  # fmt: skip
        mass = LENGTHS / LENGTHS.mean() if weights == "area" else np.ones(COUNT)
        wanted = -((2.0 + FLAT[:, 0]) * (LENGTHS if kind == "density" else 1.0) / mass)[:, None] * outward()
        wanted = lifted(wanted / np.sqrt((mass[:, None] * wanted**2).sum()), axis, 0.0)
        np.testing.assert_allclose(made.gradient.numpy(), wanted, atol=1e-12)
        np.testing.assert_allclose(made.weights.numpy(), mass, rtol=1e-12)
    assert made.planar == Plane(axis, 0.25)
    assert made.faces.shape == (0, 3)
    assert f"{COUNT} vertices, {COUNT} segments" in made.notes["template"]
    assert "16 segments were turned" in made.notes["winding"]
    assert made.notes["planar"].startswith("the design is in one plane; centers lie in the plane")
    assert "flat" not in made.notes
    assert made.warnings == []


def test_cell_arrays_of_segments(folder: Path) -> None:
    made = build(folder, sensitivity="force", sensitivity_normal="outward")
    force = SIDES * (2.0 + 0.5 * (FLAT[:, 0] + np.roll(FLAT[:, 0], -1)))
    wanted = -0.5 * (force + np.roll(force, 1))[:, None] * outward()
    np.testing.assert_allclose(made.gradient[:, :2].numpy(), wanted / np.linalg.norm(wanted), atol=1e-12)


def test_centers_are_drawn_uniformly_on_the_curve() -> None:
    places = torch.tensor([[0.0, 0, 1], [3, 0, 1], [3, 1, 1]], dtype=torch.float64)
    drawn = curve_sampler(places, torch.tensor([[0, 1], [1, 2]]))(50, 400, torch.Generator().manual_seed(0)).flatten(
        0, 1
    )
    on_first = drawn[:, 1] == 0
    assert float(on_first.double().mean()) == pytest.approx(0.75, abs=0.01)
    assert float(drawn[on_first, 0].mean()) == pytest.approx(1.5, abs=0.05)
    assert float(drawn[on_first, 0].var()) == pytest.approx(0.75, abs=0.03)
    assert bool((drawn[:, 2] == 1).all())
    assert bool((drawn[~on_first, 0] == 3).all())


def test_a_target_curve_is_met_at_its_closest_point(folder: Path, tmp_path: Path) -> None:
    bigger = 1.2 * ring(400)
    around = np.stack([np.arange(400), (np.arange(400) + 1) % 400], axis=1)
    lines(bigger, around, height=9.0).save(tmp_path / "bigger.vtp")
    made = build(folder, sensitivity=None, target=str(tmp_path / "bigger.vtp"))
    wanted = (made.gradient * made.gradient_norm).numpy()
    dense = np.concatenate([bigger + t * (np.roll(bigger, -1, axis=0) - bigger) for t in np.linspace(0, 1, 200)])
    distance = cdist(FLAT, dense).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(wanted, axis=1), distance, atol=1e-4)
    assert (wanted[:, 2] == 0).all()
    assert "a curve of 400 segments" in made.notes["target"]
    assert made.notes["rejected"].startswith("0 of 48")
    assert made.closest is not None
    np.testing.assert_allclose(made.closest(made.vertices.numpy()) - made.vertices.numpy(), wanted, atol=1e-12)
    half = [pair for pair in around if (bigger[pair, 0] >= -1e-9).all()]
    lines(bigger, np.array(half)).save(tmp_path / "half.vtp")
    made = build(folder, sensitivity=None, target=str(tmp_path / "half.vtp"))
    assert made.stays is not None
    assert made.stays.numpy()[FLAT[:, 0] < -1e-9].all()
    assert not made.stays.numpy()[FLAT[:, 0] > 0.3].any()


@pytest.mark.parametrize("fixed", ["marks", [None, None, None, -1.5, None, None]])
def test_symmetry_and_regions_of_a_curve(fixed: Any, folder: Path) -> None:
    made = build(folder, symmetry="y", fixed=fixed, keep_out=True)
    assert made.mirror is not None
    assert made.mirror.at == 0.0
    assert "0.0% of |g|^2 is not symmetric" in made.notes["symmetry"]
    assert "mirror images lie within 0 of" in made.notes["symmetry"]
    centers = made.parameterization(made.sample(20, 6, torch.Generator().manual_seed(1)))
    assert bool((centers[..., 2] == 0.25).all())
    assert bool((centers[..., 1] >= 0).all())
    assert float(centers[..., 0].min()) >= -1.6
    with pytest.raises(UserError, match="leaves no segment for centers"):
        build(folder, fixed=[None, None, None, 1.99, None, None], keep_out=True)


def test_curves_that_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds a curve \(48 lines\) and no faces: set scenario\.planar=z"):
        mesh(template=str(folder / "z.vtp"), sensitivity="vector")
    with pytest.raises(UserError, match=r"the curve lie in 25 layers across x, but a planar curve lies in one plane"):
        mesh(template=str(folder / "z.vtp"), sensitivity="vector", planar="x")
    curve = lines(FLAT, ROUND)
    curve.points[3] = np.nan
    curve.save(tmp_path / "bad.vtp")
    with pytest.raises(UserError, match="1 of 48 vertices of its lines have coordinates that are not finite"):
        mesh(template=str(tmp_path / "bad.vtp"), sensitivity="vector", planar="z")
    straight = pv.PolyData(np.eye(3)[:1] * np.arange(5.0)[:, None], lines=np.array([5, 0, 1, 2, 3, 4]))
    straight.point_data["s"] = np.ones((5, 3))
    straight.save(tmp_path / "straight.vtp")
    with pytest.raises(UserError, match="all vertices lie on one line"):
        mesh(template=str(tmp_path / "straight.vtp"), sensitivity="s", planar="z")


def run(out: Path, folder: Path, *overrides: str) -> dict[str, np.ndarray]:
    given = [f"scenario.template={folder / 'z.vtp'}", "scenario.sensitivity=vector", "scenario.planar=z"]
    assert main([f"hydra.run.dir={out}", "scenario=mesh", *given, "evaluator=eager", "quiet=true", *overrides]) == 0
    with np.load(out / "setups.npz") as setups:
        return dict(setups)


@pytest.mark.parametrize("method", METHODS)
def test_every_center_lies_in_the_plane_of_the_curve(
    method: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])
    settings = [setting for setting in METHODS[method] if "coarse" not in setting]
    setups = run(tmp_path, folder, f"method={method}", *settings, "centers=5", "scenario.symmetry=y")
    assert (setups["centers"][..., 2] == 0.25).all()
    assert (setups["centers"][:, -1, 1] == 0.0).all()
    assert setups["regularity"].max() > 0.0


@pytest.mark.figures
def test_a_curve_is_drawn_exported_and_applied(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    run(out, folder, "method=lloyd", "centers=6", "kernel.support=1.5", "figures=true")
    for name in ("front.png", "centers.png", "report.html"):
        assert (out / name).stat().st_size > 1000
    assert "warning" not in capsys.readouterr().out
    towards, upward = standpoint(read(out))
    assert (towards.tolist(), upward.tolist()) == ([0, 0, 1], [0, 1, 0])
    assert json.loads((out / "summary.json").read_text())["planar"] == {"axis": "z", "at": 0.25}
    assert export.main([str(out), "--pick", "index:0", "--quiet"]) == 0
    table = out / "export-index-0" / "displacements.csv"
    (tmp_path / "flat.su2").write_text(SQUARE_SU2)
    command = [str(out), "--pick", "index:0", "--displacements", str(table), "--mesh", str(tmp_path / "flat.su2")]
    assert apply.main([*command, "--out", str(tmp_path / "moved.su2")]) == 0
    moved = read_template(tmp_path / "moved.su2", curves=True)
    assert moved.vertices.shape == (4, 3)
    assert (moved.vertices[:, 2] == 0).all()
    assert np.abs(moved.vertices[1, :2] - [1.0, 0.0]).max() > 1e-3
    command[-1] = str(folder / "z.vtp")
    assert apply.main([*command, "--out", str(tmp_path / "moved.vtp")]) == 0
    curve: Any = pv.read(tmp_path / "moved.vtp")
    assert curve.n_lines == COUNT
    assert (np.asarray(curve.points)[:, 2] == 0.25).all()
    with np.load(out / "scenario.npz") as files:
        assert files["faces"].shape == (0, 3)


def test_normals_follow_the_axes() -> None:
    """A counterclockwise curve seen against the axis has normals that point outwards, whichever the axis is."""
    for axis in range(3):
        plane = Plane(axis, 0.0)
        u, v = np.eye(3)[plane.others]
        np.testing.assert_array_equal(np.cross(u, v), np.eye(3)[axis])
    assert HALVES == (2.0, 1.0)
