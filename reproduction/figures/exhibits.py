"""The setups shown by figures 1, 4, 5 and 7, chosen from all results of a study, and the tables of their centers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from benchmarks.panels import Panel
from rbfevo.arrays import Array
from rbfevo.recorded.record import Record
from rbfevo.runs import storage
from rbfevo.scoring.deformation import MANIPULATIONS
from reproduction import measures
from reproduction.study import KINDS, SEARCHES, Setups, Study, panels_of


class Exhibit(NamedTuple):
    """A setup that a figure shows: its run, the criterion of its choice, centers [m, d], R, P, preference."""

    panel: Panel
    method: str
    seed: int
    criterion: str
    centers: Array
    regularity: float
    improvement_potential: float
    preference: float


def most_regular(study: Study, panel: Panel) -> Exhibit | None:
    """The setup of best regularity (ties: best P) that any search has found on a panel; None without any search."""
    return _best(_found(study, (panel,), SEARCHES, "regularity"), "regularity", "improvement_potential")


def most_improvable(study: Study, scenario: str, kind: str) -> Exhibit | None:
    """The setup of best improvement potential that any search has found for a kernel, over both manipulations."""
    found = _found(study, panels_of(scenario, kind), SEARCHES, "improvement potential")
    return _best(found, "improvement_potential", "regularity")


def knee(study: Study, panel: Panel) -> Exhibit | None:
    """The setup of a front farthest from the chord between its ends, each score scaled to [0, 1]; None without a front.

    The front is the gradient search's, or else NSGA-II's, of the first seed that has one.
    """
    for method in ("gradient", "nsga2"):
        for seed in study.seeds(panel, method):
            front = study.held(panel, method, seed).front
            row = int(measures.scaled(front.objectives, front.objectives).sum(axis=1).argmax())
            return _exhibit(front, row, panel, method, seed, "knee")
    return None


def greedy(study: Study, panel: Panel) -> Exhibit | None:
    """The setup of orthogonal least squares on a panel; None if it is missing."""
    return _best(_found(study, (panel,), ("ols",), "OLS"), "improvement_potential", "regularity")


def of_figure(study: Study, figure: str) -> list[list[Exhibit | None]]:
    """The setups that `figure` shows, in its rows and columns; a column for each kernel."""
    number, _, variant = figure.partition("-")
    scenario = variant or "plane"
    if number == "figure4":
        return [
            [most_regular(study, panels_of(scenario, kind, manipulation)[0]) for kind in KINDS]
            for manipulation in MANIPULATIONS
        ]
    if number == "figure5":
        return [[most_improvable(study, scenario, kind) for kind in KINDS]]
    if number == "figure7":
        return [[greedy(study, panels_of(scenario, kind, "indirect")[0]) for kind in KINDS]]
    if number == "figure1":
        (panel,) = panels_of("face", "local", "direct")
        return [[knee(study, panel) or greedy(study, panels_of("face", "local", "indirect")[0])]]
    return []


def record(study: Study, exhibits: Iterable[Exhibit]) -> Record:
    """These setups as the record of a run, as `rbfevo.figures` needs it. Kernel and support are those of the first one.

    Raises:
        IndexError: if there is none.
    """
    shown = list(exhibits)
    scenario = study.scenario(shown[0].panel.scenario)
    arrays = {
        name: getattr(scenario, name).numpy() for name in ("vertices", "faces", "gradient", "weights", "lower", "upper")
    }
    return Record(
        centers=np.stack([exhibit.centers for exhibit in shown]),
        regularity=np.array([exhibit.regularity for exhibit in shown]),
        improvement_potential=np.array([exhibit.improvement_potential for exhibit in shown]),
        method=np.array([exhibit.method for exhibit in shown]),
        preference=np.array([exhibit.preference for exhibit in shown]),
        nondominated=np.zeros(len(shown), dtype=bool),
        **arrays,
        summary={
            "kernel": shown[0].panel.kernel,
            "support": shown[0].panel.support,
            "gradient_norm": scenario.gradient_norm,
        },
    )


def table(exhibits: Iterable[Exhibit]) -> bytes:
    """The centers of these setups as CSV, one line per center."""
    axes, lines = "xy", []
    for exhibit in exhibits:
        axes = "xyz"[: exhibit.centers.shape[1]]
        names = exhibit.panel.name, exhibit.method, exhibit.seed, exhibit.criterion
        scores = exhibit.regularity, exhibit.improvement_potential
        lines += [(*names, *scores, j, *center) for j, center in enumerate(exhibit.centers.tolist())]
    header = ("panel", "method", "seed", "criterion", "R", "P", "center", *axes)
    return storage.csv_text(header, lines)


def _found(study: Study, panels: Iterable[Panel], methods: Iterable[str], criterion: str) -> list[Exhibit]:
    """The best setup of each panel, method and seed by a criterion."""
    found = []
    for panel in panels:
        for method in methods:
            for seed in study.budget.seeds:
                setups = study.setups(panel, method, seed)
                if setups is not None and len(setups.regularity):
                    row = setups.most_regular if criterion == "regularity" else setups.most_improvable
                    found.append(_exhibit(setups, row, panel, method, seed, criterion))
    return found


def _exhibit(setups: Setups, row: int, panel: Panel, method: str, seed: int, criterion: str) -> Exhibit:
    scores = float(setups.regularity[row]), float(setups.improvement_potential[row])
    return Exhibit(panel, method, seed, criterion, setups.centers[row], *scores, float(setups.preference[row]))


def _best(found: list[Exhibit], first: str, second: str) -> Exhibit | None:
    return max(found, key=lambda exhibit: (getattr(exhibit, first), getattr(exhibit, second)), default=None)
