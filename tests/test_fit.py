"""Fits against plain NumPy on all vertices, against themselves in other units and batches, and the command line."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
import signal
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
import trimesh
from designs import numpy_phi
from matplotlib.image import imread
from scipy.linalg import subspace_angles
from scipy.spatial.distance import cdist
from torch import Tensor

from rbfevo import figures
from rbfevo.__main__ import main as run_main
from rbfevo.errors import UserError
from rbfevo.figures import __main__ as figures_main
from rbfevo.figures import fit as fit_figure
from rbfevo.fit import MANIPULATIONS, Objective, deformation, fits, source, strategy
from rbfevo.fit.__main__ import Progress, main
from rbfevo.fit.objective import residuals, umbrella
from rbfevo.recorded.record import read_fit
from rbfevo.scenarios import face, plane
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland


@pytest.fixture(scope="module")
def flat() -> Scenario:
    """A small plane whose vertices do not all count the same."""
    scenario = plane((16, 24))
    weights = 0.3 + torch.rand(len(scenario.vertices), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    norm = (weights[:, None] * scenario.gradient.square()).sum().sqrt()
    return dataclasses.replace(
        scenario, weights=weights, gradient=scenario.gradient / norm, gradient_norm=scenario.gradient_norm * float(norm)
    )


@pytest.fixture(scope="module")
def scan() -> Scenario:
    return face(subdivisions=2)


def setups(scenario: Scenario, count: int, m: int = 8, seed: int = 0) -> Tensor:
    return scenario.sample(count, m, torch.Generator().manual_seed(seed))


def generators(count: int, seed: int = 0) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed + b) for b in range(count)]


# --- the definitions, once more, in NumPy on all vertices -----------------------------------------------------------


def numpy_matrix(scenario: Scenario, kernel: Kernel, centers: Tensor, manipulation: str) -> np.ndarray:
    X, C = scenario.vertices.numpy(), centers.numpy()
    Phi = numpy_phi(kernel, cdist(X, C))
    if manipulation == "indirect":
        return Phi
    if manipulation == "direct":
        return np.linalg.solve(numpy_phi(kernel, cdist(C, C)), Phi.T).T
    root = np.sqrt(scenario.weights.numpy())[:, None]
    return np.linalg.qr(root * Phi)[0] / root


def numpy_laplacian(faces: np.ndarray, n: int) -> np.ndarray:
    neighbours: list[set[int]] = [set() for _ in range(n)]
    for corner in faces.tolist():
        for i in corner:
            neighbours[i] |= set(corner) - {i}
    L = np.eye(n)
    for i, around in enumerate(neighbours):
        for j in around:
            L[i, j] = -1 / len(around)
    return L


def numpy_error(scenario: Scenario, u: np.ndarray, smoothness: float = 0.0, paired: np.ndarray | None = None) -> float:
    """The error of a displacement [n, k]; with the closest points of `paired` instead of its own."""
    w = scenario.weights.numpy()[:, None]
    if scenario.closest is None or scenario.stays is None:
        return float((w * (u - scenario.gradient.numpy() * scenario.gradient_norm) ** 2).sum())
    X, stays = scenario.vertices.numpy(), scenario.stays.numpy()
    left = X + u - scenario.closest(X + (u if paired is None else paired))
    left[stays] = u[stays]
    L = numpy_laplacian(scenario.faces.numpy(), len(X))
    return float((w * left**2).sum() + smoothness * ((L @ u) ** 2).sum())


def test_umbrella_is_that_of_plain_loops(scan: Scenario) -> None:
    n = len(scan.vertices)
    found = umbrella(scan.faces.numpy(), n + 1).toarray()  # a last vertex without any edge
    np.testing.assert_allclose(found[:n, :n], numpy_laplacian(scan.faces.numpy(), n), atol=1e-15)
    assert not found[n].any()
    np.testing.assert_allclose(found.sum(axis=1), 0, atol=1e-15)


@pytest.mark.parametrize("manipulation", MANIPULATIONS)
@pytest.mark.parametrize(
    ("name", "kernel", "smoothness"),
    [("flat", Wendland(0.5), 0.0), ("flat", ThinPlate(), 0.0), ("scan", Wendland(1.0), 2.5), ("scan", Cubic(), 0.0)],
)
def test_errors_are_those_of_the_definition(
    name: str, kernel: Kernel, smoothness: float, manipulation: str, request: pytest.FixtureRequest
) -> None:
    scenario: Scenario = request.getfixturevalue(name)
    centers, k = setups(scenario, 2), scenario.gradient.shape[1]
    U = [numpy_matrix(scenario, kernel, c, manipulation) for c in centers]
    objective = Objective(scenario, (torch.from_numpy(u) for u in U), smoothness)
    random = torch.Generator().manual_seed(1)
    mean = torch.randn(2, 8, k, generator=random, dtype=torch.float64)
    mean = mean * (0.5 * objective.wanted / objective.size)[:, None, None]
    offspring = mean[:, None] * (1 + torch.randn(2, 5, 8, k, generator=random, dtype=torch.float64))
    pairs = objective.pairs(objective.T @ mean)
    found = objective.errors(offspring, pairs)
    for b in range(2):
        u = U[b] @ mean[b].numpy()
        assert float(pairs.error[b]) == pytest.approx(numpy_error(scenario, u, smoothness), rel=1e-10)
        for i in range(5):
            expected = numpy_error(scenario, U[b] @ offspring[b, i].numpy(), smoothness, paired=u)
            assert float(found[b, i]) == pytest.approx(expected, rel=1e-9)
        left = residuals(scenario, torch.from_numpy(u)).numpy() ** 2 * scenario.weights.numpy()[:, None]
        assert left.sum() == pytest.approx(numpy_error(scenario, u), rel=1e-10)


@pytest.mark.parametrize("kernel", [Wendland(0.5), ThinPlate()])
@pytest.mark.parametrize("manipulation", MANIPULATIONS)
def test_the_optimum_on_the_plane_is_that_of_least_squares(flat: Scenario, kernel: Kernel, manipulation: str) -> None:
    (c,) = setups(flat, 1)
    found = deformation(flat, kernel, c, manipulation)
    optimum = Objective(flat, [found.U]).optimum()
    root = flat.weights.sqrt().numpy()[:, None]
    t = flat.gradient.numpy() * flat.gradient_norm
    A = root * numpy_matrix(flat, kernel, c, manipulation)
    solution = np.linalg.lstsq(A, root * t, rcond=None)[0]
    expected = ((A @ solution - root * t) ** 2).sum()
    assert float(optimum.error[0]) == pytest.approx(expected, rel=1e-8)
    start = (root * t) ** 2
    assert float(optimum.error[0]) == pytest.approx(start.sum() * (1 - found.improvement_potential), rel=1e-8)


@pytest.mark.parametrize("smoothness", [0.0, 3.0])
def test_the_optimum_on_a_scan_is_where_closest_points_and_least_squares_end(scan: Scenario, smoothness: float) -> None:
    """Monotone, the same for all manipulations, and that of a plain alternation."""
    (c,) = setups(scan, 1, m=6)
    X, stays = scan.vertices.numpy(), scan.stays
    assert stays is not None
    assert scan.closest is not None
    L = numpy_laplacian(scan.faces.numpy(), len(X))
    A = numpy_matrix(scan, Wendland(1.0), c, "indirect")
    stacked = np.concatenate([A, np.sqrt(smoothness) * (L @ A)])
    u, errors = np.zeros_like(X), []
    for _ in range(400):
        errors.append(numpy_error(scan, u, smoothness))
        y = np.where(stays.numpy()[:, None], 0.0, scan.closest(X + u) - X)
        u = A @ np.linalg.lstsq(stacked, np.concatenate([y, np.zeros_like(y)]), rcond=None)[0]
        if len(errors) > 2 and errors[-2] - errors[-1] < 1e-8 * errors[-1]:
            break
    assert (np.diff(errors) <= 0).all()
    objective = Objective(scan, [torch.from_numpy(A)], smoothness)
    for manipulation in MANIPULATIONS:
        objective = Objective(scan, [deformation(scan, Wendland(1.0), c, manipulation).U], smoothness)
        optimum = objective.optimum()
        assert float(optimum.error[0]) == pytest.approx(errors[-1], rel=1e-6)
        assert int(optimum.iterations[0]) < 400
        assert float(objective.pairs(optimum.coordinates).error[0]) == pytest.approx(float(optimum.error[0]), rel=1e-12)
    assert objective.wanted**2 == pytest.approx(errors[0], rel=1e-12)
    assert int(objective.optimum(limit=3).iterations[0]) == 4


def test_smoothness_is_refused_where_it_means_nothing(flat: Scenario, scan: Scenario) -> None:
    with pytest.raises(UserError, match="fixed target"):
        Objective(flat, [], 1.0)
    with pytest.raises(UserError, match="at least 0"):
        Objective(scan, [], -1.0)


# --- manipulations ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "kernel"), [("flat", Wendland(0.5)), ("scan", Cubic())])
def test_manipulations_span_the_same_designs(name: str, kernel: Kernel, request: pytest.FixtureRequest) -> None:
    scenario: Scenario = request.getfixturevalue(name)
    (c,) = setups(scenario, 1)
    found = {manipulation: deformation(scenario, kernel, c, manipulation) for manipulation in MANIPULATIONS}
    root = scenario.weights.sqrt().numpy()[:, None]
    p = torch.randn(8, scenario.gradient.shape[1], generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for manipulation, one in found.items():
        assert one.U.numpy() == pytest.approx(numpy_matrix(scenario, kernel, c, manipulation), abs=1e-7)
        assert np.abs(subspace_angles(one.U.numpy(), found["indirect"].U.numpy())).max() < 1e-6
        sigma = np.linalg.svd(root * one.U.numpy(), compute_uv=False)
        assert one.regularity == pytest.approx(sigma[-1] / sigma[0], rel=1e-6)
        assert one.improvement_potential == found["indirect"].improvement_potential
        torch.testing.assert_close(found["indirect"].U @ one.weights(p), one.U @ p, rtol=0, atol=1e-6)
    assert found["orthogonalized"].regularity == pytest.approx(1.0, abs=1e-12)
    assert found["direct"].regularity > found["indirect"].regularity


def singular_setups(scenario: Scenario) -> Tensor:
    """A good one, one with a center twice, one that is not finite, one that no vertex feels; another good one."""
    centers = setups(scenario, 5, m=4)
    centers[1, 2] = centers[1, 0]
    centers[2, 1, 0] = torch.nan
    centers[3, 3] = 50.0
    return centers


@pytest.mark.parametrize("manipulation", MANIPULATIONS)
def test_setups_that_cannot_be_fitted_cost_the_others_nothing(flat: Scenario, manipulation: str) -> None:
    centers = singular_setups(flat)
    kernel = Wendland(0.5)
    found = fits(flat, kernel, centers, manipulation, generators=generators(5), generations=20)
    for b in (1, 2, 3):
        with pytest.raises(UserError) as error:
            deformation(flat, kernel, centers[b], manipulation)
        assert "\n" not in str(error.value)
        assert found[b].stop == f"not fitted: {error.value}"
        assert np.isnan([found[b].error, found[b].optimum, found[b].regularity]).all()
        assert not found[b].reached
        assert found[b].parameters.shape == (4, 1)
    (alone,) = fits(flat, kernel, centers[4:], manipulation, generators=generators(1, 4), generations=20)
    assert found[4].generations == alone.generations
    np.testing.assert_allclose(found[4].errors, alone.errors, rtol=1e-9)
    none = fits(flat, kernel, centers[1:2], manipulation, generators=generators(1))
    assert none[0].stop == found[1].stop


def test_a_singular_psi_is_refused_where_it_is_needed(flat: Scenario) -> None:
    centers = torch.tensor([[0.5, 0.5], [0.5, 1.5]], dtype=torch.float64)  # at distance 1, where r^2 log r vanishes
    assert deformation(flat, ThinPlate(), centers, "indirect").regularity > 0
    with pytest.raises(UserError, match="Psi is numerically singular"):
        deformation(flat, ThinPlate(), centers, "direct")
    with pytest.raises(UserError, match="choose one of indirect, direct, orthogonalized"):
        deformation(flat, ThinPlate(), centers, "both")


# --- fits ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", strategy.STRATEGIES)
@pytest.mark.parametrize("name", ["flat", "scan"])
def test_reached_is_within_5_percent_by_an_independent_computation(
    name: str, which: str, request: pytest.FixtureRequest
) -> None:
    scenario: Scenario = request.getfixturevalue(name)
    kernel, centers = Wendland(scenario.support), setups(scenario, 3, m=6)
    heard: list[tuple[int, int, float]] = []
    found = fits(
        scenario, kernel, centers, MANIPULATIONS, which, generators=generators(3), generations=400,
        report=lambda *line: heard.append(line),
    )  # fmt: skip
    assert all(fit.reached for fit in found)
    for b, fit in enumerate(found):
        U = numpy_matrix(scenario, kernel, centers[b], MANIPULATIONS[b])
        parameters = fit.parameters.numpy()
        if MANIPULATIONS[b] == "orthogonalized":  # the signs of Q are LAPACK's choice: those of the fit itself
            U = deformation(scenario, kernel, centers[b], MANIPULATIONS[b]).U.numpy()
        error = numpy_error(scenario, U @ parameters)
        assert error == pytest.approx(fit.error, rel=1e-9)
        assert error <= 1.05 * fit.optimum
        assert fit.errors[-1] == fit.error
        assert fit.errors[0] == fit.start_error == pytest.approx(numpy_error(scenario, 0 * U @ parameters), rel=1e-12)
        assert (fit.errors[:-1] > 1.05 * fit.optimum).all()
        assert len(fit.errors) == len(fit.steps) == fit.generations + 1
        assert fit.evaluations == 100 * fit.generations
    assert len(heard) == max(fit.generations for fit in found)
    assert [line[0] for line in heard] == list(range(1, len(heard) + 1))
    assert [line[1] for line in heard] == [sum(fit.generations >= line[0] for fit in found) for line in heard]
    assert heard[-1][2] <= 1.05


@pytest.mark.parametrize("which", strategy.STRATEGIES)
@pytest.mark.parametrize("name", ["flat", "scan"])
def test_a_batch_equals_a_loop_over_its_elements(name: str, which: str, request: pytest.FixtureRequest) -> None:
    scenario: Scenario = request.getfixturevalue(name)
    kernel, centers = Wendland(scenario.support), setups(scenario, 4, m=6)
    settings: dict[str, Any] = {"generations": 60, "parents": 5, "population": 20}
    batch = fits(scenario, kernel, centers, "direct", which, generators=generators(4), **settings)
    assert len({fit.generations for fit in batch}) > 1  # some go while others stay
    for b in range(4):
        (one,) = fits(scenario, kernel, centers[b : b + 1], "direct", which, generators=generators(1, b), **settings)
        assert one.generations == batch[b].generations
        assert one.stop == batch[b].stop
        np.testing.assert_allclose(one.errors, batch[b].errors, rtol=1e-7)
        torch.testing.assert_close(one.parameters, batch[b].parameters, rtol=1e-6, atol=1e-9)


class Scaled(Kernel):
    """Another kernel times a factor: the unit of its weights."""

    def __init__(self, kernel: Kernel, factor: float) -> None:
        super().__init__()
        self.inner, self.factor = kernel, factor

    def phi(self, r: Tensor) -> Tensor:
        return self.factor * self.inner(r)

    def slope(self, r: Tensor) -> Tensor:
        return self.factor * self.inner.slope(r)


@pytest.mark.parametrize("which", strategy.STRATEGIES)
@pytest.mark.parametrize("name", ["flat", "scan"])
def test_the_unit_of_the_parameters_does_not_matter(name: str, which: str, request: pytest.FixtureRequest) -> None:
    scenario: Scenario = request.getfixturevalue(name)
    kernel, centers = Wendland(scenario.support), setups(scenario, 2, m=6)
    plain, scaled = (
        fits(scenario, phi, centers, "indirect", which, generators=generators(2), generations=30)
        for phi in (kernel, Scaled(kernel, 1024.0))  # a power of two: the same digits
    )
    for a, b in zip(plain, scaled, strict=True):
        np.testing.assert_allclose(b.errors, a.errors, rtol=1e-9)
        np.testing.assert_allclose(1024 * b.steps, a.steps, rtol=1e-9)


def test_a_first_offspring_moves_the_design_by_three_tenths_of_what_is_wanted(scan: Scenario) -> None:
    kernel, centers = Wendland(1.0), setups(scan, 1)
    for manipulation in MANIPULATIONS:
        (fit,) = fits(scan, kernel, centers, manipulation, generators=generators(1), generations=0)
        assert (fit.stop, fit.generations, fit.evaluations) == ("generations", 0, 0)
        U = deformation(scan, kernel, centers[0], manipulation).U
        draws = fit.steps[0] * torch.randn(4000, 8, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        moved = (U @ draws).square().sum((1, 2)).mean().sqrt()
        assert float(moved) == pytest.approx(0.3 * scan.gradient_norm, rel=0.03)


def test_orthogonalized_parameters_do_not_feel_the_kernel(flat: Scenario) -> None:
    """The generations that lower what is above the optimum by a factor of 1e5, whatever R of the indirect setup is."""
    centers, needed, R = setups(flat, 1, m=12), [], []
    for kernel in (Wendland(0.25), Wendland(0.5), Wendland(4.0), ThinPlate()):
        R.append(deformation(flat, kernel, centers[0], "indirect").regularity)
        found = fits(
            flat,
            kernel,
            centers.repeat(5, 1, 1),
            "orthogonalized",
            generators=generators(5),
            generations=500,
            within=1e-9,
        )
        assert all(fit.reached for fit in found)
        above = [(fit.errors - fit.optimum) / (fit.start_error - fit.optimum) for fit in found]
        needed.append(np.median([(one < 1e-6).argmax() - (one < 1e-1).argmax() for one in above]))
    assert min(R) < 1e-2 * max(R)
    assert max(needed) <= 1.15 * min(needed)
    badly = fits(flat, ThinPlate(), centers, "indirect", generators=generators(1), generations=500, within=1e-9)
    assert not badly[0].reached


def test_the_same_seed_twice_and_another_one(flat: Scenario) -> None:
    centers = setups(flat, 1).repeat(2, 1, 1)
    first, other = fits(flat, Wendland(0.5), centers, generators=generators(2), generations=20)
    again, _ = fits(flat, Wendland(0.5), centers, generators=generators(2), generations=20)
    np.testing.assert_array_equal(first.errors, again.errors)
    assert not np.array_equal(first.errors, other.errors)


def test_a_fit_can_be_stopped_from_outside(scan: Scenario) -> None:
    count = iter(range(100))
    (fit,) = fits(
        scan, Wendland(1.0), setups(scan, 1), generators=generators(1), within=0.0, stop=lambda: next(count) >= 30
    )
    assert fit.stop == "stopped"
    assert not fit.reached
    assert np.isfinite(fit.error)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"manipulation": "both"}, "not fitted: manipulation=both"),
        ({"strategy": "newton"}, "choose one of isotropic, cmaes"),
        ({"generations": -1}, "at least 0"),
        ({"within": float("nan")}, "within=nan"),
        ({"smoothness": 1.0}, "fixed target"),
        ({"parents": 101}, "parents must be between"),
        ({"generators": []}, "one generator and one manipulation each, not 0 and 1"),
        ({"manipulation": ["direct", "direct"]}, "one generator and one manipulation each, not 1 and 2"),
        ({"centers": torch.zeros(1, 4, 3)}, r"must have shape \[B, m, 2\]"),
    ],
)
def test_bad_settings_are_one_line(flat: Scenario, changes: dict[str, Any], message: str) -> None:
    settings = {"centers": setups(flat, 1), "generators": generators(1)} | changes
    if "both" in changes.values():
        assert fits(flat, Wendland(0.5), **settings)[0].stop.startswith(message)
        return
    with pytest.raises(UserError, match=message) as error:
        fits(flat, Wendland(0.5), **settings)
    assert "\n" not in str(error.value)


# --- the command line ------------------------------------------------------------------------------------------------

ARGUMENTS = {
    "plane": ["scenario=plane", "scenario.resolution=[14,20]", "manipulation=direct"],
    "face": ["scenario=face", "scenario.subdivisions=2"],
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of each scenario, without pictures."""
    place = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rbfevo.figures.draw", lambda _: [])
        for name, arguments in ARGUMENTS.items():
            common = ["method=random", "method.population=6", "centers=6", "quiet=true", "evaluator=eager"]
            assert run_main([f"hydra.run.dir={place}/{name}", *arguments, *common]) == 0
    return place


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda _: [])


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("plane", "--pick knee"),
        ("plane", "--pick index:2 --manipulation orthogonalized --strategy cmaes --seed 3"),
        ("face", "--pick preference:0.3 --smoothness 0.5"),
        ("face", "--pick best-regularity --manipulation direct --generations 4 --parents 5 --population 12"),
    ],
)
def test_a_fit_from_end_to_end(
    name: str, arguments: str, runs: Path, tmp_path: Path, no_pictures: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(runs / name), *arguments.split(), "--out", str(tmp_path / "fit")]) == 0
    output = capsys.readouterr().out
    summary = json.loads((tmp_path / "fit" / "fit.json").read_text())
    with np.load(tmp_path / "fit" / "parameters.npz") as archive:
        arrays = dict(archive)
    with (tmp_path / "fit" / "history.csv").open() as file:
        history = list(csv.DictReader(file))
    origin = source.rebuild(runs / name, read_fit(tmp_path / "fit").run)
    with np.load(runs / name / "setups.npz") as setups_file:
        np.testing.assert_array_equal(arrays["centers"], setups_file["centers"][summary["row"]])
        if "index" in arguments:
            assert summary["row"] == 2
    manipulation = {"plane": "direct", "face": "indirect"}[name]
    manipulation = arguments.split("--manipulation ")[1].split()[0] if "--manipulation" in arguments else manipulation
    assert summary["manipulation"] == str(arrays["manipulation"]) == manipulation
    C = torch.from_numpy(arrays["centers"])
    U = deformation(origin.scenario, origin.kernel, C, manipulation).U.numpy()
    u = U @ arrays["parameters"]
    smoothness = summary["smoothness"]
    assert numpy_error(origin.scenario, u, smoothness) == pytest.approx(summary["error"], rel=1e-9)
    assert summary["error"] == float(history[-1]["error"])
    assert summary["generations"] == int(history[-1]["generation"]) == len(history) - 1
    assert summary["evaluations"] == summary["generations"] * summary["population"]
    assert summary["reached"] == (summary["error"] <= 1.05 * summary["optimum"])
    assert summary["stop_reason"] == ("reached" if summary["reached"] else "generations")
    assert f"{summary['generations']} generations" in output
    X = origin.scenario.vertices.numpy()
    expected = X + u if name == "face" else np.concatenate([X, u], axis=1)
    np.testing.assert_allclose(arrays["deformed"], expected, atol=1e-12)
    mesh: Any = trimesh.load(tmp_path / "fit" / "deformed.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, origin.scenario.faces.numpy())
    left = residuals(origin.scenario, torch.from_numpy(u)).norm(dim=1).numpy()
    np.testing.assert_allclose(arrays["local_error"], left, atol=1e-12)
    phi = numpy_phi(cast(Kernel, origin.kernel), cdist(arrays["centers"], arrays["centers"]))
    field = phi @ arrays["weights"]
    moved = arrays["centers"] + field if name == "face" else np.concatenate([arrays["centers"], field], axis=1)
    np.testing.assert_allclose(arrays["moved_centers"], moved, atol=1e-9)
    if manipulation == "direct":
        np.testing.assert_allclose(field, arrays["parameters"], atol=1e-8)
    assert not list((tmp_path / "fit").glob(".*"))


def test_the_default_place_and_nothing_is_overwritten(
    runs: Path, tmp_path: Path, no_pictures: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(runs / "plane", tmp_path / "run")
    arguments = [str(run), "--pick", "index:1", "--generations", "2", "--quiet"]
    assert main(arguments) == 0
    place = run / "fit-index-1-direct-isotropic-seed0"
    before = {path.name: path.read_bytes() for path in place.iterdir()}
    assert set(before) == {"fit.json", "history.csv", "parameters.npz", "deformed.ply"}
    assert capsys.readouterr().out == ""
    assert main(arguments) == 2
    assert "already holds results (fit.json): choose another --out" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in place.iterdir()} == before
    assert main([*arguments, "--out", str(run)]) == 2  # a run's own directory has a history.csv


MISTAKES = {
    "RUN": "--pick",
    "RUN --pick nee": "choose one of knee",
    "RUN --pick index:99": "choose one from 0 to 5",
    "RUN/nowhere --pick knee": "there is no such run directory",
    "RUN --pick knee --seed x": "invalid int value: 'x'",
    "RUN --pick knee --seed -1": "--seed -1",
    "RUN --pick knee --manipulation both": "choose one of indirect, direct, orthogonalized",
    "RUN --pick knee --strategy both": "choose one of isotropic, cmaes",
    "RUN --pick knee --generations -1": "at least 0",
    "RUN --pick knee --smoothness 1": "fixed target",
    "RUN --pick knee --within -1": "within=-1.0",
    "RUN --pick knee --parents 200": "parents must be between",
    "RUN --pick knee --bogus": "--bogus",
    "RUN --pick knee --out RUN/setups.npz": "cannot be created",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_is_one_clear_line_and_exit_code_2(
    arguments: str, runs: Path, tmp_path: Path, no_pictures: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [] if "--out" in arguments else ["--out", str(tmp_path / "fit")]
    assert main([*arguments.replace("RUN", str(runs / "plane")).split(), *out]) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1, err
    assert err.startswith("rbfevo.fit: ")
    assert MISTAKES[arguments] in err
    assert not (tmp_path / "fit").exists()


def test_a_run_that_cannot_be_rebuilt(
    runs: Path, tmp_path: Path, no_pictures: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(runs / "face", tmp_path / "run")
    arguments = [str(run), "--pick", "knee", "--quiet"]
    config = run / ".hydra" / "config.yaml"
    honest = config.read_text()
    for wrong, message in (
        (honest.replace("reject: boundary", "reject: none"), "(was a file of the scenario replaced?)"),
        (honest.replace("subdivisions: 2", "subdivisions: 1"), "vertices of the scenario changed since"),
        (honest.replace("subdivisions: 2", "subdivisions: 77"), "1 to 8"),
        (honest.replace("support: 1.0", "support: 0.4"), "support is 1.0 in summary.json and 0.4 in"),
        (honest.replace("rbfevo.scoring.kernels.wendland", "os.system"), "there is no such key; choose one of"),
        ("", "is not the configuration of a run"),
        ("- 3\n", "holds no configuration"),
        ("{", "cannot be read"),
    ):
        config.write_text(wrong)
        assert main(arguments) == 2
        err = capsys.readouterr().err
        assert message in err
        assert len(err.splitlines()) == 1
    config.unlink()
    assert main(arguments) == 2
    assert "it is needed to build the scenario of this run again" in capsys.readouterr().err


def test_a_singular_setup_is_one_line(
    runs: Path, tmp_path: Path, no_pictures: None, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(runs / "plane", tmp_path / "run")
    with np.load(run / "setups.npz") as archive:
        arrays = dict(archive)
    arrays["centers"][0, 1] = arrays["centers"][0, 0]
    np.savez(run / "setups.npz", **arrays)
    assert main([str(run), "--pick", "index:0", "--quiet"]) == 2
    assert "rank-deficient" in capsys.readouterr().err
    assert not list(run.glob("fit*"))


def test_a_relative_scan_is_found_from_where_the_run_was_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_pictures: None
) -> None:
    (tmp_path / "scans").mkdir()
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    ball.vertices *= [0.8, 1.0, 0.6]
    ball.export(tmp_path / "scans" / "ball.ply")
    monkeypatch.chdir(tmp_path)
    arguments = [
        "scenario=face",
        "scenario.scan=scans/ball.ply",
        "scenario.subdivisions=2",
        "method=lloyd",
        "centers=5",
    ]
    assert run_main([f"hydra.run.dir={tmp_path}/run", *arguments, "quiet=true", "evaluator=eager"]) == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["../run", "--pick", "knee", "--generations", "2", "--quiet"]) == 0
    assert len(list((tmp_path / "run").glob("fit-*/fit.json"))) == 1


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_fit_keeps_what_it_has(
    number: signal.Signals, code: int, runs: Path, tmp_path: Path, no_pictures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: Progress, generation: int, *__: object) -> None:
        if generation == 3:
            signal.raise_signal(number)

    monkeypatch.setattr(Progress, "__call__", interrupt)
    assert main([str(runs / "face"), "--pick", "knee", "--within", "0", "--out", str(tmp_path)]) == code
    summary = json.loads((tmp_path / "fit.json").read_text())
    assert summary["stop_reason"] == f"interrupted by {number.name}"
    assert summary["generations"] == 3
    assert len((tmp_path / "history.csv").read_text().splitlines()) == 5
    assert signal.getsignal(number) is not None


# --- fit.png ---------------------------------------------------------------------------------------------------------


@pytest.mark.figures
@pytest.mark.parametrize("name", ["plane", "face"])
def test_a_fit_is_drawn_and_can_be_redrawn(
    name: str, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("rbfevo.figures.draw", lambda _: [])
        arguments = [
            str(runs / name),
            "--pick",
            "knee",
            "--within",
            "0",
            "--generations",
            "30",
            "--out",
            str(tmp_path / "fit"),
            "--quiet",
        ]
        assert main(arguments) == 0
    picture = fit_figure.picture(read_fit(tmp_path / "fit"), opengl=False)
    *panels, bar, curve = picture.axes
    assert [axes.get_title() for axes in panels][2:] == ["fit", "local error and centers"]
    assert bar.get_ylabel().startswith("local error")
    assert len(np.asarray(curve.lines[0].get_xdata())) == 31
    if name == "plane":  # once by a process of its own that has no OpenGL
        (tmp_path / "broken").mkdir()
        (tmp_path / "broken" / "pyvista.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path / "broken"))
        assert figures.draw(tmp_path / "fit") == ["fit.png was drawn without OpenGL: the process was ended by SIGSEGV"]
    else:
        assert figures_main.main([str(tmp_path / "fit"), "--only", "fit", "--no-opengl"]) == 0
    assert imread(tmp_path / "fit" / "fit.png")[..., :3].std() > 0.02
    (tmp_path / "fit" / "parameters.npz").unlink()
    assert figures_main.main([str(tmp_path / "fit"), "--only", "fit"]) == 2
    assert "parameters.npz is missing" in capsys.readouterr().err
