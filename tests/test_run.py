"""One run: what is kept when something goes wrong, and how it is put together."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import moocore
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from rbfevo.errors import UserError
from rbfevo.methods.method import Rows, random_stream
from rbfevo.runs import run
from rbfevo.runs.config import Settings, check
from rbfevo.scoring.evolvability import Scores

METHODS = {
    "nsga2": {"_target_": "rbfevo.methods.Nsga2Search", "population": 8, "generations": 3},
    "cmaes": {"_target_": "rbfevo.methods.CmaesSearch", "population": 6, "parents": 3, "generations": 2},
    "lloyd": {"_target_": "rbfevo.methods.LloydHeuristic", "starts": 2},
    "ols": {"_target_": "rbfevo.methods.OlsHeuristic", "per_axis": 8},
}


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def settings(method: str, **changes) -> Settings:
    node = METHODS.get(method, {"_target_": "rbfevo.methods.Panel", **METHODS})
    config = {
        "scenario": {"_target_": "rbfevo.scenarios.plane", "resolution": [14, 14], "support": 0.5},
        "kernel": {"_target_": "rbfevo.scoring.kernels.wendland", "support": None},
        "manipulation": {"name": "indirect"},
        "method": node,
        "centers": 5,
        "quiet": True,
    }
    return check(OmegaConf.create({**config, **changes}))


def table(directory: Path) -> dict[str, np.ndarray]:
    with np.load(directory / "setups.npz") as archive:
        return dict(archive)


def test_a_heuristic_that_cannot_work_does_not_sink_the_panel(tmp_path: Path, monkeypatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise UserError("no candidate is usable")

    monkeypatch.setattr("rbfevo.methods.ols.ols", refuse)
    assert run.carry_out(settings("panel"), tmp_path) == 0
    assert set(table(tmp_path)["method"].tolist()) == {"random", "nsga2", "cmaes", "lloyd"}
    assert "ols was skipped: no candidate is usable" in (tmp_path / "summary.json").read_text()


def test_what_was_found_before_an_error_is_written(tmp_path: Path, monkeypatch) -> None:
    def break_down(*_: object, **__: object) -> None:
        raise RuntimeError("out of memory, say")

    monkeypatch.setattr("rbfevo.methods.lloyd.lloyd", break_down)
    with pytest.raises(RuntimeError, match="out of memory"):
        run.carry_out(settings("panel"), tmp_path)
    assert set(table(tmp_path)["method"].tolist()) == {"random", "nsga2", "cmaes"}


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interruption_ends_the_run_after_the_step(
    number: signal.Signals, code: int, tmp_path: Path, monkeypatch
) -> None:
    before = signal.getsignal(number)
    step = run.Method.records

    def interrupted(self, generation: int, *arguments):
        if self.name == "nsga2" and generation == 2:
            signal.raise_signal(number)
        return step(self, generation, *arguments)

    monkeypatch.setattr(run.Method, "records", interrupted)
    assert run.carry_out(settings("panel"), tmp_path) == code
    assert set(table(tmp_path)["method"].tolist()) == {"random", "nsga2"}
    assert (tmp_path / "history.csv").read_text().count("nsga2") == 2
    assert signal.getsignal(number) == before


def test_scores_do_not_depend_on_the_evaluator(tmp_path: Path) -> None:
    for backend in ("fused", "eager"):
        (tmp_path / backend).mkdir()
        assert run.carry_out(settings("lloyd", evaluator=backend), tmp_path / backend) == 0
    fused, eager = table(tmp_path / "fused"), table(tmp_path / "eager")
    for name in fused:
        np.testing.assert_array_equal(fused[name], eager[name])


def test_streams_of_random_numbers_are_told_apart_by_seed_and_name() -> None:
    draws = {
        (seed, name): torch.rand(4, generator=random_stream(seed, name)).tolist()
        for seed in (0, 1, 2**40)
        for name in ("initial", "nsga2", "cmaes 0.1", "cmaes 0.2")
    }
    assert len({tuple(values) for values in draws.values()}) == len(draws)
    again = torch.rand(4, generator=random_stream(1, "nsga2")).tolist()
    assert again == draws[1, "nsga2"]


def test_the_hypervolume_is_that_of_the_rows_that_are_saved(tmp_path: Path) -> None:
    assert run.carry_out(settings("nsga2"), tmp_path) == 0
    rows = table(tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    objectives = np.stack((rows["regularity"], rows["improvement_potential"]), axis=1)
    assert summary["hypervolume"] == pytest.approx(moocore.hypervolume(objectives, ref=[0, 0], maximise=True))
    last = (tmp_path / "history.csv").read_text().splitlines()[-1].split(",")
    found = dict(zip((tmp_path / "history.csv").read_text().splitlines()[0].split(","), last, strict=True))
    own = objectives[rows["method"] == "nsga2"]
    assert float(found["hypervolume"]) == pytest.approx(moocore.hypervolume(own, ref=[0, 0], maximise=True), rel=1e-6)
    assert float(found["best_regularity"]) == pytest.approx(own[:, 0].max(), rel=1e-6)
    assert float(found["best_improvement_potential"]) == pytest.approx(own[:, 1].max(), rel=1e-6)


def test_differences_are_those_of_the_search_from_what_is_saved() -> None:
    def rows(*objectives: tuple[float, float]) -> list[Rows]:
        R, P = torch.tensor(objectives, dtype=torch.float64).T
        scores = Scores(R, P, torch.zeros_like(R), torch.zeros_like(R, dtype=torch.bool))
        return [Rows("x", torch.zeros(len(R), 1, 2), scores, torch.full_like(R, torch.nan))]

    found = run.differences(rows((0.11, 0.5), (0.22, 0.6), (0.3, 0.2)), rows((0.1, 0.52), (0.2, 0.6), (0.4, 0.5)))
    assert found == pytest.approx(
        {
            "regularity_median": 0.1,
            "regularity_largest": 0.25,
            "improvement_potential_median": -0.02,
            "improvement_potential_largest": 0.3,
        }
    )
    assert run.differences([], []) is None
