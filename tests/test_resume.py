"""A run that was stopped goes on from its checkpoint and ends as if it had never been stopped, bit for bit."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from rbfevo.commands import resume
from rbfevo.errors import UserError
from rbfevo.methods.method import HistoryLine
from rbfevo.runs import checkpoint, run
from rbfevo.runs.config import Settings, check
from rbfevo.runs.journal import Journal

NSGA2 = {"_target_": "rbfevo.methods.Nsga2Search", "population": 8, "generations": 7}
CMAES = {"_target_": "rbfevo.methods.CmaesSearch", "population": 6, "parents": 3, "generations": 6}
GRADIENT = {
    "_target_": "rbfevo.methods.GradientSearch",
    "starts": 16,
    "population": 16,
    "polish": 3,
    "coarse": 160,
    "rough": 100,
}
LLOYD = {"_target_": "rbfevo.methods.LloydHeuristic", "starts": 2}
OLS = {"_target_": "rbfevo.methods.OlsHeuristic", "per_axis": 8}
PANEL = {"_target_": "rbfevo.methods.Panel", "nsga2": NSGA2, "cmaes": CMAES, "lloyd": LLOYD, "ols": OLS}
METHODS: dict[str, tuple[dict[str, Any], Any]] = {
    "nsga2": (NSGA2, None),
    "cmaes": (CMAES, [0.0, 0.3, 1.0]),
    "gradient": (GRADIENT | {"generations": 12}, None),
    "gradient for preferences": (GRADIENT | {"generations": 12}, [0.2, 0.8]),
    "panel": (PANEL, None),
}
STEPS = {"nsga2": 7, "cmaes": 6, "gradient": 15, "gradient for preferences": 15, "panel": 15}


class KilledError(BaseException):
    """The end of a process that cannot do anything about it."""


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def settings(name: str, every: float | None = 0, **changes: Any) -> Settings:
    method, preference = METHODS[name]
    config = {
        "scenario": {"_target_": "rbfevo.scenarios.plane", "resolution": [14, 14], "support": 0.5},
        "kernel": {"_target_": "rbfevo.scoring.kernels.wendland", "support": None},
        "manipulation": {"name": "direct"},
        "method": method,
        "preference": preference,
        "centers": 4,
        "checkpoint": {"every": every},
        "quiet": True,
    }
    return check(OmegaConf.create({**config, **changes}))


def kill_after(monkeypatch: pytest.MonkeyPatch, steps: int, within: str = "record") -> None:
    """Let the process die after so many steps, before or while the checkpoint after the last of them is written."""
    count, real = 0, getattr(Journal, within)

    def dying(self: Journal, *arguments: Any) -> Any:
        nonlocal count
        count += 1
        if count == steps:
            monkeypatch.setattr(run.Run, "save", lambda *_: None)  # a process that is killed writes nothing more
            raise KilledError
        return real(self, *arguments)

    monkeypatch.setattr(Journal, within, dying)


def arrays(directory: Path) -> dict[str, np.ndarray]:
    with np.load(directory / "setups.npz") as archive:
        return dict(archive)


def history(directory: Path) -> list[list[str]]:
    """history.csv without the seconds."""
    at = HistoryLine._fields.index("seconds")
    return [line[:at] + line[at + 1 :] for line in csv.reader(io.StringIO((directory / "history.csv").read_text()))]


def counted(directory: Path) -> dict[str, Any]:
    """summary.json without what depends on the clock and on the number of threads."""
    summary = json.loads((directory / "summary.json").read_text())
    others = ("seconds", "evaluations_per", "threads")
    return {key: value for key, value in summary.items() if not key.startswith(others)}


def assert_same(one: Path, other: Path) -> None:
    here, there = arrays(one), arrays(other)
    assert here.keys() == there.keys()
    for name, array in here.items():
        assert np.array_equal(array, there[name], equal_nan=array.dtype.kind == "f"), name
    assert history(one) == history(other)
    assert counted(one) == counted(other)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Where a run of a method lies that was never stopped."""
    done: dict[str, Path] = {}

    def give(name: str) -> Path:
        if name not in done:
            done[name] = tmp_path_factory.mktemp(name.replace(" ", "-")) / "run"
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("rbfevo.figures.draw", lambda run: [])
                torch.set_num_threads(1)
                assert run.carry_out(settings(name, None), done[name]) == 0
        return done[name]

    return give


@pytest.mark.parametrize("name", list(METHODS))
def test_results_do_not_depend_on_the_number_of_threads(name, uninterrupted, tmp_path):
    """Rests on: threads share slices of a population, and each operation on small matrices has one of them."""
    once = uninterrupted(name)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert run.carry_out(settings(name, None), tmp_path) == 0
    finally:
        torch.set_num_threads(before)
    assert_same(tmp_path, once)


