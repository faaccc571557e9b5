"""Duration of the later optimization over regularity: a row for each scenario, a column for each manipulation."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rbfevo.figures import style
from rbfevo.fit import MANIPULATIONS, STRATEGIES
from reproduction import pays
from reproduction.figures.layout import Sheet, blank
from reproduction.study import KINDS, SCENARIOS, Study

SIDE, HIGH, GAP, LEFT, TOP, BELOW = 2.55, 1.95, 0.22, 1.05, 0.8, 0.66  # inches
COLORS = {"local": style.BLUE, "wide": style.ORANGE, "triharmonic": style.MAGENTA}
NAMES = {"local": "local Wendland", "wide": "wide Wendland", "triharmonic": "triharmonic"}
ROWS = {"plane": "plane", "face": "sphere"}


def picture(study: Study, caption: str) -> Figure:
    """Draw generations until convergence over R, both logarithmic; triangles mark fits that were given up."""
    with style.typography():
        sheet = Sheet(LEFT + 3 * (SIDE + GAP), TOP + 2 * (HIGH + BELOW) - 0.1, caption)
        for row, scenario in enumerate(SCENARIOS):
            top = TOP + row * (HIGH + BELOW)
            cells = [sheet.axes(LEFT + column * (SIDE + GAP), top, SIDE, HIGH) for column in range(3)]
            shown = [panel(axes, study, scenario, name) for axes, name in zip(cells, MANIPULATIONS, strict=True)]
            if any(shown):
                drawn = [axes for axes, some in zip(cells, shown, strict=True) if some]
                x, y = (np.array([limits(axes) for axes in drawn]) for limits in (Axes.get_xlim, Axes.get_ylim))
                for axes in drawn:
                    axes.set_xlim(x[:, 0].min(), x[:, 1].max())
                    axes.set_ylim(y[:, 0].min(), y[:, 1].max())
                    axes.tick_params(labelleft=axes is cells[0])
                cells[0].set_ylabel("generations")
            name = ROWS[scenario]
            sheet.text(0.22, top + HIGH / 2, name, rotation=90, ha="center", va="center", weight="bold", fontsize=11)
        for column, name in enumerate(MANIPULATIONS):
            left = LEFT + column * (SIDE + GAP) + SIDE / 2
            sheet.text(left, TOP - 0.2, name, ha="center", va="center", weight="bold", fontsize=11)
        sheet.figure.legend(
            handles=legend(),
            loc="upper center",
            ncols=5,
            bbox_to_anchor=(0.5, 1 - 0.1 / sheet.height),
            handletextpad=0.3,
        )
    return sheet.figure


def panel(axes: Axes, study: Study, scenario: str, manipulation: str) -> bool:
    """Draw one panel; return whether there are fits to show. Orthogonalized setups stand at their indirect R."""
    shown = False
    for strategy in STRATEGIES:
        raw, found = pays.pairs(study, scenario, "indirect", manipulation, strategy)
        for kind in KINDS:
            rows = found.of(kind)
            R = raw.of(kind).R if manipulation == "orthogonalized" else rows.R
            for there, marker in ((rows.reached == 1, "o"), (rows.reached < 1, "^")):
                face = COLORS[kind] if strategy == "isotropic" else "none"
                axes.scatter(
                    R[there],
                    rows.generations[there],
                    s=20,
                    marker=marker,
                    facecolor=face,
                    edgecolor=COLORS[kind] if face == "none" else "white",
                    linewidth=0.9 if face == "none" else 0.3,
                    clip_on=False,
                )
            shown |= len(R) > 0
    if not shown:
        blank(axes, "no fits there")
        return False
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("regularity of the indirect setup" if manipulation == "orthogonalized" else "regularity")
    axes.grid(color=style.PALE, linewidth=0.5, alpha=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return True


def legend() -> list[Line2D]:
    """The marks of kernels and strategies."""
    blank_line = {"linestyle": "none", "markersize": 6}
    kernels = [Line2D([], [], marker="o", color=COLORS[kind], label=NAMES[kind], **blank_line) for kind in KINDS]
    open_ = Line2D([], [], marker="o", color=style.GREY, markerfacecolor="none", label="open: CMA-ES", **blank_line)
    up = Line2D([], [], marker="^", color=style.GREY, label="given up", **blank_line)
    return [*kernels, open_, up]
