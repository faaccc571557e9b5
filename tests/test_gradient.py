"""The front by gradients: better than what it starts from and than NSGA-II, in the box, and the same every time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.gradient.search import GradientSearch
from rbfevo.methods.method import Method, Rows
from rbfevo.runs.config import Settings, check
from rbfevo.runs.run import Run
from rbfevo.scoring.fronts import preferred
from rbfevo.scoring.pareto import hypervolume, nondominated

SMALL = {"starts": 40, "population": 24, "generations": 60, "polish": 6, "front": 20, "coarse": 300, "rough": 150}


def settings(method: dict, **changes) -> Settings:
    config = {
        "scenario": {"_target_": "rbfevo.scenarios.plane", "resolution": [24, 24], "support": 0.5},
        "kernel": {"_target_": "rbfevo.scoring.kernels.wendland", "support": None},
        "manipulation": {"name": "indirect"},
        "method": method,
        "centers": 6,
        "evaluator": "fused",
    }
    return check(OmegaConf.create({**config, **changes}))


def search(method: dict, **changes) -> tuple[Run, Method, Rows]:
    run = Run(settings(method, **changes))
    (stage,) = run.stages
    stage.start(run.problem())
    for _ in range(stage.steps):
        stage.step()
    (rows,) = stage.rows()
    return run, stage, rows


def gradient(**changes) -> dict:
    return {"_target_": "rbfevo.methods.GradientSearch", **SMALL, **changes}


CASES = [
    ("plane", "wendland", "indirect"),
    ("plane", "triharmonic", "direct"),
    ("face", "wendland", "direct"),
    ("face", "triharmonic", "indirect"),
]
FACE = {"_target_": "rbfevo.scenarios.face", "subdivisions": 3, "support": 1.0}


def design(scenario: str, kernel: str, manipulation: str) -> dict:
    changes = {"kernel": {"_target_": f"rbfevo.scoring.kernels.{kernel}"}, "manipulation": {"name": manipulation}}
    return changes if scenario == "plane" else {**changes, "scenario": FACE}


@pytest.mark.parametrize("case", CASES, ids="-".join)
def test_front_is_better_than_nsga2s_at_twice_the_evaluations(case: tuple[str, str, str]) -> None:
    run, _, rows = search(gradient(), **design(*case))
    exact = run.evaluator.definition(rows.centers).objectives
    torch.testing.assert_close(rows.scores.objectives, exact, rtol=1e-6, atol=1e-8)
    assert nondominated(rows.scores.objectives).all()
    assert len(rows.centers) <= SMALL["front"]
    assert (rows.centers >= run.scenario.lower).all()
    assert (rows.centers <= run.scenario.upper).all()
    assert rows.preference.isnan().all()
    planned = run.planned
    assert run.total("gradients") == planned == 11 * 40 + 55 * 24
    # Random setups are scored on every design; the starts, and what they found, once more on the second.
    rescored = run.total("evaluations") - planned - 24 * (1 + len(run.coarse_evaluators))
    assert 40 < rescored <= 40 + 10 * SMALL["front"]
    peer = {"_target_": "rbfevo.methods.Nsga2Search", "population": 24, "generations": 2 * planned // 24}
    found = search(peer, **design(*case))[2].scores.objectives
    assert hypervolume(exact) > hypervolume(found)
    assert (exact.amax(0) >= found.amax(0) - 1e-6).all()


def heuristics(**changes) -> Iterator[Tensor]:
    for name in ("LloydHeuristic", "OlsHeuristic"):
        yield search({"_target_": f"rbfevo.methods.{name}"}, **changes)[2].scores.objectives


def test_preferences_are_better_served_than_by_what_they_start_from_and_by_cmaes() -> None:
    wishes = [0.0, 0.4, 1.0]
    run, stage, rows = search(gradient(), preference=wishes)
    assert rows.preference.tolist() == wishes
    assert run.total("gradients") == run.planned == 3 * (60 * 8 + 6 * 2)
    assert len(stage.progress()) == 3
    value = preferred(rows.preference, rows.scores.objectives)
    exact = preferred(rows.preference, run.evaluator.definition(rows.centers).objectives)
    torch.testing.assert_close(value, exact, rtol=1e-6, atol=1e-8)
    for start in heuristics():
        assert (value > preferred(rows.preference, start)).all()
    peer = {"_target_": "rbfevo.methods.CmaesSearch", "population": 24, "parents": 6, "generations": 20}
    found = search(peer, preference=wishes)[2]  # as many evaluations for all preferences together
    assert (value >= preferred(found.preference, found.scores.objectives) - 1e-6).all()


def test_one_preference_and_many() -> None:
    for wishes in (0.3, [i / 10 for i in range(11)]):
        _, _, rows = search(gradient(generations=20, polish=2), preference=wishes)
        assert len(rows.centers) == (1 if wishes == 0.3 else 11)
        assert rows.scores.objectives.isfinite().all()


def test_a_result_depends_on_the_seed_and_not_on_the_threads() -> None:
    fronts = []
    for threads, seed in ((1, 0), (2, 0), (1, 1)):
        torch.set_num_threads(threads)
        fronts.append(search(gradient(generations=20, polish=3), seed=seed)[2].centers)
    torch.testing.assert_close(fronts[0], fronts[1], rtol=0, atol=0)
    assert fronts[0].shape != fronts[2].shape or not torch.equal(fronts[0], fronts[2])


@pytest.mark.parametrize("preference", [None, [0.2, 0.9]])
@pytest.mark.parametrize("kernel", ["wendland", "triharmonic"])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize("centers", [1, 2])
def test_very_few_centers(centers: int, manipulation: str, kernel: str, preference: list[float] | None) -> None:
    changes = {**design("plane", kernel, manipulation), "centers": centers, "preference": preference}
    _, _, rows = search(gradient(generations=10, polish=2), **changes)
    assert len(rows.centers) >= 1
    assert rows.scores.objectives.isfinite().all()


def test_stopped_early_it_returns_what_it_has() -> None:
    run = Run(settings(gradient()))
    (stage,) = run.stages
    stage.start(run.problem())
    assert stage.rows() == []
    assert stage.progress() == []
    for _ in range(3):
        stage.step()
    (rows,) = stage.rows()
    assert len(rows.centers) > 0
    assert hypervolume(stage.progress()[0][1]) > 0


@pytest.mark.parametrize(
    "change",
    [
        {"population": 15},
        {"starts": 0},
        {"front": 1},
        {"coarse": 99},
        {"rough": 99},
        {"generations": 0},
        {"polish": 0},
        {"memory": 0},
    ],
)
def test_settings_that_cannot_work_are_named(change: dict) -> None:
    with pytest.raises(UserError, match=f"gradient: {next(iter(change))}="):
        GradientSearch(**change)


def test_fewer_starts_than_the_population_are_refused_only_where_starts_are_used() -> None:
    search = GradientSearch(starts=47)  # the population is 48
    with pytest.raises(UserError, match=r"gradient: starts=47: at least population=48 is needed"):
        search.check(None)
    search.check((0.0,))