@pytest.mark.parametrize(("name", "steps"), [(name, k) for name, last in STEPS.items() for k in range(1, last + 1, 2)])
def test_a_killed_run_ends_as_if_it_had_not_been(name, steps, uninterrupted, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        kill_after(patch, steps)
        with pytest.raises(KilledError):
            run.carry_out(settings(name), tmp_path)
    assert not (tmp_path / "setups.npz").exists()
    assert run.carry_out(settings(name), tmp_path, resume=True) == 0
    assert_same(tmp_path, uninterrupted(name))
    assert not (tmp_path / ".history.csv").exists()


@pytest.mark.parametrize("name", list(METHODS))
def test_a_run_may_be_killed_again_and_again(name, uninterrupted, tmp_path, monkeypatch):
    began = False
    for steps in (1, 2, 3, 1):
        with monkeypatch.context() as patch:
            kill_after(patch, steps)
            with pytest.raises(KilledError):
                run.carry_out(settings(name), tmp_path, resume=began)
        began = True
    run.carry_out(settings(name), tmp_path, resume=True)
    assert_same(tmp_path, uninterrupted(name))


@pytest.mark.parametrize("name", ["nsga2", "gradient"])
@pytest.mark.parametrize("every", [None, 1e9])
def test_without_a_checkpoint_in_time_a_run_begins_anew(name, every, uninterrupted, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        kill_after(patch, 5)
        with pytest.raises(KilledError):
            run.carry_out(settings(name, every), tmp_path)
    run.carry_out(settings(name, every), tmp_path, resume=True)
    assert_same(tmp_path, uninterrupted(name))


@pytest.mark.parametrize("name", ["nsga2", "cmaes", "panel"])
def test_an_interrupted_run_has_results_and_goes_on(name, uninterrupted, tmp_path, monkeypatch):
    real = run.Run._stage

    def interrupted(self, stage, problem, start, reporter, interruption, journal):
        count = 0

        def step() -> None:
            nonlocal count
            count += 1
            type(stage).step(stage)
            if count == 3:
                interruption.signal = 2

        monkeypatch.setattr(stage, "step", step, raising=False)
        real(self, stage, problem, start, reporter, interruption, journal)

    with monkeypatch.context() as patch:
        patch.setattr(run.Run, "_stage", interrupted)
        assert run.carry_out(settings(name, None), tmp_path) == 130
    assert counted(tmp_path)["stop_reason"] == "interrupted by SIGINT"
    assert len(history(tmp_path)) > 1
    assert run.carry_out(settings(name), tmp_path, resume=True) == 0
    assert_same(tmp_path, uninterrupted(name))


def longer(name: str, generations: int) -> Settings:
    method, preference = METHODS[name]
    return settings(name, method=method | {"generations": generations}, preference=preference)


@pytest.mark.parametrize("name", ["nsga2", "cmaes"])
def test_a_run_that_is_done_can_be_lengthened(name, tmp_path):
    run.carry_out(settings(name), tmp_path / "short")
    run.carry_out(longer(name, 11), tmp_path / "short", resume=True)
    run.carry_out(longer(name, 11), tmp_path / "long")
    assert_same(tmp_path / "short", tmp_path / "long")


# --- what cannot go on -----------------------------------------------------------------------------------------------


@pytest.fixture
def half(tmp_path, monkeypatch) -> Path:
    """A run of NSGA-II that was killed in its fifth generation."""
    with monkeypatch.context() as patch:
        kill_after(patch, 5)
        with pytest.raises(KilledError):
            run.carry_out(settings("nsga2"), tmp_path / "half")
    return tmp_path / "half"


def check_refused(directory: Path, message: str, changed: Settings | None = None) -> None:
    """Assert that resuming is refused in one line and that nothing in the directory changes."""
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    with pytest.raises(UserError, match=message) as error:
        run.carry_out(changed or settings("nsga2"), directory, resume=True)
    assert "\n" not in str(error.value)
    assert {path.name: path.read_bytes() for path in directory.iterdir()} == before


def test_other_settings_are_refused(half):
    check_refused(half, "settings differ from those of its checkpoint", settings("nsga2", centers=5))
    check_refused(half, "settings differ from those of its checkpoint", settings("nsga2", seed=1))
    check_refused(half, "settings differ from those of its checkpoint", settings("cmaes"))


def test_fewer_generations_than_taken_are_refused(half):
    check_refused(half, "it has taken 4 already", longer("nsga2", 3))


def test_other_versions_are_told(half):
    state = checkpoint.load(half)
    checkpoint.save(half, state | {"versions": {**state["versions"], "torch": "1.0"}, "threads": 7})
    run.carry_out(settings("nsga2"), half, resume=True)
    (warning,) = counted(half)["warnings"]
    assert warning == (
        f"resumed with torch 1.0 then, {torch.__version__} now: last digits may differ from those of a run in one piece"
    )  # the number of threads is no reason


def test_a_changed_design_is_refused(half, monkeypatch):
    monkeypatch.setattr("rbfevo.runs.run.digest", lambda *parts: "another")
    check_refused(half, "was a file replaced")


def test_a_run_that_is_done_is_refused(tmp_path):
    run.carry_out(settings("nsga2"), tmp_path)
    check_refused(tmp_path, "is finished; to lengthen it")


def test_a_gradient_search_cannot_be_lengthened(tmp_path):
    run.carry_out(settings("gradient"), tmp_path)
    check_refused(tmp_path, "its plan depends on their number", longer("gradient", 20))


def test_a_history_that_is_too_short_is_refused(half):
    with (half / ".history.csv").open("r+b") as file:
        file.truncate(10)
    check_refused(half, "shorter than the checkpoint requires")


@pytest.mark.parametrize("seed", range(40))
def test_a_damaged_checkpoint_is_one_line(half, seed):
    rng = np.random.default_rng(seed)
    content = bytearray((half / checkpoint.NAME).read_bytes())
    if seed % 4 == 0:
        content = content[: rng.integers(len(content))]
    elif seed % 4 == 1:
        content = bytearray(rng.bytes(int(rng.integers(1, 2000))))
    else:
        for _ in range(3):
            content[rng.integers(len(content))] ^= int(rng.integers(1, 256))
    (half / checkpoint.NAME).write_bytes(content)
    message = None
    try:
        checkpoint.load(half)
    except UserError as error:
        message = str(error)
    if message is None:
        assert seed % 4 >= 2  # a few changed bytes may be ones that nothing depends on
    else:
        assert "checkpoint" in message
        assert "\n" not in message


def test_a_checkpoint_cannot_hold_code(half):
    class Harmful:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (half / "harm",))

    np.savez(half / checkpoint.NAME, allow_pickle=True, state=np.array([Harmful()], dtype=object))
    check_refused(half, "damaged or no checkpoint")
    assert not (half / "harm").exists()


def test_a_foreign_checkpoint_is_one_line(half):
    np.savez(half / checkpoint.NAME, weights=np.zeros(3))
    check_refused(half, "damaged or no checkpoint")
    np.savez(half / checkpoint.NAME, state=np.frombuffer(b'{"format": 99}', np.uint8))
    check_refused(half, "of another format")


def test_a_directory_without_a_checkpoint_is_one_line(tmp_path):
    tmp_path.joinpath("note.txt").write_text("mine")
    with pytest.raises(UserError, match="holds no checkpoint"):
        run.carry_out(settings("nsga2"), tmp_path, resume=True)


def test_a_run_that_is_not_done_is_not_begun_anew(half):
    with pytest.raises(UserError, match=f"continue it with resume={half}"):
        run.carry_out(settings("nsga2"), half)


# --- the file --------------------------------------------------------------------------------------------------------


def test_a_checkpoint_gives_back_what_it_was_given(tmp_path):
    state = {
        "number": 0.1 + 0.2,
        "huge": 2**70,
        "nan": float("nan"),
        "infinite": [float("inf"), -float("inf")],
        "words": ["é", "", None, True],
        "deep": {"a.b": {"c": [torch.arange(3), {"d": np.float64(3)}]}},
        "empty": torch.zeros(0, 4),
        "bytes": torch.get_rng_state(),
        "flags": torch.tensor([True, False]),
        "odd": torch.arange(12, dtype=torch.float64).view(3, 4).T,
    }
    checkpoint.save(tmp_path, state)
    found = checkpoint.tensors(checkpoint.load(tmp_path))
    assert found["number"] == state["number"]
    assert found["huge"] == 2**70
    assert np.isnan(found["nan"])
    assert found["infinite"] == state["infinite"]
    assert found["words"] == state["words"]
    assert torch.equal(found["deep"]["a.b"]["c"][0], torch.arange(3))
    for name in ("empty", "bytes", "flags", "odd"):
        assert torch.equal(found[name], state[name])
        assert found[name].dtype == state[name].dtype


def test_the_head_of_a_checkpoint_is_read_without_its_arrays(half):
    head = checkpoint.head(half)
    assert head.keys() >= {"words", "settings", "whole", "versions", "finished"}
    with zipfile.ZipFile(half / checkpoint.NAME) as archive:
        assert len(archive.namelist()) > 3


# --- the words -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "word", ["method.generations=9", "method.nsga2.generations=9", "checkpoint.every=1", "quiet=true", "device=cpu"]
)
def test_some_words_may_change_on_the_way(half, word):
    state = checkpoint.load(half)
    checkpoint.save(half, state | {"words": ["scenario=plane", f"{word.split('=')[0]}=0", "seed=3"]})
    found, others = resume.split([f"resume={half}", word])
    assert found == half
    assert resume.recorded(half, others) == ["scenario=plane", "seed=3", word, f"hydra.run.dir={half}"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["seed=1"], "seed=1: this cannot change when a run is resumed"),
        (["method.population=4"], "this cannot change when a run is resumed"),
        (["hydra.run.dir=x"], "this cannot change when a run is resumed"),
        (["-m"], "start it again with the same hydra.sweep.dir"),
        (["resume=other"], "give one run, not several"),
    ],
)
def test_other_words_may_not(half, arguments, message):
    with pytest.raises(UserError, match=message):
        resume.split([f"resume={half}", *arguments])


@pytest.mark.parametrize(
    ("value", "said"), [("", "give the directory of a run"), ("nowhere", "there is no such directory")]
)
def test_a_directory_that_is_not_there_is_one_line(value, said):
    with pytest.raises(UserError, match=said):
        resume.split([f"resume={value}"])
