"""What `python -m rbfevo.export` writes, against plain NumPy and independent readers."""

from __future__ import annotations

import configparser
import csv
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
import trimesh
from scipy.spatial.distance import cdist
from test_columns import MIRRORS, field, phi

from rbfevo import apply, export
from rbfevo.recorded.record import Record, read

CASES = {
    "plane": {"d": 2, "kernel": "wendland"},
    "plane, log": {"d": 2, "kernel": "triharmonic", "manipulation": "direct"},
    "mirrored plane": {"d": 2, "kernel": "triharmonic", "manipulation": "direct", "symmetry": MIRRORS[2], "on": 1},
    "space": {"d": 3, "kernel": "wendland", "manipulation": "direct"},
    "cubic": {"d": 3, "kernel": "triharmonic"},
    "mirrored": {"d": 3, "kernel": "wendland", "manipulation": "direct", "symmetry": MIRRORS[1], "on": 2},
    "mirrored, cubic": {"d": 3, "kernel": "triharmonic", "symmetry": MIRRORS[1]},
}


def a_run(
    run: Path, *, d: int = 3, kernel: str = "wendland", symmetry: Any = None, on: int = 0, m: int = 6, **summary: Any
) -> Path:
    """Write a run directory of four setups with chosen scores; the first `on` centers lie on the symmetry plane."""
    rng = np.random.default_rng(5)
    if d == 2:
        x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 2, 13), indexing="ij"))
        vertices, lower, upper = np.stack([x, y], axis=1), np.zeros(2), np.array([1.0, 2.0])
        corner = np.arange(8 * 13).reshape(8, 13)[:, :-1].ravel()
        faces = np.concatenate([corner[:, None] + [0, 13, 14], corner[:, None] + [0, 14, 1]])
        g = (np.cos(3 * x) * y)[:, None]
    else:
        ball = trimesh.creation.icosphere(subdivisions=2)
        vertices, faces, lower, upper = np.array(ball.vertices), np.array(ball.faces), np.full(3, -1.0), np.ones(3)
        g = vertices * [0.5, 0.1, 0.4] * (vertices[:, 2:] > 0)
    weights = rng.uniform(0.5, 2.0, len(vertices))
    norm = float(np.sqrt((weights[:, None] * g**2).sum()))
    centers = rng.uniform(lower, upper, (4, m, d))
    if symmetry is not None:
        centers[:, :on, "xyz".index(symmetry["axis"])] = symmetry["at"]
    run.mkdir(parents=True)
    np.savez(
        run / "setups.npz",
        centers=centers,
        regularity=np.array([0.1, 0.2, 0.3, 0.05]),
        improvement_potential=np.array([0.8, 0.75, 0.1, 0.05]),
        method=np.array(["gradient", "gradient", "lloyd", "random"]),
        preference=np.full(4, np.nan),
        nondominated=np.array([True, True, True, False]),
    )
    box = {"lower": lower, "upper": upper}
    np.savez(run / "scenario.npz", vertices=vertices, faces=faces, gradient=g / norm, weights=weights, **box)
    content = {"scenario": "face", "kernel": kernel, "support": 0.9 if kernel == "wendland" else None}
    content |= {"manipulation": "indirect", "gradient_norm": norm, "symmetry": symmetry}
    (run / "summary.json").write_text(json.dumps(content | summary))
    return run


def table(path: Path) -> tuple[list[str], Any]:
    with path.open() as file:
        header, *rows = list(csv.reader(file))
    return header, np.array(rows, dtype=float)


def spatial(rows: Any) -> Any:
    """Heights as z, and points of the plane with z = 0."""
    zero = np.zeros((len(rows), 1))
    return np.hstack([zero, zero, rows] if rows.shape[1] == 1 else [rows, zero] if rows.shape[1] == 2 else [rows])


def best(record: Record, row: int) -> Any:
    """Weights [m, k] of least norm for the wanted displacement, by the pseudoinverse of the whole linear map."""
    m, k = len(record.centers[row]), record.gradient.shape[1]
    A = np.stack([field(record, row, record.vertices, unit.reshape(m, k)).ravel() for unit in np.eye(m * k)], axis=1)
    root = np.sqrt(np.repeat(record.weights, k))
    return (np.linalg.pinv(root[:, None] * A, rcond=1e-13) @ (root * record.gradient.ravel())).reshape(m, k)


