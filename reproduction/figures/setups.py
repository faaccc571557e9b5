"""Figures 4, 5 and 7: the centers of the best setups and of OLS, a column for each kernel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from rbfevo.figures import style
from rbfevo.figures.local_error import local_error, reached
from rbfevo.figures.panels import Choice, Colors
from rbfevo.scoring.deformation import MANIPULATIONS
from reproduction.figures import exhibits, wording
from reproduction.figures.exhibits import Exhibit
from reproduction.figures.layout import Sheet, blank
from reproduction.figures.painters import Draw, Painter, painter
from reproduction.study import KINDS, Study, panels_of

WIDTH, LEFT, GAP, BAR = 2.5, 0.9, 0.3, 0.95  # inches
KERNEL, HEAD = 0.28, 0.44  # heights of the kernels' names and of two lines over a panel
UNIT = "local error [model units]"
MOST = 0.995  # share of the remaining errors within the scale, which a few vertices would stretch otherwise


class Row(NamedTuple):
    """A row of panels: its label, setups, function that draws them, whether they have headings, and colours if any."""

    label: str
    cells: list[Exhibit | None]
    draw: Draw
    headed: bool
    colors: Colors | None = None
    cut: bool = False  # whether some values lie above the scale


def picture(study: Study, figure: str, caption: str, opengl: bool = True) -> Figure:
    """Draw figure 4, 5 or 7 on the plane, or on the sphere if its name ends in `-face`."""
    shown = exhibits.of_figure(study, figure)
    present = [exhibit for row in shown for exhibit in row if exhibit is not None]
    scenario = "face" if figure.endswith("-face") else "plane"
    with style.typography():
        if not present:
            return _empty(scenario, caption)
        brush = painter(exhibits.record(study, present), opengl)
        rows = _rows(study, shown, present, brush)
        height = WIDTH * brush.ratio
        total = KERNEL + sum(height + HEAD * row.headed for row in rows) + GAP * (len(rows) - 1)
        bars = BAR if any(row.colors is not None for row in rows) else 0.25
        below = 0.5 if scenario == "plane" else 0.1
        sheet = Sheet(LEFT + 3 * (WIDTH + GAP) - GAP + bars, total + below, caption)
        _columns(sheet, scenario)
        top = KERNEL
        for row in rows:
            top += HEAD * row.headed
            sheet.text(0.22, top + height / 2, row.label, rotation=90, ha="center", va="center")
            for j, exhibit in enumerate(row.cells):
                left = LEFT + j * (WIDTH + GAP)
                axes = sheet.axes(left, top, WIDTH, height)
                if exhibit is None:
                    blank(axes, "not there")
                    continue
                row.draw(axes, Choice(present.index(exhibit), "", None))
                _label(axes, first=j == 0, last=row is rows[-1])
                if row.headed:
                    scores, source = _head(study, exhibit)
                    look = {"fontsize": 8.5, "ha": "center", "va": "center"}
                    sheet.text(left + WIDTH / 2, top - 0.3, scores, **look)
                    sheet.text(left + WIDTH / 2, top - 0.14, source, color=style.GREY, **look)
            if row.colors is not None:
                right = LEFT + 3 * (WIDTH + GAP) - GAP + 0.14
                sheet.bar(right, top + 0.04 * height, 0.92 * height, row.colors, UNIT, row.cut)
            top += height + GAP
    return sheet.figure


def _empty(scenario: str, caption: str) -> Figure:
    sheet = Sheet(LEFT + 3 * (WIDTH + GAP), KERNEL + WIDTH / 2 + 0.15, caption)
    _columns(sheet, scenario)
    for j in range(len(KINDS)):
        blank(sheet.axes(LEFT + j * (WIDTH + GAP), KERNEL, WIDTH, WIDTH / 2), "not there")
    return sheet.figure


def _columns(sheet: Sheet, scenario: str) -> None:
    for j, kind in enumerate(KINDS):
        title, middle = wording.kernel(panels_of(scenario, kind)[0]), LEFT + j * (WIDTH + GAP) + WIDTH / 2
        sheet.text(middle, 0.16, title, ha="center", va="center", weight="bold", fontsize=10.5)


def _label(axes: Axes, first: bool, last: bool) -> None:
    """Label the axes of the plane only on the left and at the bottom; in space there are none."""
    if not axes.axison:
        return
    axes.set_xticks((0, 0.5, 1, 1.5, 2))
    axes.set_yticks((0, 0.5, 1))
    axes.tick_params(labelbottom=last, labelleft=first)
    axes.set_xlabel(axes.get_xlabel() if last else "", fontsize=9.5)
    axes.set_ylabel(axes.get_ylabel() if first else "", fontsize=9.5)


def _head(study: Study, exhibit: Exhibit) -> tuple[str, str]:
    """R and P, and the origin of the setup; that of OLS has R for both manipulations instead."""
    R, P = wording.number(exhibit.regularity), wording.number(exhibit.improvement_potential)
    if exhibit.method != "ols":
        ending = "" if exhibit.criterion == "regularity" else f", {exhibit.panel.manipulation}"
        return f"R = {R}   P = {P}", f"{wording.origin(exhibit)}{ending}"
    other = exhibits.greedy(study, exhibit.panel._replace(manipulation="direct"))
    direct = "" if other is None else f", {wording.number(other.regularity)} direct"
    return f"P = {P}", f"R = {R} indirect{direct}"


def _rows(study: Study, shown: list[list[Exhibit | None]], present: list[Exhibit], brush: Painter) -> list[Row]:
    """A row for each manipulation, or the local error before and after."""
    if len(shown) > 1:
        named = zip(MANIPULATIONS, shown, strict=True)
        return [Row(f"{manipulation} manipulation", cells, brush.plain, True) for manipulation, cells in named]
    (cells,) = shown
    gradient, norm = brush.record.gradient, brush.record.gradient_norm or 1.0
    errors = norm * local_error(gradient)
    left = [norm * local_error(gradient - reached(exhibits.record(study, [one]), 0)) for one in present]
    before = Colors(Normalize(0.0, float(errors.max())), style.ERROR)
    after = Colors(Normalize(0.0, float(np.quantile(left, MOST)) or 1.0), style.ERROR)
    return [
        Row("initial local error", cells, brush.over(lambda _: errors, before), True, before),
        Row("what the setup leaves", cells, brush.over(lambda one: left[one.index], after), False, after, True),
    ]
