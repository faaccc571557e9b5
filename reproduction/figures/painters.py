"""Draws the centers of a setup on the plane or on a surface in space, plain or over values at the vertices."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from rbfevo.arrays import Array
from rbfevo.figures import plane, space, surface
from rbfevo.figures.panels import Choice, Colors
from rbfevo.recorded.record import Record
from reproduction.figures import surfaces

Draw = Callable[[Axes, Choice], None]
GROUND = "#f4f3f0"  # of a plane without values


class Painter(NamedTuple):
    """Draws the setups of a record, selected by a choice's index; `frame` is None on the plane."""

    record: Record
    frame: surfaces.Frame | None
    opengl: bool

    @property
    def ratio(self) -> float:
        """The height of a panel over its width."""
        if self.frame is not None:
            return self.frame.ratio
        width, height = plane.size(self.record)
        return height / width

    def plain(self, axes: Axes, choice: Choice) -> None:
        """Draw the centers of a setup over the uncoloured design."""
        if self.frame is None:
            axes.set_facecolor(GROUND)
            plane.place_centers(axes, self.record, choice)
        else:
            clay = np.tile(to_rgb(space.CLAY), (len(self.record.vertices), 1))
            self._spatial(axes, choice, self.frame, clay, surface.AMBIENT)

    def over(self, values: Callable[[Choice], Array], colors: Colors) -> Draw:
        """Return a function that draws the centers of a setup over values [n] at the vertices."""
        frame = self.frame
        if frame is None:
            return plane.panel(self.record, values, colors)
        return lambda axes, choice: self._spatial(axes, choice, frame, colors.rgb(values(choice)), surfaces.AMBIENT)

    def _spatial(self, axes: Axes, choice: Choice, frame: surfaces.Frame, colors: Array, ambient: float) -> None:
        vertices, faces = self.record.vertices, self.record.faces
        surfaces.show(axes, frame, vertices, faces, colors, self.opengl, ambient)
        surfaces.place_centers(axes, frame, vertices, faces, self.record.centers[choice.index])


def painter(record: Record, opengl: bool) -> Painter:
    """The painter of a record's setups, with one frame for all of them."""
    flat = record.vertices.shape[1] == 2
    frame = None if flat else surfaces.frame_of(np.concatenate([record.vertices, *record.centers]))
    return Painter(record, frame, opengl)
