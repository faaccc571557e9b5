"""scenario.smooth: g smoothed over a length, on any mesh, for both weights, and what a run saves of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.geometry import sobolev, topology
from rbfevo.recorded.record import read
from rbfevo.scenarios import mesh, smoothing
from rbfevo.scenarios.coarse import coarsened
from rbfevo.scenarios.scenario import Scenario

BALL = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
X, FACES = np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64)
AREAS = topology.vertex_areas(X, FACES)
RANDOM = np.random.default_rng(11)
NODAL = RANDOM.normal(size=(len(X), 3))
LENGTH = 0.7


def written(folder: Path, values: np.ndarray, vertices: np.ndarray = X, faces: np.ndarray = FACES) -> dict[str, Any]:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    (folder / "a.obj").write_text("\n".join(lines) + "\n")
    np.save(folder / "s.npy", values)
    return {"template": str(folder / "a.obj"), "sensitivity": str(folder / "s.npy")}


def dense(density: np.ndarray, areas: np.ndarray, faces: np.ndarray, length: float) -> np.ndarray:
    """The filter by dense algebra, on the rows with an area."""
    operator = np.diag(areas) + length**2 * sobolev.stiffness(X, faces).toarray()
    found, kept = np.zeros_like(density), areas > 0.0
    found[kept] = np.linalg.solve(operator[np.ix_(kept, kept)], areas[kept, None] * density[kept])
    return found


def squared(made: Scenario, rows: np.ndarray) -> float:
    return float((made.weights.numpy()[:, None] * rows**2).sum())


@pytest.mark.parametrize("weights", ["uniform", "area"])
@pytest.mark.parametrize("kind", ["nodal", "density"])
@pytest.mark.parametrize("objective", ["minimize", "maximize"])
def test_the_density_of_the_sensitivity_is_filtered(weights: str, kind: str, objective: str, tmp_path: Path) -> None:
    settings: dict[str, Any] = written(tmp_path, NODAL)
    settings |= {"weights": weights, "sensitivity_kind": kind, "objective": objective}
    plain, made = mesh(**settings), mesh(**settings, smooth=LENGTH)
    density = NODAL / AREAS[:, None] if kind == "nodal" else NODAL
    weight = AREAS / AREAS.mean() if weights == "area" else np.ones(len(X))
    sign = -1.0 if objective == "minimize" else 1.0
    raw, wanted = (
        sign * field * (AREAS / weight)[:, None] for field in (density, dense(density, AREAS, FACES, LENGTH))
    )
    displacement = (made.gradient * made.gradient_norm).numpy()
    np.testing.assert_allclose(displacement, wanted, atol=1e-9 * np.abs(wanted).max())
    assert made.gradient_raw is not None
    np.testing.assert_allclose(made.gradient_raw.numpy() * made.gradient_norm, raw, atol=1e-9 * np.abs(raw).max())
    np.testing.assert_allclose(plain.gradient.numpy() * plain.gradient_norm, raw, atol=1e-9 * np.abs(raw).max())
    assert squared(made, made.gradient.numpy()) == pytest.approx(1.0)
    share = 1.0 - squared(made, wanted) / squared(made, raw)
    assert f", which removes {share:.1%} of |g|^2" in made.notes["smooth"]
    assert 0.5 < share < 1.0
    assert made.smooth == LENGTH
    assert (plain.smooth, plain.gradient_raw) == (None, None)
    assert "smooth" not in plain.notes


def test_a_targets_displacement_is_filtered_itself(tmp_path: Path) -> None:
    """With uniform weights too: a constant displacement stays, whatever the areas of the vertices are."""
    stretched = X * [1.0, 1.0, 0.2]
    written(tmp_path, NODAL, stretched)
    bumps = stretched * (1.0 + 0.2 * np.sign(np.sin(9.0 * X[:, :1])))
    trimesh.Trimesh(bumps, FACES, process=False).export(tmp_path / "b.off", digits=16)
    settings: dict[str, Any] = {"template": str(tmp_path / "a.obj"), "target": str(tmp_path / "b.off")}
    plain, made = mesh(**settings), mesh(**settings, smooth=LENGTH)
    raw = (plain.gradient * plain.gradient_norm).numpy()
    expected = sobolev.smoothed(raw, sobolev.mass(stretched, FACES), sobolev.stiffness(stretched, FACES), LENGTH)
    np.testing.assert_allclose((made.gradient * made.gradient_norm).numpy(), expected, atol=1e-9)
    assert made.objective is None
    still = np.zeros(len(X), bool)
    constant = np.tile([0.3, -1.0, 2.0], (len(X), 1))
    found = smoothing.smoothed(constant, stretched, FACES, np.ones(len(X)), still, LENGTH, integrated=False)
    np.testing.assert_allclose(found.wanted, constant, atol=1e-9)
    assert found.removed == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("integrated", [True, False])
def test_held_vertices_keep_zero_and_do_not_pull(integrated: bool) -> None:
    held = X[:, 2] < -0.4
    field = np.tile([1.0, -2.0, 0.0], (len(X), 1))
    rows = np.where(held[:, None], 0.0, field * AREAS[:, None] if integrated else field)
    found = smoothing.smoothed(rows, X, FACES, np.ones(len(X)), held, LENGTH, integrated).wanted
    assert not found[held].any()
    np.testing.assert_allclose(found, rows, atol=1e-9)  # a constant density stays up to the border
    noise = np.where(held[:, None], 0.0, NODAL)
    free = FACES[~held[FACES].any(axis=1)]
    areas = np.where(held, 0.0, AREAS)
    density = noise / AREAS[:, None] if integrated else noise
    expected = dense(density, areas, free, LENGTH) * (AREAS[:, None] if integrated else 1.0)
    for rows in (noise, NODAL):  # what a held vertex should do counts for nothing
        found = smoothing.smoothed(rows, X, FACES, np.ones(len(X)), held, LENGTH, integrated).wanted
        np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.parametrize("integrated", [True, False])
def test_the_share_is_that_of_the_weighted_norm(integrated: bool) -> None:
    weights = np.exp(2.0 * X[:, 0])
    still = np.zeros(len(X), bool)
    found = smoothing.smoothed(NODAL, X, FACES, weights, still, LENGTH, integrated)
    factor = weights[:, None] / AREAS[:, None] if integrated else 1.0
    expected = dense(NODAL * factor, AREAS, FACES, LENGTH) / factor
    np.testing.assert_allclose(found.wanted, expected, atol=1e-9 * np.abs(expected).max())
    before, after = ((weights[:, None] * rows**2).sum() for rows in (NODAL, expected))
    assert found.removed == pytest.approx(1.0 - after / before, rel=1e-9)


def test_fixed_vertices_of_a_scenario_stay_out(tmp_path: Path) -> None:
    made = mesh(**written(tmp_path, NODAL), fixed=[None, None, None, None, None, -0.4], smooth="10%")
    held = X[:, 2] <= -0.4
    assert made.gradient_raw is not None
    for rows in (made.gradient, made.gradient_raw):
        assert ((rows != 0).any(dim=1).numpy() == ~held).all()
    assert made.smooth == pytest.approx(0.1 * made.diagonal)
    assert f"smoothed over {made.smooth:.4g} (" in made.notes["smooth"]
    plain = mesh(**written(tmp_path, NODAL), fixed=[None, None, None, None, None, -0.4])
    ratio = made.gradient_raw.numpy() * made.gradient_norm
    np.testing.assert_allclose(ratio, plain.gradient.numpy() * plain.gradient_norm, atol=1e-9)


def test_a_free_vertex_among_held_ones_keeps_its_value() -> None:
    held = np.arange(len(X)) != 5
    rows = np.where(held[:, None], 0.0, NODAL)
    found = smoothing.smoothed(rows, X, FACES, np.ones(len(X)), held, LENGTH, integrated=True).wanted
    np.testing.assert_allclose(found, rows, atol=1e-12)


def dilated(points: np.ndarray, factor: float) -> np.ndarray:
    """A unit sphere's points moved towards (0, 0, 1): their stereographic images times `factor`."""
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = factor * points[:, :2] / (1.0 - points[:, 2:])
    squares = (flat**2).sum(axis=1, keepdims=True)
    found = np.concatenate([2.0 * flat, squares - 1.0], axis=1) / (squares + 1.0)
    return np.where(np.isfinite(found), found, points)


