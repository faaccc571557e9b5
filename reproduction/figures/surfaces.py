"""A surface in space and the centers of a setup: filled marks in front of it, rings inside or behind."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from rbfevo.arrays import Array
from rbfevo.figures import style, surface
from rbfevo.figures.view import View, hidden, view_of

AMBIENT = 0.8  # share of ambient light on surfaces whose colours are values
MARGIN = 0.05  # around what is shown, model units
DOT = 30.0  # area of a center's mark, points squared
DEPTH = 0.35  # share by which a mark's area grows and shrinks with its depth


class Frame(NamedTuple):
    """The view of a figure's panels, and the visible part of its picture."""

    view: View
    low: Array
    high: Array

    @property
    def ratio(self) -> float:
        """Height over width."""
        width, height = self.high - self.low
        return float(height / width)


def frame_of(points: Array) -> Frame:
    """The frame that contains all points [q, 3]."""
    view = view_of(points, MARGIN)
    places = view.project(points)[0]
    return Frame(view, places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN)


def show(axes: Axes, frame: Frame, vertices: Array, faces: Array, colors: Array, opengl: bool, ambient: float) -> None:
    """Show a surface with colours [n, 3]; the larger `ambient`, the less shading changes them."""
    axes.set_axis_off()
    paint = surface.render if opengl else surface.project
    paint(axes, frame.view, vertices, faces, colors, np.empty((0, 3)), 0.0, ambient)
    axes.set_xlim(frame.low[0], frame.high[0])
    axes.set_ylim(frame.low[1], frame.high[1])
    axes.set_aspect("equal")


def place_centers(axes: Axes, frame: Frame, vertices: Array, faces: Array, centers: Array) -> None:
    """Mark the centers [m, 3] of a setup over its surface, the far ones smaller."""
    behind = hidden(centers, vertices, faces, frame.view)
    places, near = frame.view.project(centers)
    sizes = DOT * (1 + DEPTH * near / frame.view.half)
    rings = {"facecolor": "none", "zorder": 3, "clip_on": False}
    axes.scatter(*places[behind].T, s=sizes[behind], edgecolor="white", linewidth=2.2, **rings)
    axes.scatter(*places[behind].T, s=sizes[behind], edgecolor=style.RED, linewidth=1.2, **rings)
    dots = {"facecolor": style.RED, "edgecolor": "white", "linewidth": 0.6, "zorder": 4, "clip_on": False}
    axes.scatter(*places[~behind].T, s=1.25 * sizes[~behind], **dots)
