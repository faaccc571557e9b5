"""curves.png: potential and regularity over the number of centers, and where another center stops paying."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, ScalarFormatter

from rbfevo.figures import style
from rbfevo.figures.front import DECADES
from rbfevo.recorded.sweep import Curve, NestedSequence, labels_of
from rbfevo.recorded.sweep.curves import BEST, SHARE

KNEE_POTENTIAL, KNEE_REGULARITY = "knee_improvement_potential", "knee_regularity"
COLOURS = (style.BLUE, style.ORANGE, style.GREEN, style.MAGENTA, "#7a5cc4", "#008c95", "#a3591f", style.RED)
DASHES = ((0, (1, 1.5)), (0, (4, 1.5)), (0, (4, 1.5, 1, 1.5)))  # of the sequences
NUMBERS = "number of centers (logarithmic)"
TICKS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
HEIGHT, LINE = 4.1, 0.2  # inches: of a row of axes with its title, of a line of the legend


def is_logarithmic(curves: Sequence[Curve]) -> bool:
    """Whether the regularities of the knees span so many decades that their axis is logarithmic."""
    known = [value for curve in curves for group in curve.groups for value in group.values[KNEE_REGULARITY]]
    positive = [value for value in known if math.isfinite(value) and value > 0.0]
    return bool(positive) and math.log10(max(positive) / min(positive)) > DECADES


def picture(curves: Sequence[Curve], sequences: Sequence[NestedSequence], name: str) -> Figure:
    """A row of two panels for each mesh that has curves: potential, and regularity of the knee."""
    meshes = list(dict.fromkeys(curve.mesh for curve in curves))
    labels = labels_of(sequences)
    rows = []
    for mesh in meshes:
        own = [curve for curve in curves if curve.mesh == mesh]
        nested = [(one, label) for one, label in zip(sequences, labels, strict=True) if one.mesh == mesh]
        rows.append((own, nested, LINE * (len(own) + len(nested) + 3)))
    total = sum(max(HEIGHT, 0.9 + legend) for *_, legend in rows)
    with style.typography():
        figure = Figure(figsize=(12.2, total))
        top = total
        for (own, nested, legend), mesh in zip(rows, meshes, strict=True):
            height = max(HEIGHT, 0.9 + legend)
            left, right = (
                figure.add_axes((x, (top - height + 0.55) / total, 0.315, (height - 1.15) / total))
                for x in (0.055, 0.425)
            )
            _row(left, right, own, nested)
            title = name if len(meshes) == 1 else f"{name} · mesh {mesh}"
            figure.text(0.055, (top - 0.32) / total, title, fontsize=12, weight="bold", va="center")
            handles, names = left.get_legend_handles_labels()
            figure.legend(handles, names, loc="upper left", bbox_to_anchor=(0.75, (top - 0.5) / total), fontsize=8)
            top -= height
    return figure


def _row(left: Axes, right: Axes, curves: Sequence[Curve], sequences: Sequence[tuple[NestedSequence, str]]) -> None:
    for (sequence, label), dash in zip(sequences, _cycled(DASHES, len(sequences)), strict=True):
        numbers = np.arange(1, len(sequence.points) + 1)
        look: dict[str, Any] = {"color": style.GREY, "linestyle": dash, "linewidth": 1.2}
        left.plot(numbers, sequence.potential, label=label, **look)
        right.plot(numbers, _positive(sequence.regularity), **look)
    for curve, colour in zip(curves, _cycled(COLOURS, len(curves)), strict=True):
        _curve(left, curve, BEST, colour, label=curve.label)
        _curve(left, curve, KNEE_POTENTIAL, colour, linestyle="--", mfc="white")
        _curve(right, curve, KNEE_REGULARITY, colour)
        if curve.enough is not None:
            left.axvline(curve.enough, color=colour, linewidth=0.8, alpha=0.7, zorder=1)
            right.axvline(curve.enough, color=colour, linewidth=0.8, alpha=0.7, zorder=1)
    potential = curves[0].groups[0].potential
    if any(group.seeds > 1 for curve in curves for group in curve.groups):
        left.plot([], [], color=style.GREY, label="dots: seeds; band: quartiles", marker=".", linestyle="none")
    left.plot([], [], color=style.GREY, marker="o", label=f"solid: best {potential}")
    left.plot(
        [], [], color=style.GREY, marker="o", mfc="white", linestyle="--", label=f"dashed: {potential} of the knee"
    )
    if any(curve.enough is not None for curve in curves):
        left.plot([], [], color=style.GREY, linewidth=0.8, label=f"upright: fewest with {SHARE} of the gain")
    left.set(xlabel=NUMBERS, ylabel=potential)
    logarithmic = is_logarithmic(curves)
    right.set(xlabel=NUMBERS, ylabel=f"regularity of the knee{' (logarithmic)' if logarithmic else ''}")
    if logarithmic:
        right.set_yscale("log")
    tried = sorted({number for curve in curves for number in curve.centers})
    ticks = TICKS if sequences or tried[-1] >= 4 * tried[0] else tried
    largest = max([tried[-1], *(len(sequence.points) for sequence, _ in sequences)])
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_xticks([tick for tick in ticks if tick <= largest])
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_locator(NullLocator())
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color=style.PALE, linewidth=0.5, alpha=0.7)
        axes.set_axisbelow(True)


def _curve(axes: Axes, curve: Curve, key: str, colour: str, **look: Any) -> None:
    """Medians joined by a line, quartiles as a band, and a dot for each seed."""
    spreads = [group.spreads[key] for group in curve.groups]
    numbers, logarithmic = curve.centers, key == KNEE_REGULARITY
    medians = [spread.median for spread in spreads]
    style_of = {"color": colour, "marker": "o", "markersize": 5.0, "linewidth": 1.4, **look}
    axes.plot(numbers, _positive(medians) if logarithmic else medians, **style_of)
    if any(group.seeds > 1 for group in curve.groups):
        lower, upper = [spread.lower for spread in spreads], [spread.upper for spread in spreads]
        axes.fill_between(numbers, lower, upper, color=colour, alpha=0.15, linewidth=0)
        each = [
            (number, value) for number, group in zip(numbers, curve.groups, strict=True) for value in group.values[key]
        ]
        axes.plot(*zip(*each, strict=True), ".", color=colour, markersize=3.0, alpha=0.6)


def _positive(values: Sequence[float]) -> list[float]:
    """Values with NaN in the place of 0, which no logarithmic axis has."""
    return [value if value > 0.0 else math.nan for value in values]


def _cycled(values: Sequence[Any], count: int) -> list[Any]:
    return [values[i % len(values)] for i in range(count)]
