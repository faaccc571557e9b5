"""What the search stages of a run do with a problem: how they start, what they keep, and what they return."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from test_gradient import gradient, settings
from torch import Tensor

from rbfevo.methods.candidates import grid_candidates
from rbfevo.methods.cmaes.search import CmaesSearch
from rbfevo.methods.gradient.lbfgs import LBFGS
from rbfevo.methods.gradient.rise import rise
from rbfevo.methods.gradient.search import GradientSearch
from rbfevo.methods.gradient.teams import FrontTeam, WishTeam
from rbfevo.methods.gradient.tracing import soft_regularity
from rbfevo.methods.lloyd import LloydHeuristic, lloyd
from rbfevo.methods.method import Method, Problem, Rows
from rbfevo.methods.nsga2 import Nsga2Search
from rbfevo.methods.ols import OlsHeuristic, ols
from rbfevo.runs.run import Run
from rbfevo.scoring.evolvability import Scores
from rbfevo.scoring.fronts import preferred
from rbfevo.scoring.pareto import nondominated
from rbfevo.scoring.representations import RBF

NSGA2 = {"_target_": "rbfevo.methods.Nsga2Search", "population": 12, "generations": 3}
CMAES = {"_target_": "rbfevo.methods.CmaesSearch", "population": 12, "parents": 4, "generations": 12}


def problem_of(method: dict[str, Any], **changes: Any) -> tuple[Method, Problem]:
    """A stage that has not been started, and the problem that it is to have."""
    run = Run(settings(method, **{"evaluator": "eager", **changes}))
    (stage,) = run.stages
    return stage, run.problem()


# ------------------------------------------------------------------ NSGA-II and CMA-ES


def test_nsga2_starts_with_the_initial_population_and_its_scores() -> None:
    stage, problem = problem_of(NSGA2)
    assert isinstance(stage, Nsga2Search)
    stage.start(problem)
    for _ in range(3):
        found = problem.evaluate(problem.unflatten(stage.algorithm.population)).objectives
        torch.testing.assert_close(stage.algorithm.objectives, found, rtol=1e-12, atol=1e-14)
        if stage.algorithm.generation == 0:
            assert torch.equal(problem.unflatten(stage.algorithm.population), problem.initial.centers)
        stage.step()


def test_cmaes_starts_at_what_each_preference_likes_best_with_a_stream_of_its_own() -> None:
    wishes = (0.0, 0.5, 1.0)
    stage, problem = problem_of(CMAES, preference=list(wishes))
    assert isinstance(stage, CmaesSearch)
    stage.start(problem)
    R, P = problem.initial.scores.objectives.T.numpy()
    together = stage._algorithm.ask()
    for i, wish in enumerate(wishes):
        best = int(np.argmax(wish * R + (1 - wish) * P))
        torch.testing.assert_close(stage._algorithm.mean[i], problem.initial.centers[best].flatten())
        torch.testing.assert_close(stage._objectives[i], problem.initial.scores.objectives[best])
        alone, its = problem_of(CMAES, preference=wish)
        alone.start(its)
        assert isinstance(alone, CmaesSearch)
        assert torch.equal(alone._algorithm.ask()[0], together[i])
    first, second, third = (state.tolist() for state in stage.state_dict()["algorithm"]["generators"])
    assert first != second != third != first


def test_cmaes_returns_the_best_that_it_has_met() -> None:
    stage, problem = problem_of(CMAES | {"sigma": 0.5}, preference=[0.2, 0.9])  # steps so wide that they get worse
    seen: list[Tensor] = [problem.initial.scores.objectives.expand(2, -1, -1)]

    def watched(centers: Tensor) -> Scores:
        scores = problem.evaluate(centers)
        seen.append(scores.objectives)
        return scores

    stage.start(dataclasses.replace(problem, evaluate=watched))
    for _ in range(stage.steps):
        stage.step()
    (rows,) = stage.rows()
    torch.testing.assert_close(
        rows.scores.objectives, problem.evaluate(rows.centers).objectives, rtol=1e-12, atol=1e-14
    )
    everything = torch.cat(seen, dim=1)
    for i, wish in enumerate((0.2, 0.9)):
        values = wish * everything[i, :, 0] + (1 - wish) * everything[i, :, 1]
        assert float(preferred(torch.tensor(wish), rows.scores.objectives[i])) == pytest.approx(float(values.max()))
        assert values[-12:].max() < values.max()  # the last generation has nothing as good
    best, steps = stage.state_dict(), stage.progress()
    assert [float(points[0, 0]) for _, points in steps] == best["objectives"][:, 0].tolist()


# ------------------------------------------------------------------ records


class Fixed(Method):
    """Finds what it is given."""

    name = "fixed"

    def __init__(self, *found: tuple[float, list[list[float]]]) -> None:
        self.found = [(preference, torch.tensor(points, dtype=torch.float64)) for preference, points in found]

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        return 0

    def start(self, problem: Problem) -> None: ...

    def step(self) -> None: ...

    def rows(self) -> list[Rows]:
        return []

    def progress(self) -> list[tuple[float, Tensor]]:
        return self.found

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


def test_a_line_of_the_history_has_the_hypervolume_of_all_and_the_best_of_each() -> None:
    method = Fixed((0.2, [[0.2, 0.9], [0.1, 0.95]]), (0.8, [[0.5, 0.5], [0.8, 0.2], [0.3, 0.3]]))
    lines = method.records(7, 123, 4.5, 6)
    volume = 0.8 * 0.2 + 0.5 * (0.5 - 0.2) + 0.2 * (0.9 - 0.5) + 0.1 * (0.95 - 0.9)
    assert [line.hypervolume for line in lines] == pytest.approx([volume, volume])
    assert [(line.preference, line.best_regularity, line.best_improvement_potential) for line in lines] == [
        (0.2, 0.2, 0.95),
        (0.8, 0.8, 0.5),
    ]
    assert {
        (line.method, line.generation, line.evaluations, line.seconds, line.failed_evaluations) for line in lines
    } == {("fixed", 7, 123, 4.5, 6)}


# ------------------------------------------------------------------ heuristics on a graded and symmetric mesh


@pytest.fixture(scope="module")
def egg(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The settings of a symmetric egg whose vertices lie much closer on one side, and whose box is no cube."""
    directory = tmp_path_factory.mktemp("egg")
    ball: Any = trimesh.creation.icosphere(subdivisions=3)
    x = np.asarray(ball.vertices).copy()
    x[np.abs(x[:, 1]) < 1e-12, 1] = 0.0
    x[:, 0] = np.sign(x[:, 0]) * np.abs(x[:, 0]) ** 3  # graded
    x *= [3.0, 1.0, 0.7]
    trimesh.Trimesh(x, ball.faces, process=False).export(directory / "egg.ply")
    np.save(directory / "s.npy", np.stack([np.exp(-((x[:, 0] + 1.5) ** 2)), x[:, 1], x[:, 2] ** 2 + 0.1], axis=1))
    return {
        "_target_": "rbfevo.scenarios.mesh",
        "template": str(directory / "egg.ply"),
        "sensitivity": str(directory / "s.npy"),
        "sensitivity_kind": "nodal",
        "weights": "area",
        "symmetry": "y",
        "symmetry_at": 0.0,
    }


