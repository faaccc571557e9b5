"""Figures 3 and 6: improvement potential over regularity of every method, a panel for each kernel and manipulation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.panels import Panel
from rbfevo.figures import front, style
from rbfevo.figures.series import Series
from rbfevo.scoring.deformation import MANIPULATIONS
from rbfevo.scoring.pareto import hypervolume
from reproduction.figures import wording
from reproduction.figures.layout import Sheet, blank
from reproduction.study import KINDS, Setups, Study, panels_of

# The paper's colours; the gradient search, which it does not have, is dark and small, so that it reads in grey too.
SERIES = {
    "random": Series("initial population", style.GREEN, "o", 13, 2),
    "gradient": Series("gradient search, front", style.INK, "o", 6, 3, edge=0.0),
    "nsga2": Series("NSGA-II, front", style.BLUE, "o", 15, 4, edge=0.2),
    "cmaes": Series("CMA-ES, λ = 0, 0.1 … 1", style.MAGENTA, "^", 36, 5),
    "cmaes-full": Series("CMA-ES, 1,000 generations", style.MAGENTA, "^", 34, 5, filled=False),
    "lloyd": Series("Lloyd", style.ORANGE, "o", 58, 6),
    "ols": Series("OLS", style.ORANGE, "D", 44, 6),
}
BELOW = Series("", style.GREEN, "v", 20, 2)
ROOM = 0.6  # share of the other series' range by which the initial population may lie below them
WIDTH, HEIGHT = 2.42, 2.15  # of a panel, inches
LEFT, TOP, ACROSS, DOWN, BOTTOM = 0.98, 0.78, 0.52, 0.56, 0.48


def picture(study: Study, scenario: str, caption: str) -> Figure:
    """Draw the six panels of a scenario with one legend."""
    with style.typography():
        width = LEFT + 3 * (WIDTH + ACROSS) - ACROSS + 0.3
        sheet = Sheet(width, TOP + 2 * (HEIGHT + DOWN) - DOWN + BOTTOM, caption)
        labels: set[str] = set()
        for i, manipulation in enumerate(MANIPULATIONS):
            top = TOP + i * (HEIGHT + DOWN)
            sheet.text(0.24, top + HEIGHT / 2, manipulation, rotation=90, ha="center", va="center", weight="bold")
            for j, kind in enumerate(KINDS):
                (panel,) = panels_of(scenario, kind, manipulation)
                axes = sheet.axes(LEFT + j * (WIDTH + ACROSS), top, WIDTH, HEIGHT)
                title = _draw(axes, study, panel)
                axes.set_xlabel(axes.get_xlabel() if i == 1 else "", fontsize=9.5)
                axes.set_ylabel(axes.get_ylabel() if j == 0 else "", fontsize=9.5)
                axes.set_title(title, fontsize=7.5, color=style.GREY, pad=4)
                labels |= set(axes.get_legend_handles_labels()[1])
                if i == 0:
                    center = LEFT + j * (WIDTH + ACROSS) + WIDTH / 2
                    sheet.text(center, TOP - 0.3, wording.kernel(panel), ha="center", weight="bold", fontsize=10)
        shown = [_handle(series, name == "gradient") for name, series in SERIES.items() if series.label in labels]
        if shown:
            sheet.figure.legend(
                handles=shown,
                loc="upper center",
                bbox_to_anchor=(0.5, 1.0),
                ncols=len(shown),
                fontsize=8.5,
                handlelength=1.4,
                handletextpad=0.4,
                columnspacing=1.5,
                borderaxespad=0.35,
            )
    return sheet.figure


def _draw(axes: Axes, study: Study, panel: Panel) -> str:
    """Draw one panel; return its hypervolumes as text."""
    seed = study.budget.seeds[0]
    held = {name: study.setups(panel, name, 0 if name == "ols" else seed) for name in SERIES}
    series = {name: setups for name, setups in held.items() if setups is not None and len(setups.regularity)}
    if not series:
        blank(axes, "not there")
        return ""
    found = {name: setups for name, setups in series.items() if name != "random"} or series
    searched = [setups.regularity for name, setups in found.items() if name not in ("lloyd", "ols")]
    regularity = np.concatenate([setups.regularity for setups in series.values()])
    scale = front.scale_of(regularity, np.concatenate(searched or [regularity]))
    potential = np.concatenate([setups.improvement_potential for setups in found.values()])
    lowest = potential.min() - ROOM * np.ptp(potential) if "random" in series else potential.min()
    every = np.concatenate([setups.improvement_potential for setups in series.values()])
    front.prepare(axes, scale, np.clip(every, lowest, None))
    axes.tick_params(labelsize=8, length=2.5)
    axes.locator_params(nbins=5)
    if not scale.logarithmic:
        axes.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
        axes.xaxis.get_offset_text().set_fontsize(8)
    for name, setups in series.items():
        drawn = setups.front if name in ("gradient", "nsga2") else setups
        if name == "gradient":
            front.staircase(axes, scale, drawn.regularity, drawn.improvement_potential, style.INK, alpha=0.7)
        if name == "random":
            below = setups[np.flatnonzero(setups.improvement_potential < lowest)]
            drawn = setups[np.flatnonzero(setups.improvement_potential >= lowest)]
            edge = np.full(len(below.regularity), axes.get_ylim()[0])
            front.mark(axes, scale, BELOW, below.regularity, edge)
        front.mark(axes, scale, SERIES[name], drawn.regularity, drawn.improvement_potential)
    return _hypervolumes(series)


def _handle(series: Series, line: bool) -> Line2D:
    """The legend handle of a series."""
    size = max(4.0, series.size**0.5)
    look: dict[str, Any] = {"marker": series.marker, "markersize": size}
    if series.filled:
        look |= {"markeredgecolor": "white", "markeredgewidth": series.edge}
    else:
        look |= {"markerfacecolor": "white", "markeredgewidth": 1.0}
    return Line2D([], [], color=series.color, linewidth=0.9 if line else 0.0, label=series.label, **look)


def _hypervolumes(series: dict[str, Setups]) -> str:
    names = {"nsga2": "NSGA-II", "gradient": "gradient"}
    values = [
        f"{label} {wording.number(hypervolume(torch.from_numpy(series[name].objectives)))}"
        for name, label in names.items()
        if name in series
    ]
    return f"hypervolume: {', '.join(values)}" if values else ""
