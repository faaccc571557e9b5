"""front.png: one panel of the paper's figures 3 and 6, improvement potential over regularity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter

from rbfevo.arrays import Array
from rbfevo.figures import style
from rbfevo.figures.series import HEURISTICS, Series, kinds, series
from rbfevo.recorded.record import Record, knee

DECADES = 2.0  # a regularity that spans more than this is drawn on a logarithmic axis
NAMED = 12  # setups at most that are written beside their marks by name


class Scale(NamedTuple):
    """The x axis: linear, or logarithmic with a margin left of `edge` where the setups of regularity 0 stand."""

    logarithmic: bool
    lower: float
    upper: float
    edge: float = 0.0
    zero: float = 0.0

    def place(self, regularity: Array) -> Array:
        """Return where `regularity` stands on the axis."""
        return np.where(regularity > 0, regularity, self.zero) if self.logarithmic else regularity


def picture(record: Record) -> Figure:
    """Draw the setups of a run: both scores are maximized, so good is to the right and up."""
    with style.typography():
        figure = Figure(figsize=(7.6, 4.7))
        axes = figure.add_axes((0.095, 0.125, 0.62, 0.735))
        searched = record.scored & ~np.isin(record.method, HEURISTICS)
        scale = scale_of(record.regularity[record.scored], record.regularity[searched])
        prepare(axes, scale, record.potential[record.scored], record.potential_name)
        front = record.front
        staircase(axes, scale, record.regularity[front], record.potential[front])
        shown = [(series(record, *kind), rows) for kind, rows in kinds(record).items()]
        for look, rows in sorted(shown, key=lambda kind: kind[0].order):
            mark(axes, scale, look, record.regularity[rows], record.potential[rows])
        _name(axes, scale, record)
        _mark_knee(axes, scale, record)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left", bbox_to_anchor=(1.02, 1.015), handletextpad=0.4, labelspacing=0.75)
        figure.text(0.095, 0.945, record.title, fontsize=12, weight="bold", va="center")
        figure.text(0.095, 0.895, _subtitle(record), color=style.GREY, va="center")
    return figure


def scale_of(regularity: Array, found: Array) -> Scale:
    """Choose the x axis for the regularities [p] of all setups that are drawn.

    It is logarithmic if the better nine tenths of the `found` ones [q] span decades. Random setups do not count: they
    nearly always do, and would squeeze a front that does not into a corner; nor does the thin tail of a front.
    """
    positive = regularity[regularity > 0]
    if positive.size == 0:
        return Scale(False, -0.03, 1.0)
    low, high = float(positive.min()), float(positive.max())
    decades = float(np.log10(high / low))
    deciding = found[found > 0] if (found > 0).any() else positive
    if np.log10(deciding.max() / np.quantile(deciding, 0.1)) <= DECADES:
        low = float(regularity.min())
        pad = 0.05 * (high - low if high > low else high)
        return Scale(False, low - pad, high + pad)

    def at(share: float) -> float:
        return low * 10.0 ** (share * decades)

    if positive.size == regularity.size:
        return Scale(True, at(-0.04), at(1.04))
    return Scale(True, at(-0.13), at(1.04), edge=at(-0.04), zero=at(-0.085))


def prepare(axes: Axes, scale: Scale, potential: Array, name: str = "improvement potential") -> None:
    """Name and tick the axes, and show all of `potential` [p]; the margin for regularity 0 has a tick of its own."""
    axes.set_ylabel(name)
    axes.set_xlabel("regularity (logarithmic)" if scale.logarithmic else "regularity")
    axes.spines[["top", "right"]].set_visible(False)
    if scale.logarithmic:
        axes.set_xscale("log")
    axes.set_xlim(scale.lower, scale.upper)
    if potential.size:
        low, high = float(potential.min()), float(potential.max())
        pad = 0.05 * (high - low if high > low else max(high, 1e-3))
        axes.set_ylim(low - pad, high + pad)
    axes.grid(color=style.PALE, linewidth=0.5, alpha=0.7)
    axes.set_axisbelow(True)
    if scale.zero > 0:
        for subdivisions, use in (((1,), axes.xaxis.set_major_locator), (range(2, 10), axes.xaxis.set_minor_locator)):
            ticks = np.asarray(LogLocator(subs=subdivisions).tick_values(scale.lower, scale.upper))
            use(FixedLocator(list(ticks[(ticks > scale.edge) & (ticks < scale.upper)])))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.axvspan(scale.lower, scale.edge, color="#f0f0f0", linewidth=0, zorder=0)
        place = {"xycoords": axes.get_xaxis_transform(), "textcoords": "offset points", "ha": "center", "va": "top"}
        axes.annotate("R = 0", (scale.zero, 0), (0, -5), **place)


def mark(axes: Axes, scale: Scale, look: Series, regularity: Array, potential: Array) -> None:
    """Put a mark where each setup [p] of a series stands."""
    axes.scatter(
        scale.place(regularity),
        potential,
        s=look.size,
        marker=look.marker,
        facecolor=look.color if look.filled else "white",
        edgecolor="white" if look.filled else look.color,
        linewidth=look.edge if look.filled else 1.0,
        zorder=look.order,
        label=look.label,
        clip_on=False,
    )


def staircase(
    axes: Axes, scale: Scale, regularity: Array, potential: Array, color: str = style.BLUE, alpha: float = 0.35
) -> None:
    """Draw the edge of what a front [p], by rising regularity, dominates, from the left of the axes to their bottom."""
    if regularity.size == 0:
        return
    x = scale.place(regularity)
    x, y = np.concatenate([[scale.lower], x, x[-1:]]), np.concatenate([potential[:1], potential, [axes.get_ylim()[0]]])
    axes.step(x, y, where="pre", color=color, linewidth=0.9, alpha=alpha, zorder=2)


def _name(axes: Axes, scale: Scale, record: Record) -> None:
    """Write the names of setups beside their marks, where several have one, but not too many."""
    named = [] if record.label is None else np.flatnonzero(record.scored & (record.label != "")).tolist()
    if record.label is None or not 1 < len(named) <= NAMED:
        return
    for row in named:
        place = float(scale.place(record.regularity[row])), float(record.potential[row])
        axes.annotate(str(record.label[row]), place, (6, 4), textcoords="offset points", fontsize=8, color=style.GREY)


def _mark_knee(axes: Axes, scale: Scale, record: Record) -> None:
    index = knee(record)
    if index is None:
        return
    x, y = float(scale.place(record.regularity[index])), float(record.potential[index])
    axes.scatter(
        x,
        y,
        s=190,
        marker="o",
        facecolor="none",
        edgecolor=style.INK,
        linewidth=1.1,
        zorder=7,
        label="knee",
        clip_on=False,
    )


def _subtitle(record: Record) -> str:
    parts = []
    hypervolume = record.summary.get("hypervolume")
    if isinstance(hypervolume, int | float):
        parts.append(f"hypervolume {hypervolume:.5g}")
    if record.objectives:
        parts.append(record.combination)
    parts.append(f"{record.centers.shape[1]} center{'s' * (record.centers.shape[1] != 1)}")
    if record.summary.get("seed") is not None:
        parts.append(f"seed {record.summary['seed']}")
    lost = int((~record.scored).sum())
    if lost:
        parts.append(f"{lost} setup{'s' * (lost != 1)} without scores not shown")
    return " · ".join(parts)
