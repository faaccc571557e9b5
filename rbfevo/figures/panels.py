"""The grid of centers.png: a column for each chosen setup, a row for each thing shown, one colour bar a row."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.figures import style
from rbfevo.recorded.picks import best
from rbfevo.recorded.record import Record, knee

NAMED = 3  # objectives at most whose potentials stand over a panel
LEFT, RIGHT, TOP, BOTTOM, GAP = 0.95, 1.05, 1.12, 0.5, 0.24  # inches


class Colors(NamedTuple):
    """How values become colours."""

    norm: Normalize
    cmap: Colormap

    def rgb(self, values: Array) -> Array:
        """Return the colours [n, 3] of values [n]."""
        return np.asarray(self.cmap(self.norm(values)))[:, :3]


@dataclasses.dataclass(frozen=True)
class Choice:
    """A setup with a column: its row in the files, its title, and U U^+ g [n, k], None if unknown."""

    index: int
    title: str
    reached: Array | None


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of panels: its name, the function that draws one choice into axes, and its colour bar, if it has one."""

    label: str
    draw: Callable[[Axes, Choice], None]
    colors: Colors | None = None
    unit: str = ""


def choose(record: Record) -> dict[int, str]:
    """Return the setups of best regularity, the knee and best improvement potential with their titles, each setup once.

    Raises:
        UserError: if no setup has finite scores and centers.
    """
    usable = record.usable
    if usable.size == 0:
        raise UserError("no setup has finite centers and scores")
    if usable.size == 1:
        return {int(usable[0]): "the only setup"}
    R, P = record.regularity, record.potential
    found = [
        (best(usable, R, P), "best regularity"),
        (knee(record), "knee"),
        (best(usable, P, R), f"best {record.potential_name}"),
    ]
    titles: dict[int, str] = {}
    for index, title in found:
        if index is not None and index in usable:
            titles[int(index)] = f"{titles[int(index)]},\n{title}" if int(index) in titles else title
    return titles


def compose(record: Record, choices: list[Choice], rows: list[Row], width: float, height: float, note: str) -> Figure:
    """Return the figure of all panels, each `width` x `height` inches."""
    top = TOP + 0.17 * (max(choice.title.count("\n") for choice in choices) + bool(note))
    total_width = LEFT + len(choices) * (width + GAP) - GAP + RIGHT
    total_height = top + len(rows) * (height + GAP) - GAP + BOTTOM
    figure = Figure(figsize=(total_width, total_height))

    def box(left: float, low: float, wide: float, high: float) -> tuple[float, float, float, float]:
        return left / total_width, low / total_height, wide / total_width, high / total_height

    for i, row in enumerate(rows):
        low = total_height - top - height - i * (height + GAP)
        for j, choice in enumerate(choices):
            left = LEFT + j * (width + GAP)
            axes = figure.add_axes(box(left, low, width, height))
            row.draw(axes, choice)
            axes.tick_params(labelbottom=i == len(rows) - 1, labelleft=j == 0)
            if i < len(rows) - 1:
                axes.set_xlabel("")
            if j > 0:
                axes.set_ylabel("")
            if i == 0:
                _head(axes, record, choice)
        figure.text(
            0.24 / total_width, (low + height / 2) / total_height, row.label, rotation=90, ha="center", va="center"
        )
        if row.colors is not None:
            right = LEFT + len(choices) * (width + GAP) - GAP + 0.13
            bar = figure.colorbar(
                ScalarMappable(*row.colors), cax=figure.add_axes(box(right, low + 0.06 * height, 0.11, 0.88 * height))
            )
            bar.set_label(row.unit, fontsize=8.5)
            bar.ax.tick_params(labelsize=8)
            bar.outline.set_linewidth(0.5)  # pyright: ignore[reportCallIssue]
    size = min(12.0, 1.75 * (total_width - 0.3))  # one column is narrow for the title
    figure.text(0.15 / total_width, 1 - 0.24 / total_height, record.title, fontsize=size, weight="bold", va="center")
    if note:
        figure.text(0.15 / total_width, 1 - 0.46 / total_height, note, fontsize=8, color=style.GREY, va="center")
    return figure


def _head(axes: Axes, record: Record, choice: Choice) -> None:
    R, P = record.regularity[choice.index], record.potential[choice.index]
    source, preference = record.origin(choice.index), record.preference[choice.index]
    if np.isfinite(preference):
        source += f", preference {preference:g}"
    if 0 < len(record.objectives) <= NAMED:
        source += f": {record.listed(choice.index)}"
    for text, height, look in (
        (choice.title, 32, {"weight": "bold", "fontsize": 10}),
        (f"R = {R:.4g}   {record.potential_symbol} = {P:.4g}", 19, {}),
        (source, 6, {"color": style.GREY, "fontsize": 8.5}),
    ):
        axes.annotate(
            text,
            (0.5, 1),
            (0, height),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="center",
            va="bottom",
            **look,
        )