def halved(problem: Problem) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices, g and weights of the half at y >= 0, by hand."""
    whole = problem.scenario
    kept = whole.vertices[:, 1] >= -1e-9
    assert 0.5 < float(kept.double().mean()) < 0.6
    return whole.vertices[kept], whole.gradient[kept], whole.weights[kept]


def test_lloyd_sees_one_half_and_its_areas(egg: dict[str, Any]) -> None:
    _, problem = problem_of({"_target_": "rbfevo.methods.LloydHeuristic"}, scenario=egg)
    vertices, _, weights = halved(problem)
    assert float(weights.max() / weights.min()) > 10
    (found,) = LloydHeuristic(starts=3).place(problem)
    stream = problem.stream("lloyd")
    wanted = problem.scenario.parameterization.settle(lloyd(vertices, 6, generator=stream, weights=weights, starts=3))
    torch.testing.assert_close(found, wanted)
    unlike = lloyd(vertices, 6, generator=problem.stream("lloyd"), starts=3)
    assert not torch.allclose(problem.scenario.parameterization.settle(unlike), found, atol=1e-3)


def test_ols_sees_one_half_and_its_areas(egg: dict[str, Any]) -> None:
    _, problem = problem_of({"_target_": "rbfevo.methods.OlsHeuristic"}, scenario=egg)
    vertices, g, weights = halved(problem)
    (found,) = OlsHeuristic(per_axis=8).place(problem)
    assert isinstance(problem.representation, RBF)
    kernel = problem.representation.kernel
    candidates = grid_candidates(*problem.scenario.search_box, 8)

    def columns(centers: Tensor) -> Tensor:
        return kernel(torch.cdist(vertices, centers, compute_mode="donot_use_mm_for_euclid_dist"))

    wanted = ols(columns, candidates, g, 6, weights=weights).centers
    torch.testing.assert_close(found, problem.scenario.parameterization.settle(wanted))
    unlike = ols(columns, candidates, g, 6).centers
    assert not torch.allclose(problem.scenario.parameterization.settle(unlike), found)


# ------------------------------------------------------------------ teams


def test_the_two_teams_of_a_front_take_up_its_ends() -> None:
    like = torch.zeros(1, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    team = FrontTeam(starts=40, size=16, front=10, like=like)
    points = torch.rand(40, 6, generator=generator, dtype=torch.float64)
    angle = torch.linspace(0.05, 0.45 * math.pi, 40, dtype=torch.float64)
    objectives = torch.stack((angle.sin(), angle.cos()), 1)[torch.randperm(40, generator=generator)]
    climb = LBFGS(points, memory=3)
    climb.values = objectives.sum(1)
    team.move(climb, points, objectives, torch.ones(40, dtype=torch.bool))
    climb = team.redeploy(climb, last=False)
    best_R, best_P = points[objectives[:, 0].argmax()], points[objectives[:, 1].argmax()]
    assert len(climb.points) == 16
    assert torch.equal(climb.points[0], best_R)  # the best of each team goes on, and its last comes over to the end
    assert torch.equal(climb.points[2], best_R)
    assert torch.equal(climb.points[3], best_P)
    assert torch.equal(climb.points[5], best_P)
    log_R, P = torch.full((16,), -1.0, dtype=torch.float64), torch.full((16,), 0.5, dtype=torch.float64)
    _, in_R, in_P = team.aim(log_R, P)
    assert bool((in_P[:3] == 0).all())  # the first team climbs in R alone, the second in P alone
    assert bool((in_R[3:6] == 0).all())
    assert bool((in_R[:3] > 0).all())
    assert bool((in_P[3:6] > 0).all())
    last = team.redeploy(climb, last=True)
    assert torch.equal(last.points[0], best_P)  # along the front, from the least R on
    assert torch.equal(last.points[-1], best_R)


def test_who_starts_on_the_front_has_the_memory_of_who_was_there() -> None:
    like, generator = torch.zeros(1, dtype=torch.float64), torch.Generator().manual_seed(3)
    team = FrontTeam(starts=40, size=16, front=10, like=like)
    climb = LBFGS(torch.rand(40, 4, generator=generator, dtype=torch.float64), memory=3)
    tried = []
    for _ in range(4):  # each element goes its own way along its own arc
        points = climb.ask().clone()
        radius = 0.5 + 0.1 * points.sum(1)
        objectives = radius[:, None] * torch.stack((points[:, 0] + 0.1, 1.1 - points[:, 0]), 1) / 2.0
        climb.tell(objectives.sum(1), torch.ones_like(points) - points)
        team.move(climb, points, objectives, climb.accepted)
        tried.append(points)
    before = climb
    climb = team.redeploy(climb, last=False)
    for place in range(6, 16):
        met = {int(k) for points in tried for k in (points == climb.points[place]).all(1).nonzero().flatten()}
        assert any(
            torch.equal(climb._steps[:, place], before._steps[:, k])
            and torch.equal(climb._rho[:, place], before._rho[:, k])
            for k in met
        )
    memories = {tuple(memory.flatten().tolist()) for memory in climb._steps[:, 6:].unbind(1)}
    assert len(memories) > 3
    assert (climb._rho[:, [2, 5]] == 0).all()  # what came over to an end has none
    assert bool((before._rho != 0).any())
    archive = team._archive
    assert archive is not None
    for row in (archive.points[:, None] == climb.points[6:]).all(2).nonzero().tolist():
        assert bool((climb.points[archive.elements[row[0]]] == archive.points[row[0]]).all())
    assert bool((archive.elements >= 6).all())


def test_another_design_changes_what_was_found_there() -> None:
    like, generator = torch.zeros(1, dtype=torch.float64), torch.Generator().manual_seed(3)
    points, objectives = (torch.rand(40, k, generator=generator, dtype=torch.float64) for k in (4, 2))

    def score(points: Tensor) -> Tensor:
        return torch.stack((points[:, 0], points[:, 1]), 1)

    front = FrontTeam(starts=40, size=16, front=10, like=like)
    wishes = WishTeam(8, torch.tensor([0.2, 0.8], dtype=torch.float64), generator)
    for team, count in ((front, 40), (wishes, 8)):
        climb = LBFGS(points[:count])
        team.move(climb, points[:count], objectives[:count], torch.ones(count, dtype=torch.bool))
        found = team.found()[0]
        team.rescore(score)
        assert torch.equal(team.standing, score(points[:count]))
        again = team.found()
        assert torch.equal(again[1], score(again[0]))
        assert all((found == point).all(1).any() for point in again[0])
    assert bool(nondominated(front.found()[1]).all())
    (_, _, preference), value = wishes.found(), wishes._value
    assert torch.equal(value, preferred(preference, wishes.found()[1]))


def test_what_a_preference_has_found_outlives_a_resume() -> None:
    wishes = torch.tensor([0.1, 0.9], dtype=torch.float64)

    def made() -> tuple[WishTeam, LBFGS]:
        team = WishTeam(8, wishes, torch.Generator().manual_seed(0))
        return team, LBFGS(torch.full((team.size, 4), 0.5, dtype=torch.float64))

    team, climb = made()
    good = torch.rand(team.size, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    scores = torch.rand(team.size, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    team.take(good, scores)
    other, climb = made()
    other.load_state_dict(team.state_dict(), climb)
    for each in (team, other):
        each.take(1.0 - good, 0.5 * scores)  # worse for every preference
    for mine, its in zip(team.found(), other.found(), strict=True):
        assert torch.equal(mine, its)
    points, objectives, _ = other.found()
    best = preferred(wishes[:, None], scores).argmax(1)
    assert torch.equal(points, good[best])
    assert torch.equal(objectives, scores[best])
    other.take(good, scores + 1.0)  # better is still taken
    assert torch.equal(other.found()[1], scores[best] + 1.0)


# ------------------------------------------------------------------ gradients

PLACES = ["a box that is no cube", "symmetry", "symmetry and a region without centers"]


@pytest.mark.parametrize("preference", [None, 0.4])
@pytest.mark.parametrize("place", PLACES)
def test_a_climb_is_given_the_gradients_of_its_values(
    place: str, preference: float | None, egg: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = egg if place != PLACES[0] else egg | {"symmetry": None, "symmetry_at": None}
    if place == PLACES[2]:
        scenario = scenario | {"fixed": [-9.0, -9.0, -9.0, -0.7, 9.0, 9.0], "keep_out": True}
    stage, problem = problem_of(gradient(), scenario=scenario, preference=preference, centers=5)
    assert isinstance(stage, GradientSearch)
    stage.start(problem)
    side = problem.space.upper - problem.space.lower
    assert float(side.max() / side.min()) > 1.5
    shape, generator = stage._climb.points.shape, torch.Generator().manual_seed(4)
    stage._climb._trial = torch.rand(*shape, generator=generator, dtype=torch.float64)  # on both sides, in the region
    calls: list[tuple[Tensor, Tensor]] = []
    monkeypatch.setattr(stage._climb, "tell", lambda values, slopes: calls.append((values, slopes)))
    monkeypatch.setattr(stage._climb, "revalue", lambda: None)
    stage.step()
    ((values, slopes),) = calls

    def value(points: Tensor) -> Tensor:
        coarse = stage._problem
        spectrum = coarse.spectrum(coarse.space.place(stage._placed(points)))
        assert stage._exponents is not None
        return stage._team.aim(soft_regularity(spectrum, stage._exponents)[0], spectrum.potential)[0]

    points, h = stage._climb._trial, 1e-6
    torch.testing.assert_close(value(points), values, rtol=1e-9, atol=1e-12)
    way = torch.randn(*shape, generator=generator, dtype=torch.float64)
    ahead, behind = value(points + h * way), value(points - h * way)
    expected, found = (ahead - behind) / (2 * h), (slopes * way).sum(1)
    right = (found - expected).abs() <= 1e-3 * expected.abs() + 1e-4
    # Elsewhere a center sits within h of a kink: the plane, the region's edge, or the kernel's reach.
    assert int(right.sum()) >= 0.8 * len(right)
    assert float(expected.abs().median()) > 1e-2


def test_only_points_that_are_accepted_get_gradients(egg: dict[str, Any]) -> None:
    stage, problem = problem_of(gradient(), scenario=egg, centers=5)
    assert isinstance(stage, GradientSearch)
    stage.start(problem)
    points = stage._placed(stage._climb.ask())
    given = problem, points, stage._team.aim, 16.0, None, None
    every = rise(*given, lambda values: torch.ones_like(values, dtype=torch.bool))
    some = rise(*given, lambda values: values > values.median())
    wanted = every.values > every.values.median()
    torch.testing.assert_close(some.gradients[wanted], every.gradients[wanted], rtol=1e-12, atol=0.0)
    assert (some.gradients[~wanted] == 0).all()
    assert torch.equal(some.values, every.values)
    assert (every.gradients.flatten(1) != 0).any(1).sum() > wanted.sum() > 3
