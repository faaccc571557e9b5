"""The front of `method=gradient` on the paper's panels, compared with NSGA-II's reference fronts."""

from __future__ import annotations

import time
from collections.abc import Iterator

from torch import Tensor

from benchmarks.bench_rows import Row, at_least, at_most
from benchmarks.fronts import DIRECTORY, Reference, reference_front
from benchmarks.panels import PANELS, Panel
from rbfevo.runs.run import Run
from rbfevo.scoring.pareto import hypervolume

EVALUATIONS = (2_500_000, 250_000)
SECONDS = 60.0
SLACK = 1e-6  # of best R and best P


def fronts(quick: bool) -> Iterator[Row]:
    """Seconds, hypervolume, best R and best P of each panel, compared with the reference fronts on disk."""
    for panel in (panel for panel in PANELS if not quick or panel.name == "plane-wendland-0.5-indirect"):
        yield from one_front(panel)


def gradient_front(panel: Panel, seed: int, *overrides: str) -> tuple[Run, Tensor, float]:
    """The run, the front's objectives [p, 2] by definition, and its seconds including the final scores."""
    start = time.perf_counter()
    run = Run(panel.settings("method=gradient", f"seed={seed}", *overrides))
    (search,) = run.stages
    search.start(run.problem())
    for _ in range(search.steps):
        search.step()
    objectives = run.evaluator.definition(search.rows()[0].centers).objectives
    return run, objectives, time.perf_counter() - start


def one_front(panel: Panel, seed: int = 0, *overrides: str) -> Iterator[Row]:
    """The rows of one panel; `overrides` are further Hydra overrides."""
    run, objectives, seconds = gradient_front(panel, seed, *overrides)
    note = f"{run.total('gradients')} gradients"
    yield Row("fronts", panel.name, seconds, "s", **at_most(SECONDS, seconds, " s"), note=note)
    figures = {
        "hypervolume": (hypervolume, 0.0),
        "best R": (lambda front: float(front[:, 0].max()), SLACK),
        "best P": (lambda front: float(front[:, 1].max()), SLACK),
    }
    budgets = [budget for budget in EVALUATIONS if Reference(panel, seed, DIRECTORY).csv(budget).exists()]
    for name, (measure, slack) in figures.items():
        value = measure(objectives)
        for budget in budgets or [None]:
            if budget is None:
                yield Row("fronts", f"  {name}", value, "", note="no reference: scripts/fronts")
                continue
            peer = measure(reference_front(panel, budget, seed))
            against = f"nsga2, {budget:,} evaluations"
            target = at_least(1.0, (value + slack) / peer)
            yield Row("fronts", f"  {name}", value, "", peer, against, value / peer, **target)
