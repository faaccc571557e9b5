"""The panels of a plane scenario: centers over the height field, the local error, and the residual."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.tri import Triangulation

from rbfevo.arrays import Array
from rbfevo.figures import style
from rbfevo.figures.local_error import local_error
from rbfevo.figures.panels import Choice, Colors, Row
from rbfevo.recorded.record import Record

RELIEF = LinearSegmentedColormap.from_list("relief", ["#ffffff", "#e3e3e1", "#a9a9a6"])


def size(record: Record) -> tuple[float, float]:
    """Return width and height of a panel in inches: equal aspect, the longer side of the box lying."""
    wide, high = sorted(record.upper - record.lower, reverse=True)
    width = float(min(3.3, np.sqrt(5.0 * wide / high)))
    return width, width * float(high / wide)


def rows(record: Record, choices: list[Choice]) -> list[Row]:
    """Return the rows of panels for `choices`; displacements in model units where the run recorded their norm."""
    scale = record.gradient_norm or 1.0
    unit = "[model units]" if record.gradient_norm else "(unit norm)"
    wanted = record.gradient * scale
    errors = local_error(wanted)
    made = []
    if wanted.shape[1] == 1:
        low, high = float(wanted.min()), float(wanted.max())
        colors = Colors(Normalize(low, high if high > low else low + 1.0), RELIEF)
        draw = panel(record, lambda _: wanted[:, 0], colors, contours=True)
        made.append(Row("target\nheight field", draw, colors, f"height {unit}"))
    colors = Colors(Normalize(0.0, float(errors.max())), style.ERROR)
    made.append(Row("initial\nlocal error", panel(record, lambda _: errors, colors), colors, f"local error {unit}"))
    if all(choice.reached is not None for choice in choices):
        left = {choice.index: local_error(wanted - scale * np.asarray(choice.reached)) for choice in choices}
        colors = Colors(Normalize(0.0, max(float(error.max()) for error in left.values()) or 1.0), style.ERROR)
        draw = panel(record, lambda choice: left[choice.index], colors)
        made.append(Row("residual of\nthe setup", draw, colors, f"local error {unit}"))
    return made


def panel(
    record: Record, values: Callable[[Choice], Array], colors: Colors, contours: bool = False
) -> Callable[[Axes, Choice], None]:
    """Return what draws the centers of a choice over values [n] of the vertices."""
    points = record.vertices[:, _order(record)]

    def draw(axes: Axes, choice: Choice) -> None:
        value = values(choice)
        if len(record.faces):
            mesh = Triangulation(*points.T, triangles=record.faces)
            axes.tripcolor(mesh, value, cmap=colors.cmap, norm=colors.norm, shading="gouraud", rasterized=True)
            if contours and np.ptp(value) > 0:
                levels = np.linspace(value.min(), value.max(), 8)[1:-1]
                axes.tricontour(mesh, value, levels=levels, colors=style.GREY, linewidths=0.35, alpha=0.6)
        else:
            axes.scatter(*points.T, c=value, cmap=colors.cmap, norm=colors.norm, s=4, linewidths=0)
        place_centers(axes, record, choice)

    return draw


def place_centers(axes: Axes, record: Record, choice: Choice) -> None:
    """Draw the centers of a setup, and the box around them, the longer side lying."""
    order = _order(record)
    names = np.array(["x", "y"])[order]
    centers = record.centers[choice.index][:, order]
    dot = float(np.clip(30 * np.sqrt(25 / max(len(centers), 1)), 4, 40))
    colors = [style.KEPT if j < record.kept else style.RED for j in range(len(centers))]
    axes.scatter(*centers.T, s=dot, c=colors, edgecolor="white", linewidth=0.6, zorder=3, clip_on=False)
    axes.set_xlim(record.lower[order[0]], record.upper[order[0]])
    axes.set_ylim(record.lower[order[1]], record.upper[order[1]])
    axes.set_aspect("equal")
    axes.locator_params(nbins=4)
    axes.tick_params(labelsize=8, length=2.5)
    axes.set_xlabel(names[0], labelpad=1)
    axes.set_ylabel(names[1], labelpad=2)


def _order(record: Record) -> list[int]:
    extent = record.upper - record.lower
    return [1, 0] if extent[1] > extent[0] else [0, 1]