@pytest.mark.parametrize("weights", ["uniform", "area"])
def test_area_weighted_g_does_not_depend_on_the_mesh(weights: str, tmp_path: Path) -> None:
    """Two spherical harmonics on even and very uneven meshes of a ball: each is divided by its eigenvalue."""
    length, radius, errors, ratios = 0.8, 2.0, [], []
    for level, factor in ((3, 1.0), (4, 1.0), (4, 2.0), (5, 2.0)):
        ball = trimesh.creation.icosphere(subdivisions=level)
        unit = dilated(np.asarray(ball.vertices, np.float64), factor)
        faces = np.asarray(ball.faces, np.int64)
        areas = topology.vertex_areas(radius * unit, faces)
        x, y, z = unit.T
        density = z + 3.0 * x * y
        expected = z / (1.0 + 2.0 * (length / radius) ** 2) + 3.0 * x * y / (1.0 + 6.0 * (length / radius) ** 2)
        nodal = (density * areas)[:, None] * [[0.0, 0.6, 0.8]]
        settings = written(tmp_path, nodal, radius * unit, faces)
        made = mesh(**settings, smooth=length, weights=weights)
        wanted = (made.gradient * made.gradient_norm).numpy() @ [0.0, 0.6, 0.8]
        g = -wanted / (areas.mean() if weights == "area" else areas)
        errors.append(np.sqrt(areas @ (g - expected) ** 2 / (areas @ expected**2)))
        ratios.append(areas.max() / areas.min())
    assert ratios[-1] > 10.0 > ratios[0]
    assert errors[0] < 0.01
    assert errors[2] < 0.02
    assert errors[1] < 0.35 * errors[0]
    assert errors[3] < 0.35 * errors[2]


