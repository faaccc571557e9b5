"""The runs that everything is drawn from: each one a command of rbfevo's own, done once, skipped when it is there."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from benchmarks.fronts import DIRECTORY as COMMITTED
from benchmarks.fronts import Reference
from benchmarks.panels import PANELS, Panel
from rbfevo.__main__ import main as rbfevo
from reproduction.budgets import Budget

PREFERENCES = tuple(i / 10 for i in range(11))
POPULATION = 100
GENERATIONS = 1_000  # the paper's, of CMA-ES
FULL_PREFERENCES = (0.0, 0.5, 1.0)  # of the series `cmaes-full`


class Task(NamedTuple):
    """One run: a panel, a series and a seed, with the words that its command line has beside them.

    A series is a method, or `cmaes-full`: CMA-ES with the paper's generations and fewer preferences, where the budget's
    generations are fewer.
    """

    panel: Panel
    series: str
    seed: int
    words: tuple[str, ...] = ()

    @property
    def method(self) -> str:
        """As on the command line."""
        return self.series.split("-")[0]

    def directory(self, out: Path) -> Path:
        """Where its run directory lies."""
        return out / "runs" / self.panel.name / f"{self.series}-seed{self.seed}"

    @property
    def arguments(self) -> list[str]:
        """The words of the command line, but for the directory."""
        return [*self.panel.words, f"method={self.method}", *self.words, f"seed={self.seed}"]

    def done(self, out: Path) -> bool:
        """Whether the run directory holds a whole run of these very words."""
        directory = self.directory(out)
        try:
            summary = json.loads((directory / "summary.json").read_text())
            held = json.loads((directory / "words.json").read_text())
        except (OSError, ValueError):
            return False
        return summary.get("stop_reason") == "budget" and held == self.arguments

    def carry_out(self, out: Path) -> int:
        """Run it, from the start; return the exit code of the command."""
        directory = self.directory(out)
        shutil.rmtree(directory, ignore_errors=True)  # what an interruption left, or another budget
        code = rbfevo([*self.arguments, "quiet=true", "figures=false", f"hydra.run.dir={directory}"])
        if code == 0:
            (directory / "words.json").write_text(json.dumps(self.arguments))
        return code


def tasks(budget: Budget, panels: tuple[Panel, ...] = PANELS) -> list[Task]:
    """All runs of a budget but NSGA-II's, the quick ones first, one seed after the other."""
    planned = []
    for seed in budget.seeds:
        for panel in panels:
            own = budget.words(panel.scenario)
            planned += [
                Task(panel, "random", seed, (f"method.population={budget.random}", *own)),
                Task(panel, "lloyd", seed, own),
            ]
            if seed == budget.seeds[0]:  # OLS draws nothing
                planned.append(Task(panel, "ols", seed, own))
    for seed in budget.search_seeds:
        planned += [
            Task(panel, "gradient", seed, (*budget.gradient, *budget.words(panel.scenario))) for panel in panels
        ]
        planned += [preferred(budget, panel, "cmaes", seed, budget.generations, PREFERENCES) for panel in panels]
    for name in budget.full:
        chosen = [panel for panel in panels if panel.name == name]
        seed = budget.search_seeds[0]
        planned += [preferred(budget, panel, "cmaes-full", seed, GENERATIONS, FULL_PREFERENCES) for panel in chosen]
    return planned


def preferred(
    budget: Budget, panel: Panel, series: str, seed: int, generations: int, preferences: tuple[float, ...]
) -> Task:
    """CMA-ES for some preferences."""
    listed = ",".join(str(preference) for preference in preferences)
    words = (f"method.generations={generations}", f"preference=[{listed}]")
    return Task(panel, series, seed, (*words, *budget.words(panel.scenario)))


def fronts_directory(out: Path) -> Path:
    """Where the fronts lie that the repository does not hold."""
    return out / "runs" / "fronts"


def reference(panel: Panel, seed: int, budget: Budget, out: Path) -> Reference | None:
    """The NSGA-II search whose front is there, the repository's first; None if there is none."""
    words = budget.words(panel.scenario)
    for directory in (fronts_directory(out),) if words else (COMMITTED, fronts_directory(out)):
        held = Reference(panel, seed, directory, *words)
        if held.csv(budget.evaluations).exists():
            return held
    return None


def compute_front(panel: Panel, seed: int, budget: Budget, out: Path, say: Callable[[str], None]) -> None:
    """Compute a front that is not there; goes on from a smaller budget's state, the repository's or its own."""
    directory, words = fronts_directory(out), budget.words(panel.scenario)
    directory.mkdir(parents=True, exist_ok=True)
    own, committed = Reference(panel, seed, directory, *words), Reference(panel, seed)
    if not own.path.exists() and committed.path.exists() and not words:
        shutil.copyfile(committed.path, own.path)
    own.compute(budget.evaluations // POPULATION - 1, say)


def carry_out(budget: Budget, out: Path, say: Callable[[str], None], panels: tuple[Panel, ...] = PANELS) -> int:
    """Carry out the runs that are not there yet; return the first exit code that is not 0, or 0."""
    planned = tasks(budget, panels)
    missing = [task for task in planned if not task.done(out)]
    say(f"{len(planned) - len(missing)} of {len(planned)} runs are there")
    for task in missing:
        say(f"python -m rbfevo {' '.join(task.arguments)}")
        code = task.carry_out(out)
        if code != 0:
            return code
    return 0


def carry_out_fronts(budget: Budget, out: Path, say: Callable[[str], None], panels: tuple[Panel, ...] = PANELS) -> int:
    """Compute the fronts that are not there yet, if the budget does; say which are missing if it does not; return 0."""
    missing = [
        (panel, seed) for seed in budget.seeds for panel in panels if reference(panel, seed, budget, out) is None
    ]
    say(f"{len(budget.seeds) * len(panels) - len(missing)} of {len(budget.seeds) * len(panels)} fronts are there")
    for panel, seed in missing:
        if budget.computes_fronts:
            compute_front(panel, seed, budget, out, say)
        else:
            say(f"left out: scripts/fronts {panel.name} --seed {seed}")
    return 0
