"""The design optimizations (fits) whose course R and P are meant to predict, with setups of every method.

A group is a scenario and a kernel. Its setups are fitted under every manipulation by every strategy, with a table for
each; existing tables are not computed again. Groups run in parallel, one process each.
"""

from __future__ import annotations

import csv
import hashlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from rbfevo.errors import UserError
from rbfevo.fit import MANIPULATIONS, STRATEGIES, Fit, Objective, deformation, fits
from rbfevo.methods.method import random_stream
from rbfevo.runs.config import build
from rbfevo.runs.storage import csv_text, write_whole
from rbfevo.scenarios.scenario import Scenario
from reproduction import measures
from reproduction.study import KINDS, SCENARIOS, Array, Setups, Study, panels_of

FROM_FRONT, FROM_RANDOM = 5, 6
SMOOTHNESS = {"plane": 0.0, "face": 1.0}
COLUMNS = (
    "scenario", "kernel", "manipulation", "strategy", "origin", "setup", "seed", "regularity", "improvement_potential",
    "generations", "stop", "start_error", "optimum", "error", "evaluations",
)  # fmt: skip


class Group(NamedTuple):
    """The setups of one kernel on one scenario."""

    scenario: str
    kind: str

    def path(self, out: Path, manipulation: str, strategy: str) -> Path:
        """The file of the table of one manipulation and strategy."""
        return out / "fits" / f"{self.scenario}-{self.kind}-{manipulation}-{strategy}.csv"


GROUPS = tuple(Group(scenario, kind) for scenario in SCENARIOS for kind in KINDS)


def spread(setups: Setups, count: int) -> Setups:
    """`count` setups of a front, about evenly spaced along it, including its ends."""
    front = setups.front
    if len(front.regularity) <= count:
        return front
    along = np.concatenate([[0.0], np.cumsum(measures.steps(front.objectives))])
    nearest = [int(np.abs(along - place).argmin()) for place in np.linspace(0, along[-1], count)]
    return front[np.unique(nearest)]


def setups(study: Study, group: Group) -> tuple[Array, list[str]]:
    """Centers [B, m, d] of the setups that are fitted, and the origin of each; seed 0.

    Raises:
        UserError: if their runs are missing.
    """
    centers, origins = [], []
    for manipulation in ("indirect", "direct"):
        (panel,) = panels_of(group.scenario, group.kind, manipulation)
        front = spread(study.held(panel, "gradient", 0), FROM_FRONT)
        centers.append(front.centers)
        origins += [f"{manipulation} front"] * len(front.centers)
    (panel,) = panels_of(group.scenario, group.kind, "indirect")
    for method, count in (("random", FROM_RANDOM), ("lloyd", 1), ("ols", 1)):
        found = study.held(panel, method, 0)
        centers.append(found.centers[:count])
        origins += [method] * count
    return np.concatenate(centers), origins


def design(study: Study, name: str) -> Scenario:
    """The scenario that is fitted: the plane as it is, or a sphere with the budget's number of vertices."""
    if name == "plane":
        return study.scenario("plane")
    (panel,) = panels_of(name, "local", "indirect")
    return build(panel.settings("method=lloyd", f"scenario.subdivisions={study.budget.fit_subdivisions}").scenario)


def carry_out_group(out: Path, group: Group) -> str:
    """Fit the setups of one group for every missing table; return a line to report."""
    begin = time.perf_counter()
    study = Study(out)
    budget, position = study.budget, SCENARIOS.index(group.scenario)
    centers, origins = setups(study, group)
    forget_others(out, group, study, centers)
    missing = [
        (manipulation, strategy)
        for manipulation in MANIPULATIONS
        for strategy in STRATEGIES
        if not group.path(out, manipulation, strategy).exists()
    ]
    if not missing:
        return f"fits of {group.scenario} {group.kind}: complete"
    scenario, seeds = design(study, group.scenario), range(budget.fit_seeds[position])
    (panel,) = panels_of(group.scenario, group.kind, "indirect")
    kernel = build(panel.settings("method=lloyd").kernel, scenario.vertices.shape[1], scenario.support)
    chosen = torch.from_numpy(centers)
    # The least error belongs to the design space, whatever the manipulation and the strategy.
    spaces = (deformation(scenario, kernel, setup, "orthogonalized").U for setup in chosen)
    optima = Objective(scenario, spaces, SMOOTHNESS[group.scenario]).optimum().error
    for manipulation, strategy in missing:
        found = fits(
            scenario,
            kernel,
            chosen.repeat(len(seeds), 1, 1),
            manipulation,
            strategy,
            generators=[random_stream(seed, f"fit {row}") for seed in seeds for row in range(len(chosen))],
            generations=budget.fit_generations[position],
            smoothness=SMOOTHNESS[group.scenario],
            optima=optima.repeat(len(seeds)),
        )
        key = (group.scenario, group.kind, manipulation, strategy)
        rows = [
            (*key, origins[i % len(chosen)], i % len(chosen), seeds[i // len(chosen)], *columns(fit))
            for i, fit in enumerate(found)
        ]
        write_whole(group.path(out, manipulation, strategy), csv_text(COLUMNS, rows))
    return f"fits of {group.scenario} {group.kind}: {len(missing)} tables in {time.perf_counter() - begin:.0f} s"


def forget_others(out: Path, group: Group, study: Study, centers: Array) -> None:
    """Remove tables made from other setups or with other settings; record the current ones."""
    budget = study.budget
    settings = [budget.fit_subdivisions, *budget.fit_generations, *budget.fit_seeds, SMOOTHNESS[group.scenario]]
    mark = hashlib.sha256(repr(settings).encode() + np.ascontiguousarray(centers).tobytes()).hexdigest()
    path = out / "fits" / f"{group.scenario}-{group.kind}.sha256"
    if path.exists() and path.read_text() != mark:
        for table in path.parent.glob(f"{group.scenario}-{group.kind}-*.csv"):
            table.unlink()
    write_whole(path, mark.encode())


def columns(fit: Fit) -> tuple[Any, ...]:
    """The columns of a table that come from a fit."""
    scores = (fit.regularity, fit.improvement_potential)
    return (*scores, fit.generations, fit.stop, fit.start_error, fit.optimum, fit.error, fit.evaluations)


def carry_out(study: Study, report: Callable[[str], None], groups: Sequence[Group] = GROUPS) -> int:
    """Carry out all missing fits; return 0, or 1 if a group failed."""
    (study.out / "fits").mkdir(exist_ok=True)
    workers = max(1, min(len(groups), len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1))
    code = 0
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_one_thread) as pool:
        waiting = {pool.submit(carry_out_group, study.out, group): group for group in groups}
        for done in as_completed(waiting):
            try:
                report(done.result())
            except UserError as error:
                report(f"fits of {' '.join(waiting[done])} were left out: {error}")
                code = 1
    return code


def _one_thread() -> None:
    torch.set_num_threads(1)


def tables(study: Study) -> Iterator[dict[str, str]]:
    """The rows of all existing tables."""
    for group in GROUPS:
        for manipulation in MANIPULATIONS:
            for strategy in STRATEGIES:
                path = group.path(study.out, manipulation, strategy)
                if path.exists():
                    with path.open(newline="") as file:
                        yield from csv.DictReader(file)
