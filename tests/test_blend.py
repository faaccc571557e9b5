"""`method=blend`: its parts beside SciPy and plain NumPy, what it gives for each preference, and whole runs."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from designs import plane, sphere
from scipy.linalg import qr
from test_contracts import settings
from test_mesh_runs import egg

from rbfevo.__main__ import main
from rbfevo.methods.blend import BlendHeuristic, Starts, between, spread
from rbfevo.methods.candidates import grid_candidates
from rbfevo.methods.lloyd import towards_centroids
from rbfevo.methods.method import Problem
from rbfevo.methods.ols import ols
from rbfevo.methods.penalized import penalized
from rbfevo.recorded.record import read
from rbfevo.runs import run
from rbfevo.scoring.distances import distances
from rbfevo.scoring.kernels import Wendland

WISHES = torch.linspace(0.0, 1.0, 11, dtype=torch.float64)


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def columns_of(vertices: torch.Tensor, candidates: torch.Tensor) -> torch.Tensor:
    return Wendland(0.5)(distances(vertices, candidates))


@pytest.fixture(scope="module")
def picks() -> tuple[Any, torch.Tensor, torch.Tensor]:
    """A weighted design, candidates on a grid, and their columns times the roots of the weights."""
    design = plane(20, 30, weighted=True)
    candidates = grid_candidates(design.vertices.amin(0), design.vertices.amax(0) * 1.03, 9)
    return design, candidates, design.weights.sqrt()[:, None] * columns_of(design.vertices, candidates)


# --- parts -----------------------------------------------------------------------------------------------------------


def test_without_a_penalty_the_picks_are_those_of_ols(picks):
    design, candidates, columns = picks
    g = design.weights.sqrt()[:, None] * design.gradient
    expected = ols(lambda c: columns_of(design.vertices, c), candidates, design.gradient, 12, weights=design.weights)
    found = penalized(columns, g, 12, torch.tensor([0.0, 0.5], dtype=torch.float64))
    assert found[0].tolist() == expected.indices.tolist()
    assert found[1].tolist() != expected.indices.tolist()


def test_with_nothing_else_they_are_the_pivots_of_a_qr_factorization(picks):
    design, _, columns = picks
    found = penalized(columns, design.gradient, 12, torch.ones(1, dtype=torch.float64))
    factors: Any = qr(columns.numpy(), pivoting=True, mode="economic")
    pivots = factors[2]
    assert found[0].tolist() == pivots[:12].tolist()


def test_between_they_are_the_largest_of_the_product(picks):
    design, _, columns = picks
    share, Phi = 0.3, columns.numpy()
    g = (design.weights.sqrt()[:, None] * design.gradient).numpy()
    chosen: list[int] = []
    for _ in range(6):
        Q = np.linalg.qr(Phi[:, chosen])[0] if chosen else np.zeros((len(Phi), 0))
        w, r = Phi - Q @ (Q.T @ Phi), g - Q @ (Q.T @ g)
        left = (w**2).sum(0)
        with np.errstate(divide="ignore", invalid="ignore"):
            merit = ((w.T @ r) ** 2).sum(1) ** (1 - share) / left ** (1 - share) * left**share
        merit[left < 1e-10 * (Phi**2).sum(0)] = -1
        chosen.append(int(merit.argmax()))
    assert penalized(columns, torch.from_numpy(g), 6, torch.tensor([share], dtype=torch.float64))[0].tolist() == chosen


def test_columns_that_are_there_already_count(picks):
    design, _, columns = picks
    g = design.weights.sqrt()[:, None] * design.gradient
    for share in (0.0, 0.6):
        wish = torch.tensor([share], dtype=torch.float64)
        whole = penalized(columns, g, 9, wish)[0]
        later = penalized(columns, g, 5, wish, columns[:, whole[:4]])[0]
        assert later.tolist() == whole[4:].tolist()


def test_centers_go_a_share_of_their_way_to_the_middles_of_their_cells():
    design, away = sphere(2, weighted=True), torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64)
    vertices = design.vertices + away
    centers = design.centers(2, 5) + away
    kept = design.centers(2, seed=9) + away
    found = towards_centroids(vertices, design.weights, centers, torch.tensor([0.25, 1.0]).double(), kept)
    for own, share, moved in zip(centers.numpy(), (0.25, 1.0), found.numpy(), strict=True):
        every = np.vstack([own, kept.numpy()])
        nearest = np.linalg.norm(vertices.numpy()[:, None] - every, axis=2).argmin(1)
        for j in range(5):
            cell = nearest == j
            middle = np.average(vertices.numpy()[cell], axis=0, weights=design.weights.numpy()[cell])
            np.testing.assert_allclose(moved[j], own[j] + share * (middle - own[j]), atol=1e-12)


def problem_of(**changes: Any) -> Problem:
    return run.Run(settings("blend", **{"centers": 5, **changes})).problem()


def test_setups_between_two_take_the_shortest_way():
    problem = problem_of()
    two = torch.stack([problem.space.sample(1, torch.Generator().manual_seed(seed))[0] for seed in (1, 2)])
    found = between(problem, two, WISHES)
    orders = list(itertools.permutations(range(5)))
    here, there = two.numpy()
    costs = [float(((here - there[list(order)]) ** 2).sum()) for order in orders]
    partner = there[list(orders[int(np.argmin(costs))])]
    for share, setup in zip(WISHES.tolist(), found.numpy(), strict=True):
        np.testing.assert_allclose(setup, (1 - share) * here + share * partner, atol=1e-12)


def test_picks_are_made_beside_centers_that_stay(tmp_path):
    alone = spread(problem_of(), WISHES)[0]  # without a penalty
    (tmp_path / "kept.csv").write_text("x,y\n" + ",".join(map(repr, alone[0].tolist())) + "\n")
    problem = problem_of(keep=str(tmp_path / "kept.csv"))
    found = spread(problem, WISHES)[0]
    torch.testing.assert_close(found[0], alone[0], rtol=0.0, atol=0.0)
    assert float((found[1:] - alone[0]).norm(dim=1).min()) > 1e-3  # it is not picked once more


def test_preferences_weigh_the_ranges_of_both_alike():
    problem = problem_of()
    method = BlendHeuristic(climbs=1, per_axis=8)
    starts = Starts.of(problem, problem, method.heuristics(problem), WISHES)
    lloyds = problem.evaluate(method.heuristics(problem)[1:]).objectives[0]
    regular = max(float(starts.objectives[:, 0].max()), float(lloyds[0]))
    gained = float(starts.objectives[:, 1].max() - lloyds[1])
    assert len(starts.setups) == 4 * len(WISHES)
    for wish, weight, best in zip(WISHES.tolist(), starts.weight.tolist(), starts.best(), strict=True):
        values = wish * starts.objectives[:, 0] / regular + (1 - wish) * starts.objectives[:, 1] / gained
        torch.testing.assert_close(best, starts.setups[int(values.argmax())])
        of_regularity, of_potential = wish / regular, (1 - wish) / gained
        assert weight == pytest.approx(of_regularity / (of_regularity + of_potential), rel=1e-12)


# --- what it gives ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_its_ends_are_at_least_ols_and_lloyd_and_more_climbs_lose_nothing(manipulation):
    found = {}
    for climbs in (1, 25):
        problem = problem_of(manipulation=manipulation, centers=8)
        method = BlendHeuristic(climbs=climbs, per_axis=12)
        heuristics = problem.evaluate(method.heuristics(problem))
        method.start(problem)
        method.step()
        (rows,) = method.rows()
        assert rows.preference.tolist() == pytest.approx(WISHES.tolist())
        scores = rows.scores
        assert float(scores.improvement_potential[0]) >= float(heuristics.improvement_potential[0]) - 1e-12
        assert float(scores.regularity[-1]) >= float(heuristics.regularity[1]) - 1e-12
        found[climbs] = scores
        assert [preference for preference, _ in method.progress()] == pytest.approx(WISHES.tolist())
    weight = Starts.of(problem, problem, method.heuristics(problem), WISHES).weight
    values = {n: weight * s.regularity + (1 - weight) * s.improvement_potential for n, s in found.items()}
    assert bool((values[25] >= values[1] - 1e-9).all())
    assert float((values[25] - values[1]).mean()) > 0.01


def test_it_gives_one_setup_for_each_preference_that_is_asked_for(tmp_path):
    assert run.carry_out(settings("blend", preferences=(0.2, 0.7)), tmp_path) == 0
    record = read(tmp_path)
    own = record.method == "blend"
    assert record.preference[own].tolist() == [0.2, 0.7]
    assert (tmp_path / "history.csv").read_text().count("\nblend,") == 2


# --- whole runs ------------------------------------------------------------------------------------------------------

CASES = {
    "symmetric": ["scenario.symmetry=y", "scenario.symmetry_at=0", "centers=5"],
    "held": ["scenario.hold=[-2,-2,-2,2,2,-0.5]"],
    "bounded": ["criterion.norm=16"],
    "polynomial": ["representation.polynomial=linear"],
    "packed": ["scenario.outside=[-0.5,-2,-2,0.5,2,2]"],
    "coarse": ["scenario.search_vertices=100"],
}


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"), subdivisions=2)


@pytest.mark.parametrize("name", CASES)
def test_runs_on_a_mesh(name, template, tmp_path):
    words = ["scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    words += ["method=blend", "method.climbs=6", "method.per_axis=8", "kernel.support=0.8", "centers=6", "quiet=true"]
    assert main([*words, *CASES[name], f"hydra.run.dir={tmp_path}"]) == 0
    record = read(tmp_path)
    assert len(record.usable) == 11
    np.testing.assert_allclose(record.preference, WISHES.numpy())
    assert record.regularity[-1] > 2 * record.regularity[0]
    assert record.potential[0] > record.potential[-1] + 0.005
    if name == "packed":
        assert not (np.abs(record.centers[..., 0]) < 0.5).any()
    if name == "symmetric":
        assert ((record.centers[..., 1] == 0).sum(1) == 1).all()


def test_the_panel_has_it_last(tmp_path):
    words = ["scenario=plane", "scenario.resolution=[12,12]", "centers=4", "method.nsga2.generations=2", "quiet=true"]
    words += ["method.cmaes.generations=2", "method.blend.climbs=3", "method.ols.per_axis=8"]
    assert main([*words, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    record = read(tmp_path / "run")
    assert record.method.tolist()[-11:] == ["blend"] * 11
    assert main([*words[:-2], "~method.blend", f"hydra.run.dir={tmp_path / 'plain'}"]) == 0
    plain = read(tmp_path / "plain")
    np.testing.assert_array_equal(record.centers[: len(plain.centers) - 1], plain.centers[:-1])  # OLS is another


def test_bad_settings_are_one_line(capsys, tmp_path):
    words = ["scenario=plane", "method=blend", f"hydra.run.dir={tmp_path}"]
    assert main([*words, "method.climbs=0"]) == 2
    assert "blend: climbs=0" in capsys.readouterr().err
