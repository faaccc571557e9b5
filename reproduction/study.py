"""The results behind figures and claims: the setups of every method on every panel and seed, read from disk."""

from __future__ import annotations

import csv
import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.panels import PANELS, Panel
from rbfevo.errors import UserError
from rbfevo.runs.config import build
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.pareto import nondominated
from reproduction import runs
from reproduction.budgets import Budget, budget_named

Array = NDArray[np.float64]
METHODS = ("random", "nsga2", "cmaes", "cmaes-full", "lloyd", "ols", "gradient")  # series, as in `runs.Task`
SEARCHES = ("nsga2", "cmaes", "cmaes-full", "gradient")
SCENARIOS = ("plane", "face")
KINDS = ("local", "wide", "triharmonic")  # of kernels, in the order of KERNELS
KERNELS = {
    "plane": ("wendland-0.25", "wendland-0.5", "triharmonic"),
    "face": ("wendland-0.5", "wendland-1", "triharmonic"),
}


class Setups(NamedTuple):
    """p setups of one method on a panel: centers [p, m, d], R, P, V (NaN: unknown), preference (NaN: none)."""

    centers: Array
    regularity: Array
    improvement_potential: Array
    variability: Array
    preference: Array

    @property
    def objectives(self) -> Array:
        """[p, 2]: R and P, both maximized."""
        return np.stack([self.regularity, self.improvement_potential], axis=1)

    @property
    def front(self) -> Setups:
        """The nondominated setups by ascending regularity, the first of equal ones."""
        _, first = np.unique(self.objectives, axis=0, return_index=True)  # sorted by R, then P
        kept = nondominated(torch.from_numpy(self.objectives[first])).numpy()
        return self[first[kept]]

    @property
    def most_regular(self) -> int:
        """The setup of best R; ties are resolved by better P."""
        return int(np.lexsort((-self.improvement_potential, -self.regularity))[0])

    @property
    def most_improvable(self) -> int:
        """The setup of best P; ties are resolved by better R."""
        return int(np.lexsort((-self.regularity, -self.improvement_potential))[0])

    def __getitem__(self, rows: Any) -> Any:
        """Some of the setups if `rows` is an array; a field if it is a number, as in every tuple."""
        if isinstance(rows, int | slice):
            return tuple.__getitem__(self, rows)
        return Setups(*(field[rows] for field in self))


class Study:
    """The results in a directory of `scripts/reproduce`; missing series are None.

    Attributes:
        out: the directory.
        budget: of the results.
        facts: the contents of study.json.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        try:
            facts = json.loads((out / "study.json").read_text())
        except (OSError, ValueError) as error:
            raise UserError(f"{out}/study.json cannot be read: make it with scripts/reproduce --out {out}") from error
        self.budget: Budget = budget_named(facts["budget"])
        self.facts: dict[str, Any] = facts

    @functools.cache  # noqa: B019 - one study a process
    def setups(self, panel: Panel, method: str, seed: int) -> Setups | None:
        """The setups of one method; None if that run is missing. OLS has only seed 0."""
        if method == "nsga2":
            return self._front(panel, seed)
        path = self.directory(panel, method, seed) / "setups.npz"
        arguments = any((path.parent / name).exists() for name in (runs.ARGUMENTS, runs.FORMER_ARGUMENTS))
        if not arguments or not all((path.parent / name).exists() for name in (path.name, "summary.json")):
            return None
        with np.load(path, allow_pickle=False) as file:
            rows = file["method"] == method.split("-")[0]
            return Setups(**{name: file[name][rows] for name in Setups._fields})

    def directory(self, panel: Panel, method: str, seed: int) -> Path:
        """The run directory of one method."""
        return runs.Task(panel, method, seed).directory(self.out)

    def summary(self, panel: Panel, method: str, seed: int) -> dict[str, Any] | None:
        """`summary.json` of one run; None if it is missing."""
        path = self.directory(panel, method, seed) / "summary.json"
        return json.loads(path.read_text()) if path.exists() else None

    def _front(self, panel: Panel, seed: int) -> Setups | None:
        held = runs.reference(panel, seed, self.budget, self.out)
        if held is None:
            return None
        population, objectives = (tensor.numpy() for tensor in held.population(self.budget.evaluations))
        centers = population.reshape(len(population), -1, 2 if panel.scenario == "plane" else 3)
        nothing = np.full(len(population), np.nan)
        return Setups(centers, objectives[:, 0], objectives[:, 1], nothing, nothing)

    def front_seconds(self, panel: Panel, seed: int) -> float | None:
        """The processor seconds of NSGA-II's front; None if it is missing."""
        held = runs.reference(panel, seed, self.budget, self.out)
        if held is None:
            return None
        lines = held.csv(self.budget.evaluations).read_text().splitlines()
        facts = dict(line[2:].split(": ", 1) for line in lines if line.startswith("# "))
        return float(facts["processor_seconds"])

    def seeds(self, panel: Panel, *methods: str) -> list[int]:
        """The seeds for which the runs of all these methods exist; OLS counts for every seed."""
        wanted = [method for method in methods if method != "ols"]
        if "ols" in methods and self.setups(panel, "ols", 0) is None:
            return []
        return [
            seed for seed in self.budget.seeds if all(self.setups(panel, name, seed) is not None for name in wanted)
        ]

    def each(self, panels: tuple[Panel, ...], *methods: str) -> Iterator[tuple[Panel, int, list[Setups]]]:
        """Panel, seed and the setups of these methods, wherever the runs of all of them exist."""
        for panel in panels:
            for seed in self.seeds(panel, *methods):
                yield panel, seed, [self.held(panel, name, 0 if name == "ols" else seed) for name in methods]

    def held(self, panel: Panel, method: str, seed: int) -> Setups:
        """The setups of one method, as `setups` returns them.

        Raises:
            UserError: if that run is missing.
        """
        found = self.setups(panel, method, seed)
        if found is None:
            raise UserError(f"{self.out}: there is no run of {method} on {panel.name} with seed {seed}")
        return found

    @functools.cache  # noqa: B019
    def scenario(self, name: str) -> Scenario:
        """The scenario, at the size used by every run."""
        panel = next(panel for panel in PANELS if panel.scenario == name)
        return build(panel.settings("method=lloyd", *self.budget.overrides(name)).scenario)

    def table(self, name: str) -> list[dict[str, str]]:
        """A table of the directory, such as `fits.csv`; empty if it is missing."""
        path = self.out / name
        if not path.exists():
            return []
        with path.open(newline="") as file:
            return list(csv.DictReader(file))


def kernel_of(panel: Panel) -> str:
    """The paper's kernel of a panel, such as `wendland-0.5`."""
    return panel.name.split("-", 1)[1].rsplit("-", 1)[0]


def panels_of(
    scenario: str | None = None, kernel: str | None = None, manipulation: str | None = None
) -> tuple[Panel, ...]:
    """The panels of a scenario, a kernel (`wendland`, `local`, `wide`, `triharmonic`) and a manipulation.

    `local` is Wendland's kernel of the smaller support radius on each scenario, `wide` that of the larger one.
    """

    def matches(panel: Panel) -> bool:
        """Whether a panel has the scenario, kernel and manipulation."""
        position = KERNELS[panel.scenario].index(kernel_of(panel))
        kinds = (("wendland", "local"), ("wendland", "wide"), ("triharmonic",))[position]
        return (
            scenario in (None, panel.scenario)
            and manipulation in (None, panel.manipulation)
            and (kernel is None or kernel in kinds)
        )

    return tuple(panel for panel in PANELS if matches(panel))
