"""Figure 2: a uniform setup on the initial plane, and the test function to which the plane is fitted."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from matplotlib.colors import LightSource
from matplotlib.figure import Figure

from rbfevo.arrays import Array
from rbfevo.figures import style
from rbfevo.scenarios.plane import height_field
from reproduction.figures.layout import Sheet

WIDTH, HEIGHT, TOP = 3.9, 3.05, 0.3  # inches
COUNT = 5  # centers along each side
GRID = 20, 40  # lines of the plane's drawn mesh
FINE = 60, 120  # and of the height field's
ELEVATION, AZIMUTH = 34, 128  # degrees; the bump before the ramp
PLANE = "#e9ecf1"


def picture(caption: str) -> Figure:
    """Draw the plane with its centers and the height field side by side, in the same view."""
    with style.typography():
        sheet = Sheet(2 * WIDTH + 0.4, TOP + HEIGHT + 0.1, caption)
        for i, (title, draw) in enumerate((("uniform setup", _setup), ("test function", _target))):
            left = 0.1 + i * (WIDTH + 0.1)
            axes: Any = sheet.axes(left - 0.6, TOP - 0.35, WIDTH + 1.0, HEIGHT + 0.5, projection="3d")
            axes.computed_zorder = False
            axes.patch.set_visible(False)
            draw(axes)
            _frame(axes)
            sheet.text(left + WIDTH / 2, 0.2, title, ha="center", va="center", weight="bold", fontsize=10.5)
    return sheet.figure


def _setup(axes: Any) -> None:
    x, y = np.meshgrid(np.linspace(0, 1, GRID[0] + 1), np.linspace(0, 2, GRID[1] + 1))
    every = {"rcount": GRID[1] + 1, "ccount": GRID[0] + 1}
    axes.plot_surface(x, y, 0 * x, color=PLANE, shade=False, edgecolor="#b9c0cc", linewidth=0.3, zorder=1, **every)
    steps = (np.arange(COUNT) + 0.5) / COUNT
    centers = np.array(list(itertools.product(steps, 2 * steps)))
    look = {"s": 34, "color": style.RED, "edgecolor": "white", "linewidth": 0.6, "depthshade": False, "zorder": 5}
    axes.scatter(*centers.T, 0, **look)


def _target(axes: Any) -> None:
    x, y = np.meshgrid(np.linspace(0, 1, FINE[0] + 1), np.linspace(0, 2, FINE[1] + 1))
    points = torch.from_numpy(np.stack([x.ravel(), y.ravel()], axis=1))
    heights = height_field(points).numpy().reshape(x.shape)
    every = {"rcount": FINE[1] + 1, "ccount": FINE[0] + 1}
    surface = axes.plot_surface(x, y, heights, facecolors=_shaded(heights), shade=False, zorder=1, **every)
    surface.set_edgecolor((1, 1, 1, 0.28))
    surface.set_linewidth(0.25)


def _shaded(heights: Array) -> Array:
    """Colours of the mesh's quads, blue to yellow by their mean height, a little darker away from the light."""
    mean = (heights[1:, 1:] + heights[:-1, 1:] + heights[1:, :-1] + heights[:-1, :-1]) / 4
    light = LightSource(azdeg=250, altdeg=55).hillshade(mean, dx=1 / FINE[0], dy=1 / FINE[0], vert_exag=0.4)
    colors = np.asarray(style.ERROR(mean))
    colors[..., :3] *= (0.72 + 0.28 * light)[..., None]
    return colors


def _frame(axes: Any) -> None:
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 2)
    axes.set_zlim(0, 1)
    axes.set_box_aspect((1, 2, 0.7), zoom=1.05)
    axes.view_init(ELEVATION, AZIMUTH)
    for name, axis, ticks in (
        ("x", axes.xaxis, (0.5, 1)),
        ("y", axes.yaxis, (0, 0.5, 1, 1.5, 2)),
        ("height", axes.zaxis, (0, 0.5, 1)),
    ):
        axis.set_ticks(ticks)
        axis.set_tick_params(labelsize=8, pad=-1)
        axis.set_pane_color((1, 1, 1, 0))
        axis.set_label_text(name, fontsize=9)
        axis.labelpad = -2
        axis._axinfo["grid"].update(color=style.PALE, linewidth=0.5)
