"""Whole planar runs: every method's centers lie in the plane to the bit, and export and apply keep to it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from scipy.spatial.distance import cdist
from slabs import THICK, lifted, ring, saved, strip, volume
from test_mesh_runs import METHODS as MESH_METHODS

from rbfevo import apply, export
from rbfevo.__main__ import main
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup

COUNT = 64
METHODS = {**MESH_METHODS, "gradient": [*MESH_METHODS["gradient"], "method.coarse=100"], "ols": ["method.per_axis=12"]}
RESTRICTIONS = {
    "free": [],
    "symmetric": ["scenario.symmetry=y", "scenario.symmetry_at=0"],
    "kept out": ["scenario.fixed=[1.2,null,null,null,null,null]", "scenario.keep_out=true"],
    "kept out by marks": ["scenario.fixed=marks", "scenario.keep_out=true", "scenario.symmetry=y"],
}


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    x, y = np.tile(ring(COUNT), (2, 1)).T
    s = np.stack([np.exp(-((x - 1.0) ** 2)), y, 0.1 + 0.0 * x], axis=1)
    return saved(strip(COUNT), tmp_path_factory.mktemp("slab") / "slab.vtp", s=s, marks=(x < -1.5).astype(float))


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def run(out: Path, template: Path, *overrides: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    given = [f"scenario.template={template}", "scenario.sensitivity=s", "scenario.planar=z", "evaluator=eager"]
    assert main([f"hydra.run.dir={out}", "scenario=mesh", *given, "quiet=true", "centers=5", *overrides]) == 0
    with np.load(out / "setups.npz") as setups:
        return dict(setups), json.loads((out / "summary.json").read_text())


@pytest.mark.parametrize("restriction", RESTRICTIONS)
@pytest.mark.parametrize("method", METHODS)
def test_every_center_lies_in_the_plane_to_the_bit(
    method: str, restriction: str, template: Path, tmp_path: Path
) -> None:
    setups, summary = run(tmp_path, template, f"method={method}", *METHODS[method], *RESTRICTIONS[restriction])
    assert summary["planar"] == {"axis": "z", "at": 0.05}
    C = setups["centers"]
    assert (C[..., 2] == 0.05).all()
    assert len(np.unique(C[..., :2].reshape(-1, 2), axis=0)) >= 4
    if restriction.startswith("kept out"):
        flat = ring(COUNT)
        nearest = flat[cdist(C.reshape(-1, 3)[:, :2], flat).argmin(axis=1), 0]
        inside = C[..., 0] > 1.2 if restriction == "kept out" else (nearest < -1.5).reshape(C.shape[:2])
        assert not inside[:, :4].any()  # the last one may lie on the symmetry plane, which it does not leave
    if summary["symmetry"] is not None:
        assert (C[..., 1] >= 0).all()
        assert (C[:, -1, 1] == 0).all()
    if restriction == "free":
        X, support = np.concatenate([lifted(ring(COUNT), 2, z) for z in (0.0, THICK)]), summary["support"]
        for i, setup in enumerate(C):
            r = cdist(X, setup)
            U = np.where(r < support, (1 - r / support) ** 4 * (4 * r / support + 1), 0)
            sigma = np.linalg.svd(U, compute_uv=False)
            regularity = sigma[-1] / sigma[0] if sigma[-1] > 128 * np.finfo(float).eps * sigma[0] else 0.0
            assert setups["regularity"][i] == pytest.approx(regularity, rel=1e-6, abs=1e-12)


def test_candidates_of_ols_lie_in_the_plane_alone(template: Path, tmp_path: Path) -> None:
    """Twelve to a side are 144, of which the setup takes distinct points of the grid."""
    setups, _ = run(tmp_path, template, "method=ols", "method.per_axis=12", "centers=9")
    with np.load(tmp_path / "scenario.npz") as files:
        lower, upper = files["lower"], files["upper"]
    steps = (setups["centers"][0, :, :2] - lower[:2]) / (upper - lower)[:2] * 11
    np.testing.assert_allclose(steps, steps.round(), atol=1e-9)
    assert len(np.unique(steps.round(), axis=0)) == 9


def test_lloyd_of_a_thick_slab_does_not_split_front_and_back(tmp_path: Path) -> None:
    """Centers of clusters of one side alone would come in pairs, one behind the other."""
    thick = strip(COUNT, heights=(0.0, 10.0))
    path = saved(thick, tmp_path / "thick.vtp", s=np.tile([1.0, 0.5, 0.0], (2 * COUNT, 1)))
    setups, _ = run(tmp_path / "run", path, "method=lloyd", "centers=8", "kernel=triharmonic")
    C = setups["centers"][0]
    assert (C[:, 2] == 5.0).all()
    apart = cdist(C, C) + 9.0 * np.eye(8)
    assert apart.min() > 0.5


def test_the_first_pick_of_ols_is_the_best_column_of_the_mid_plane(tmp_path: Path) -> None:
    """Candidates on one side of a thick slab would see that side alone, and choose another."""
    heights = (0.0, 4.0)
    x, y = np.tile(ring(COUNT), (2, 1)).T
    lobes = np.exp(-2.0 * ((x - 2.0) ** 2 + y**2)) + 0.7 * np.exp(-0.3 * ((x + 2.0) ** 2 + y**2))
    s = np.stack([lobes, 0 * y, 0 * x], axis=1)
    path = saved(strip(COUNT, heights=heights), tmp_path / "thick.vtp", s=s)
    setups, _ = run(tmp_path / "run", path, "method=ols", "method.per_axis=9", "centers=3", "kernel.support=2.5")
    with np.load(tmp_path / "run" / "scenario.npz") as files:
        X, g, lower, upper = (files[name] for name in ("vertices", "gradient", "lower", "upper"))
    sides = [np.linspace(low, high, 9) for low, high in zip(lower[:2], upper[:2], strict=True)]
    grid = np.array([(a, b, 2.0) for a in sides[0] for b in sides[1]])
    r = cdist(X, grid)
    phi = np.where(r < 2.5, (1 - r / 2.5) ** 4 * (4 * r / 2.5 + 1), 0)
    gain = ((phi.T @ g) ** 2).sum(axis=1) / np.maximum((phi**2).sum(axis=0), 1e-300)
    np.testing.assert_allclose(setups["centers"][0, 0], grid[gain.argmax()])


@pytest.fixture(scope="module")
def exported(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rbfevo.figures.draw", lambda run: [])
        run(out, template, "method=lloyd", "kernel.support=1.5", "manipulation=direct", "centers=7")
    assert export.main([str(out), "--pick", "index:0", "--quiet"]) == 0
    return out


def test_the_exported_move_has_no_component_along_the_axis(exported: Path) -> None:
    for name in ("displacements.csv", "weights.csv"):
        rows = np.loadtxt(exported / "export-index-0" / name, delimiter=",", skiprows=1)
        assert (rows[:, 3] == 0.05).all()
        assert (rows[:, 6] == 0.0).all()
        assert np.abs(rows[:, 4:6]).max() > 0.0
    moved = np.asarray(pv.read(exported / "export-index-0" / "template.vtp").point_data["reached"])
    assert (moved[:, 2] == 0.0).all()
    np.testing.assert_array_equal(moved[:COUNT], moved[COUNT:])
    record = read(exported)
    found = setup(record, 0).displacement(record.vertices, np.ones((7, 3)))
    assert (found[:, 2] == 0.0).all()
    assert found[:, :2].max() > 0.0
    with np.load(exported / "export-index-0" / "setup.npz") as arrays:
        assert str(arrays["planar_axis"]) == "z"
        assert float(arrays["planar_at"]) == 0.05


@pytest.mark.parametrize("finer", [1, 3])
@pytest.mark.parametrize("heights", [(0.0, THICK), (0.0, float(np.float32(0.1)))])
def test_a_volume_mesh_moves_alike_in_front_and_back(
    finer: int, heights: tuple[float, float], exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = volume(finer * COUNT, 3 * finer, heights)
    mesh.save(tmp_path / "slab.vtu")
    table = exported / "export-index-0" / "displacements.csv"
    command = [str(exported), "--pick", "index:0", "--displacements", str(table), "--mesh", str(tmp_path / "slab.vtu")]
    assert apply.main([*command, "--out", str(tmp_path / "moved.vtu"), "--force"]) == 0
    moved: Any = pv.read(tmp_path / "moved.vtu")
    half = mesh.n_points // 2
    step = np.asarray(moved["displacement"])
    np.testing.assert_array_equal(step[:half], step[half:])
    assert (step[:, 2] == 0.0).all()
    np.testing.assert_array_equal(moved.points[:, 2], mesh.points[:, 2])
    np.testing.assert_array_equal(moved.points, mesh.points + step)
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    C, D = rows[:, 1:4], rows[:, 4:]

    def phi(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        r = cdist(a, b)
        return np.where(r < 1.5, (1 - r / 1.5) ** 4 * (4 * r / 1.5 + 1), 0)

    expected = phi(mesh.points, C) @ np.linalg.solve(phi(C, C), D)
    np.testing.assert_allclose(step, expected, atol=1e-6)
    assert np.abs(step).max() > 0.01


def test_a_move_out_of_the_plane_is_refused(
    exported: Path, template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = np.zeros((7, 3))
    rows[4, 2] = 0.1
    np.save(tmp_path / "d.npy", rows)
    command = [str(exported), "--pick", "index:0", "--mesh", str(template), "--out", str(tmp_path / "out.vtp")]
    assert apply.main([*command, "--displacements", str(tmp_path / "d.npy")]) == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    assert "the run is planar (scenario.planar=z), and center 4 cannot leave the plane z = 0.05" in line
    assert not (tmp_path / "out.vtp").exists()