def test_pieces_of_a_scenario(tmp_path: Path) -> None:
    values = np.concatenate([NODAL, np.zeros_like(NODAL)])
    both = np.concatenate([X, X + np.array([9.0, 0, 0])]), np.concatenate([FACES, FACES + len(X)])
    made = mesh(**written(tmp_path, values, *both), smooth=1.5)
    assert not made.gradient[len(X) :].any()
    assert bool((made.gradient[: len(X)] != 0).all())


@pytest.mark.parametrize("smooth", [0, -1.0, "0%", "nan", "wide", True])
def test_no_length_is_refused(smooth: object, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=rf"scenario\.smooth={smooth}: give a positive number in model units"):
        mesh(**written(tmp_path, NODAL), smooth=smooth)


def test_designs_made_of_it(tmp_path: Path) -> None:
    made = mesh(**written(tmp_path, NODAL), smooth=LENGTH, symmetry="x")
    assert made.gradient_raw is not None
    assert made.half().gradient_raw is None
    assert coarsened(made, 100).gradient_raw is None
    kind: Any = torch.float32  # Tensor.to takes it for a device as well
    moved = made.to(kind).gradient_raw
    assert moved is not None
    assert moved.dtype == torch.float32
    with pytest.raises(UserError, match="shapes that do not match"):
        Scenario(**{**vars(made), "gradient_raw": made.gradient_raw[:-1]})


@pytest.mark.parametrize("smooth", [None, 0.5])
def test_a_run_saves_it(smooth: float | None, tmp_path: Path) -> None:
    settings = written(tmp_path, NODAL)
    words = [
        "scenario=mesh",
        "method=random",
        "centers=3",
        "figures=false",
        "quiet=true",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    words += [f"scenario.{key}={value}" for key, value in settings.items()]
    words += [f"scenario.smooth={smooth}"] if smooth else []
    assert main(words) == 0
    run = tmp_path / "run"
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["smooth"], summary["objective"]) == (smooth, "minimize")
    assert "it wants to move most at" in summary["notes"]["largest move"]
    record = read(run)
    if smooth is None:
        assert record.gradient_raw is None
        return
    assert record.gradient_raw is not None
    norm = summary["gradient_norm"]
    np.testing.assert_allclose(record.gradient_raw * norm, -NODAL, atol=1e-9)
    assert "removes" in summary["notes"]["smooth"]
    arrays = dict(np.load(run / "scenario.npz"))
    np.savez(run / "scenario.npz", **{**arrays, "gradient_raw": arrays["gradient_raw"][1:]})
    with pytest.raises(UserError, match="do not match"):
        read(run)