@pytest.mark.parametrize("name", CASES)
def test_every_file_says_what_numpy_says(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run", **CASES[name])
    assert export.main([str(run), "--pick", "index:1"]) == 0
    out, output = run / "export-index-1", capsys.readouterr().out
    record = read(run)
    C, (m, d), k = record.centers[1], record.centers[1].shape, record.gradient.shape[1]
    norm, symmetry, on = record.summary["gradient_norm"], record.summary["symmetry"], CASES[name].get("on", 0)
    w = norm * best(record, 1)
    reached, wanted = field(record, 1, record.vertices, w), norm * record.gradient
    axis = None if symmetry is None else "xyz".index(symmetry["axis"])
    off = np.arange(on if symmetry else 0, m)

    physical, column = C, np.arange(m)
    if symmetry is not None and axis is not None:
        images = C[off].copy()
        images[:, axis] = 2 * symmetry["at"] - images[:, axis]
        physical, column = np.concatenate([C, images]), np.concatenate([column, off])
    header, rows = table(out / "centers.csv")
    assert header == ["center", "x", "y", "z", "mirrored", "times"]
    mirrored = (np.arange(len(physical)) >= m).astype(float)
    np.testing.assert_allclose(rows[:, :5], np.column_stack([column, spatial(physical), mirrored]), atol=1e-15)
    times = rows[:, 5]

    header, rows = table(out / "weights.csv")
    assert header == ["center", "x", "y", "z", "wx", "wy", "wz"]
    np.testing.assert_allclose(rows, np.column_stack([np.arange(m), spatial(C), spatial(w)]), atol=1e-8)
    # What an engineer would do with both tables: add up the kernel times the weights, turned over for images.
    own = rows[column, 4:] * times[:, None]
    if axis is not None and k > 1:
        own[mirrored > 0, axis] *= -1
    distance = cdist(spatial(record.vertices), spatial(physical))
    summed = phi(distance, CASES[name]["kernel"], record.summary["support"], d) @ own
    np.testing.assert_allclose(summed, spatial(reached), atol=1e-8)
    header, rows = table(out / "displacements.csv")
    assert header == ["center", "x", "y", "z", "dx", "dy", "dz"]
    np.testing.assert_allclose(rows[:, 4:], spatial(field(record, 1, C, w)), atol=1e-8)
    assert rows[:, 0].tolist() == list(range(m))

    points: Any = pyvista.read(out / "centers.vtp")
    np.testing.assert_allclose(points.points, spatial(physical), atol=1e-15)
    assert points.n_verts == points.n_cells == len(physical)
    np.testing.assert_array_equal(points["mirrored"], mirrored)
    np.testing.assert_array_equal(points["center"], column)
    np.testing.assert_allclose(points["displacement"], spatial(field(record, 1, physical, w)), atol=1e-8)
    assert ("support" in points.point_data) == (CASES[name]["kernel"] == "wendland")
    template: Any = pyvista.read(out / "template.vtp")
    np.testing.assert_array_equal(template.points, spatial(record.vertices))
    np.testing.assert_array_equal(template.regular_faces, record.faces)
    np.testing.assert_allclose(template["wanted"], spatial(wanted), atol=1e-12)
    np.testing.assert_allclose(template["reached"], spatial(reached), atol=1e-8)
    np.testing.assert_allclose(template["left"], spatial(wanted - reached), atol=1e-8)
    np.testing.assert_array_equal(template["weights"], record.weights)

    with np.load(out / "setup.npz", allow_pickle=False) as archive:
        arrays: dict[str, Any] = dict(archive)
    for key in ("vertices", "faces", "lower", "upper"):
        np.testing.assert_array_equal(arrays[key], getattr(record, key))
    np.testing.assert_array_equal(arrays["centers"], C)
    assert (str(arrays["kernel"]), str(arrays["manipulation"])) == (
        record.summary["kernel"],
        record.summary["manipulation"],
    )
    assert (float(arrays["regularity"]), float(arrays["improvement_potential"]), int(arrays["row"])) == (0.2, 0.75, 1)
    np.testing.assert_equal(float(arrays["support"]), record.summary["support"] or np.nan)
    assert str(arrays["symmetry_axis"]) == (symmetry["axis"] if symmetry else "")
    np.testing.assert_equal(float(arrays["symmetry_at"]), symmetry["at"] if symmetry else np.nan)
    # U of the optimizer: each component of X' - X is U p, whatever p.
    p = np.random.default_rng(1).normal(size=(m, k))
    crosses = symmetry is not None and k > 1
    assert ("U_across" in arrays) == ("across" in arrays) == crosses
    u = arrays["U"] @ p
    if crosses:
        p[:on, axis] = 0.0
        np.testing.assert_array_equal(arrays["across"], off)
        u[:, axis] = arrays["U_across"] @ p[off, axis]
    if record.summary["manipulation"] == "indirect":
        np.testing.assert_allclose(u, field(record, 1, record.vertices, p), atol=1e-10)
    else:  # the parameters are the displacements of the centers
        moves = np.stack([field(record, 1, C, e.reshape(m, k)).ravel() for e in np.eye(m * k)], axis=1)
        weights = (np.linalg.pinv(moves) @ p.ravel()).reshape(m, k)
        np.testing.assert_allclose(u, field(record, 1, record.vertices, weights), atol=1e-7)

    assert f"row 1 of {run} (gradient): R = 0.2, P = 0.7500" in output
    assert ("parameters.prm" in [path.name for path in out.iterdir()]) == (d == 3)
    assert ("left out: parameters.prm: PyGeM adds a linear polynomial" in output) == (d == 2)
    # The command that it names works and leads to what the least squares reach.
    (line,) = [line for line in output.splitlines() if line.startswith("next: ")]
    arguments = shlex.split(line.removeprefix("next: python -m rbfevo.apply "))
    assert apply.main([*arguments, "--quiet"]) == 0
    deformed: Any = pyvista.read(out / "deformed.vtp")
    np.testing.assert_allclose(deformed.points, spatial(record.vertices) + spatial(reached), atol=1e-7)


def parse_pygem(path: Path) -> tuple[str, float, dict[str, Any], Any, Any]:
    """Kernel, radius, keywords and points of a PyGeM parameter file, by the documented format."""
    config = configparser.RawConfigParser()
    assert config.read(path)
    settings = dict(config.items("Radial Basis Functions"))
    kernel, radius = settings.pop("basis function"), float(settings.pop("radius"))
    original, deformed = (
        np.array([line.split() for line in config.get("Control points", f"{which} control points").split("\n")], float)
        for which in ("original", "deformed")
    )
    return kernel, radius, {key: int(value) for key, value in settings.items()}, original, deformed


@pytest.mark.parametrize("name", ["space", "cubic", "mirrored", "mirrored, cubic"])
def test_pygem_would_interpolate_the_control_points(name: str, tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", **CASES[name])
    assert export.main([str(run), "--pick", "index:0", "--quiet", "--out", str(tmp_path / "out")]) == 0
    kernel, radius, keywords, original, deformed = parse_pygem(tmp_path / "out" / "parameters.prm")
    _, centers = table(tmp_path / "out" / "centers.csv")
    _, moves = table(tmp_path / "out" / "displacements.csv")
    moves = moves[:, [0, 4, 5, 6]]
    np.testing.assert_array_equal(original, centers[:, 1:4])
    expected = moves[centers[:, 0].astype(int), 1:]
    expected[centers[:, 4] == 1] *= [1, -1, 1]
    np.testing.assert_allclose(deformed - original, expected, atol=1e-14)
    if "cubic" in name:
        assert (kernel, radius, keywords) == ("polyharmonic_spline", 1.0, {"k": 3})
    else:
        assert (kernel, radius, keywords) == ("beckert_wendland_c2_basis", 0.9, {})
    # PyGeM's system: the kernel, a constant and a linear polynomial.
    q = len(original)
    Phi = phi(np.linalg.norm(original[:, None] - original, axis=2), CASES[name]["kernel"], 0.9, 3)
    P = np.hstack([np.ones((q, 1)), original])
    system = np.block([[Phi, P], [P.T, np.zeros((4, 4))]])
    weights = np.linalg.solve(system, np.vstack([deformed, np.zeros((4, 3))]))
    np.testing.assert_allclose(np.hstack([Phi, P]) @ weights, deformed, atol=1e-8)


@pytest.mark.parametrize("summary", [{"gradient_is": "direction"}, {"gradient_norm": None}])
def test_a_direction_is_scaled_to_the_step(summary: dict[str, Any], tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", **summary)
    for step, name in ((None, "a"), (0.2, "b")):
        arguments = [] if step is None else ["--step", str(step)]
        assert export.main([str(run), "--pick", "knee", "--quiet", "--out", str(tmp_path / name), *arguments]) == 0
        template: Any = pyvista.read(tmp_path / name / "template.vtp")
        diagonal = np.linalg.norm(np.ptp(template.points, axis=0))
        size = np.linalg.norm(template["reached"], axis=1).max()
        assert size == pytest.approx((step or 0.05) * diagonal, rel=1e-9)
        # Wanted and reached keep their proportion.
        record, (wanted, reached) = read(run), (template["wanted"], template["reached"])
        factor = np.linalg.norm(wanted) / np.linalg.norm(record.gradient)
        np.testing.assert_allclose(wanted, factor * record.gradient, atol=1e-10)
        share = (record.weights[:, None] * (wanted - reached) ** 2).sum() / (record.weights[:, None] * wanted**2).sum()
        assert 0 < share < 1
    a, b = (table(tmp_path / name / "displacements.csv")[1][:, 4:] for name in "ab")
    np.testing.assert_allclose(4 * a, b, atol=1e-12)


@pytest.mark.parametrize("manipulation", ["direct", "indirect"])
def test_a_singular_psi_leaves_out_what_needs_it(
    manipulation: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = a_run(tmp_path / "run", manipulation=manipulation)
    with np.load(run / "setups.npz") as archive:
        arrays: dict[str, Any] = dict(archive)
    arrays["centers"][0, 1] = arrays["centers"][0, 0]
    np.savez(run / "setups.npz", **arrays)
    assert export.main([str(run), "--pick", "index:0", "--out", str(tmp_path / "out")]) == 0
    output = capsys.readouterr().out
    present = {path.name for path in (tmp_path / "out").iterdir()}
    assert present == {"centers.csv", "centers.vtp", "template.vtp", "setup.npz", "weights.csv"}
    with np.load(tmp_path / "out" / "setup.npz") as archive:
        assert ("U" in archive) == (manipulation == "indirect")
    assert ("left out: U in setup.npz" in output) == (manipulation == "direct")
    assert "left out: displacements.csv: these centers cannot be moved one by one: their kernel matrix Psi is" in output
    (line,) = [line for line in output.splitlines() if line.startswith("next: ")]
    assert "--weights" in line
    assert apply.main(shlex.split(line.removeprefix("next: python -m rbfevo.apply "))) == 0


MISTAKES = {
    "RUN": "--pick",
    "RUN --pick nee": "choose one of knee",
    "RUN --pick index:9": "choose one from 0 to 3",
    "RUN/nowhere --pick knee": "there is no such run directory",
    "RUN/setups.npz --pick knee": "is a file, not a run directory",
    "RUN --pick knee --step 0": "above 0",
    "RUN --pick knee --step nan": "above 0",
    "RUN --pick knee --step 7": "at most 1",
    "RUN --pick knee --step x": "nor a percentage such as 5%",
    "RUN --pick knee --out RUN/setups.npz": "cannot be written",
    "RUN --pick knee --bogus": "--bogus",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_is_one_clear_line(arguments: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run")
    before = sorted(run.rglob("*"))
    assert export.main(arguments.replace("RUN", str(run)).split()) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert err.startswith("rbfevo.export: ")
    assert MISTAKES[arguments] in err
    assert sorted(run.rglob("*")) == before


def test_an_export_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run")
    arguments = [str(run), "--pick", "preference:0.3", "--quiet"]
    assert export.main(arguments) == 0
    assert capsys.readouterr().out == ""
    held = {path: path.read_bytes() for path in (run / "export-preference-0.3").iterdir()}
    assert {path.name for path in held} == set(export.FILES)
    assert export.main(arguments) == 2
    assert "already holds results (centers.csv): choose another --out" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in (run / "export-preference-0.3").iterdir()} == held
