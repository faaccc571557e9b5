"""The runs behind all figures and claims: each is one rbfevo command, carried out once and skipped when it is done."""

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

PAPER = COMMITTED / "paper"  # fronts after the paper's own budget, as far as they were computed
PREFERENCES = tuple(i / 10 for i in range(11))
POPULATION = 100
GENERATIONS = 1_000  # the paper's, of CMA-ES
FULL_PREFERENCES = (0.0, 0.5, 1.0)  # of the series `cmaes-full`
ARGUMENTS = "arguments.json"  # in a run directory, written when its run is done
FORMER_ARGUMENTS = "words.json"  # its name in directories of earlier versions


class Task(NamedTuple):
    """One run: a panel, a series and a seed, with further Hydra overrides.

    A series is a method, or `cmaes-full`: CMA-ES with the paper's generations and fewer preferences, if the budget has
    fewer generations.
    """

    panel: Panel
    series: str
    seed: int
    overrides: tuple[str, ...] = ()

    @property
    def method(self) -> str:
        """The method's name on the command line."""
        return self.series.split("-")[0]

    def directory(self, out: Path) -> Path:
        """The run directory."""
        return out / "runs" / self.panel.name / f"{self.series}-seed{self.seed}"

    @property
    def arguments(self) -> list[str]:
        """The command-line arguments, without the run directory."""
        return [*self.panel.overrides, f"method={self.method}", *self.overrides, f"seed={self.seed}"]

    def done(self, out: Path) -> bool:
        """Whether the run directory holds a complete run with exactly these arguments."""
        directory = self.directory(out)
        try:
            summary = json.loads((directory / "summary.json").read_text())
        except (OSError, ValueError):
            return False
        return summary.get("stop_reason") == "budget" and stored_arguments(directory) == self.arguments

    def carry_out(self, out: Path) -> int:
        """Run it from the start; return the exit code of the command."""
        directory = self.directory(out)
        shutil.rmtree(directory, ignore_errors=True)  # remains of an interrupted run, or a run of another budget
        code = rbfevo([*self.arguments, "quiet=true", "figures=false", f"hydra.run.dir={directory}"])
        if code == 0:
            (directory / ARGUMENTS).write_text(json.dumps(self.arguments))
        return code


def stored_arguments(directory: Path) -> list[str] | None:
    """The arguments that a run directory was made with, under either file name; None if they cannot be read."""
    for name in (ARGUMENTS, FORMER_ARGUMENTS):
        try:
            return json.loads((directory / name).read_text())
        except FileNotFoundError:
            continue
        except (OSError, ValueError):
            return None
    return None


def tasks(budget: Budget, panels: tuple[Panel, ...] = PANELS) -> list[Task]:
    """All runs of a budget except NSGA-II's, the quick ones first, one seed after the other."""
    planned = []
    for seed in budget.seeds:
        for panel in panels:
            own = budget.overrides(panel.scenario)
            planned += [
                Task(panel, "random", seed, (f"method.population={budget.random}", *own)),
                Task(panel, "lloyd", seed, own),
            ]
            if seed == budget.seeds[0]:  # OLS is not random
                planned.append(Task(panel, "ols", seed, own))
    for seed in budget.search_seeds:
        planned += [
            Task(panel, "gradient", seed, (*budget.gradient, *budget.overrides(panel.scenario))) for panel in panels
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
    overrides = (f"method.generations={generations}", f"preference=[{listed}]")
    return Task(panel, series, seed, (*overrides, *budget.overrides(panel.scenario)))


def fronts_directory(out: Path) -> Path:
    """The directory of fronts that are not in the repository."""
    return out / "runs" / "fronts"


def reference(panel: Panel, seed: int, budget: Budget, out: Path) -> Reference | None:
    """The NSGA-II search of an existing front, preferably the repository's; None if there is no front.

    A front counts only with its state: figures need its centers, which the front's file does not have.
    """
    overrides = budget.overrides(panel.scenario)
    for directory in (fronts_directory(out),) if overrides else (COMMITTED, PAPER, fronts_directory(out)):
        held = Reference(panel, seed, directory, *overrides)
        if held.csv(budget.evaluations).exists() and held.path.exists():
            return held
    return None


def compute_front(panel: Panel, seed: int, budget: Budget, out: Path, report: Callable[[str], None]) -> None:
    """Compute a missing front, continuing from the state of a smaller budget in `out` or in the repository."""
    directory, overrides = fronts_directory(out), budget.overrides(panel.scenario)
    directory.mkdir(parents=True, exist_ok=True)
    own = Reference(panel, seed, directory, *overrides)
    states = [] if overrides else [Reference(panel, seed, place).path for place in (PAPER, COMMITTED)]
    begun = next((path for path in states if path.exists()), None)
    if not own.path.exists() and begun is not None:
        shutil.copyfile(begun, own.path)
    own.compute(budget.evaluations // POPULATION - 1, report)


def carry_out(budget: Budget, out: Path, report: Callable[[str], None], panels: tuple[Panel, ...] = PANELS) -> int:
    """Carry out the missing runs; return the first exit code that is not 0, or 0."""
    planned = tasks(budget, panels)
    missing = [task for task in planned if not task.done(out)]
    report(f"{len(planned) - len(missing)} of {len(planned)} runs are done")
    for task in missing:
        report(f"python -m rbfevo {' '.join(task.arguments)}")
        code = task.carry_out(out)
        if code != 0:
            return code
    return 0


def carry_out_fronts(
    budget: Budget, out: Path, report: Callable[[str], None], panels: tuple[Panel, ...] = PANELS
) -> int:
    """Compute the missing fronts, or report them if the budget does not compute fronts; return 0."""
    missing = [
        (panel, seed) for seed in budget.seeds for panel in panels if reference(panel, seed, budget, out) is None
    ]
    count = len(budget.seeds) * len(panels)
    report(f"{count - len(missing)} of {count} fronts are done")
    for panel, seed in missing:
        if budget.computes_fronts:
            compute_front(panel, seed, budget, out, report)
        else:
            report(f"left out: scripts/fronts {panel.name} --seed {seed}")
    return 0
