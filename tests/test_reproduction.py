"""`scripts/reproduce`: runs that are carried out once, fronts, claims, and mistakes on its command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from studies import TINY, began, full_study

from benchmarks.fronts import Reference, reference_front
from benchmarks.panels import PANELS
from rbfevo.scoring.pareto import hypervolume
from reproduction import __main__ as command
from reproduction import runs
from reproduction.budgets import BUDGETS, budget_named
from reproduction.study import Study

SMALL = TINY._replace(seeds=(0,), search_seeds=(0,), full=())


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return began(tmp_path / "out", monkeypatch, SMALL)


def test_every_budget_plans_every_series() -> None:
    for budget in BUDGETS.values():
        planned = runs.tasks(budget)
        assert len({(task.panel, task.series, task.seed) for task in planned}) == len(planned)
        assert {task.method for task in planned} == {"random", "lloyd", "ols", "gradient", "cmaes"}
        assert {task.panel for task in planned} == set(PANELS)
    assert BUDGETS["paper"].evaluations == 2_500_000
    assert BUDGETS["paper"].generations == 1_000
    assert BUDGETS["medium"].evaluations == 250_000


def test_runs_are_carried_out_once(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    panels = PANELS[:1]
    assert runs.carry_out(SMALL, out, lines.append, panels) == 0
    assert lines[0] == "0 of 5 runs are done"
    assert len(lines) == 6
    lines.clear()
    monkeypatch.setattr(runs, "rbfevo", lambda arguments: pytest.fail("it was done"))
    assert runs.carry_out(SMALL, out, lines.append, panels) == 0
    assert lines == ["5 of 5 runs are done"]

    study = Study(out)
    assert study.held(panels[0], "cmaes", 0).preference.tolist() == [i / 10 for i in range(11)]
    assert study.held(panels[0], "random", 0).centers.shape == (8, 5, 2)
    assert study.seeds(panels[0], "gradient", "ols") == [0]

    # another budget's run, and one that was interrupted, are carried out again
    asked: list[list[str]] = []
    monkeypatch.setattr(runs, "rbfevo", lambda arguments: asked.append(arguments) or 143)
    other = SMALL._replace(generations=3)
    assert runs.carry_out(other, out, lines.append, panels) == 143
    assert [word for word in asked[0] if "generations" in word] == ["method.generations=3"]
    task = runs.tasks(SMALL, panels)[1]
    summary = task.directory(out) / "summary.json"
    summary.write_text(json.dumps({**json.loads(summary.read_text()), "stop_reason": "interrupted by SIGTERM"}))
    assert not task.done(out)


def test_arguments_are_read_under_their_former_file_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = full_study(tmp_path, monkeypatch)
    task = runs.tasks(study.budget)[0]
    directory = task.directory(tmp_path)
    current, former = directory / "arguments.json", directory / "words.json"
    assert runs.stored_arguments(directory) == task.arguments
    current.rename(former)
    assert runs.stored_arguments(directory) == task.arguments
    assert task.done(tmp_path)
    assert Study(tmp_path).setups(task.panel, task.series, task.seed) is not None
    former.write_text("[]")
    assert not task.done(tmp_path)
    current.write_text(json.dumps(task.arguments))  # takes precedence
    assert task.done(tmp_path)
    current.write_text("not JSON")
    assert runs.stored_arguments(directory) is None
    current.unlink()
    former.unlink()
    assert runs.stored_arguments(directory) is None
    assert not task.done(tmp_path)
    assert Study(tmp_path).setups(task.panel, task.series, task.seed) is None


def test_fronts_are_computed_where_the_budget_says_so(out: Path) -> None:
    lines: list[str] = []
    assert runs.carry_out_fronts(SMALL._replace(computes_fronts=False), out, lines.append, PANELS[:1]) == 0
    assert "left out: scripts/fronts" in lines[1]
    assert Study(out).setups(PANELS[0], "nsga2", 0) is None
    assert runs.carry_out_fronts(SMALL, out, lines.append, PANELS[:1]) == 0
    study = Study(out)
    front = study.held(PANELS[0], "nsga2", 0)
    assert front.centers.shape == (100, 5, 2)
    assert study.front_seconds(PANELS[0], 0) is not None


def test_committed_fronts_are_used_where_they_fit() -> None:
    reference = runs.reference(PANELS[0], 0, BUDGETS["medium"], Path("nowhere"))
    assert reference is not None
    assert reference.directory == runs.COMMITTED
    assert runs.reference(PANELS[0], 0, SMALL, Path("nowhere")) is None


def test_a_front_counts_only_with_its_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paper = tmp_path / "paper"
    paper.mkdir()
    monkeypatch.setattr(runs, "PAPER", paper)
    own = Reference(PANELS[0], 0, paper)
    own.csv(2_500_000).write_text("# evaluations: 2500000\n")
    assert runs.reference(PANELS[0], 0, BUDGETS["paper"], tmp_path / "nowhere") is None
    own.path.touch()
    found = runs.reference(PANELS[0], 0, BUDGETS["paper"], tmp_path / "nowhere")
    assert found is not None
    assert found.directory == paper


@pytest.mark.parametrize("path", sorted(runs.PAPER.glob("*.csv")), ids=lambda path: path.stem)
def test_fronts_at_the_papers_budget_have_their_states(path: Path) -> None:
    name, seed, evaluations = path.stem.rsplit("-", 2)
    (panel,) = [panel for panel in PANELS if panel.name == name]
    reference = Reference(panel, int(seed.removeprefix("seed")), runs.PAPER)
    _, objectives = reference.population(int(evaluations))
    front = reference_front(panel, int(evaluations), reference.seed, runs.PAPER)
    assert hypervolume(front) == pytest.approx(hypervolume(objectives), rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--budget", "huge"], "choose one of quick, medium, paper"),
        (["no-such-panel"], "no panel has this name"),
        (["--claim", "nothing", "--out", "OUT"], "there is no such claim; choose from"),
        (["--claim", "smooth", "--out", "missing"], "make it with scripts/reproduce"),
        (["--out", "OUT", "--budget", "quick"], "is of --budget tiny"),
        (["--out", "OUT", "--budget", "tiny", "--only", "claims"], "has no runs to measure claims on"),
        (["--out", "OUT", "--claim", "smooth"], "has no runs to measure claims on"),
        (["--out", "OUT", "--claim", "smooth", "plane"], "takes all panels"),
    ],
)
def test_mistakes_get_one_line(out: Path, arguments: list[str], message: str, capsys, monkeypatch) -> None:
    monkeypatch.chdir(out.parent)
    assert command.main([argument.replace("OUT", str(out)) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert len(captured.err.splitlines()) == 1


def test_a_claim_can_be_measured_again(out: Path, capsys) -> None:
    runs.carry_out_fronts(SMALL, out, lambda line: None, PANELS[:2])
    assert command.main(["--claim", "smooth", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "The fronts are smooth" in shown
    assert PANELS[1].name in shown


def test_the_budget_is_found_by_name() -> None:
    assert budget_named("quick").name == "quick"
