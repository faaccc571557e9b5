"""The setup that is shown: which of the front it is, how far it goes, and where its control points were pulled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Points
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, knee
from rbfevo.recorded.setup import setup
from rbfevo.studio.picking import Camera
from rbfevo.studio.shape import Pulls, Shape

NEAR = 0.03  # of the height of the view: a control point that close to the pointer is meant


class Grip(NamedTuple):
    """A control point that is held by a pointer: which one, where it was, and what was pulled before."""

    center: int
    place: Array
    camera: Camera
    moved: Array


class Chosen:
    """A setup of a front, and what a designer does with it.

    Attributes:
        record: the front; row: of the setup; pulls: how far it goes.
    """

    def __init__(self, share: float = 1.0) -> None:
        self.record: Record | None = None
        self.row: int | None = None
        self.pulls = Pulls(share, np.empty((0, 3)))
        self._size = 0.0
        self._shape: Shape | None = None

    @property
    def touched(self) -> bool:
        """Whether a control point was pulled."""
        return bool(self.pulls.moved.any())

    @property
    def centers(self) -> Points | None:
        """The setup [m, 3], or None."""
        return None if self.record is None or self.row is None else self.record.centers[self.row]

    @property
    def knee(self) -> int | None:
        """The row of the knee of the front."""
        return None if self.record is None else knee(self.record)

    @property
    def shape(self) -> Shape | None:
        """Its deformed shapes."""
        if self._shape is None and self.record is not None and self.row is not None:
            self._shape = Shape(self.record, setup(self.record, self.row), self._size)
        return self._shape

    def take(self, record: Record, size: float, at: Points | None = None) -> None:
        """Take a new front, and of it the setup that is closest in both scores to the one that was shown.

        Args:
            record: of it; size: the norm of the painted field; at: [m, 3] a setup to show if the front has it.
        """
        before = None if self.record is None or self.row is None else self._scores(self.record)[self.row]
        kept = self.centers if at is None else at
        self.record, self._size, self._shape = record, size, None
        same = () if kept is None or kept.shape != record.centers.shape[1:] else (record.centers == kept).all((1, 2))
        if np.any(same):
            self.row = int(np.flatnonzero(same)[0])
        elif before is not None:
            self.row = int(np.linalg.norm(self._scores(record) - before, axis=1).argmin())
        else:
            self.row = self.knee
        if not np.any(same) or self.pulls.moved.shape != record.centers.shape[1:]:
            self.pulls = self.pulls._replace(moved=np.zeros(record.centers.shape[1:]))

    @staticmethod
    def _scores(record: Record) -> Array:
        return np.column_stack([record.regularity, record.potential])

    def choose(self, row: int) -> None:
        """Show another setup of the front."""
        if self.record is None or not 0 <= row < len(self.record.regularity):
            return
        if row != self.row:
            self.row, self._shape = row, None
            self.pulls = self.pulls._replace(moved=np.zeros(self.record.centers.shape[1:]))

    def go(self, where: str) -> None:
        """Walk along the front to the `left` or `right`, or to a pick such as `knee`."""
        if self.record is None:
            return
        if where in ("left", "right"):
            step = 1 if where == "right" else -1
            self.choose(min(max((self.row or 0) + step, 0), len(self.record.regularity) - 1))
        else:
            self.choose(pick(self.record, where))

    def places(self) -> tuple[Points, Array]:
        """Where its control points [q, 3] are now, images last, and which of them are images."""
        shape = self.shape
        if shape is None:
            return np.empty((0, 3)), np.empty(0, bool)
        now = shape.points(self.pulls)[1]
        return now, np.arange(len(now)) >= len(self.pulls.moved)

    def unmoved(self) -> tuple[Points, Array]:
        """Where its control points [q, 3] are in the mesh as it is, images last, and which of them are images."""
        if self.shape is None:
            return np.empty((0, 3)), np.empty(0, bool)
        found = self.shape.chosen.centers_and_images()
        return found.points, found.mirrored

    def grip(self, camera: Camera, x: float, y: float) -> Grip | None:
        """The control point under the pointer, the nearest to the camera of those, or None."""
        now, images = self.places()
        own = now[~images]
        if not len(own):
            return None
        away = (camera.places(own) - (x, y)) * (camera.aspect, 1.0)
        near = np.flatnonzero(np.linalg.norm(np.nan_to_num(away, nan=np.inf), axis=1) < NEAR)
        if not len(near):
            return None
        center = int(near[((own[near] - camera.position) @ camera.axes[2]).argmin()])
        return Grip(center, own[center], camera, self.pulls.moved.copy())

    def drag(self, grip: Grip, x: float, y: float) -> None:
        """Pull the control point to where the pointer is, at its depth."""
        shape = self.shape
        if shape is None or grip.moved.shape != self.pulls.moved.shape:
            return
        moved = grip.moved.copy()
        moved[grip.center] += shape.allowed(grip.center, grip.camera.dragged(grip.place, x, y) - grip.place)
        self.pulls = self.pulls._replace(moved=moved)

    def let_go(self) -> None:
        """Put all control points back to where they were before they were pulled."""
        self.pulls = self.pulls._replace(moved=np.zeros_like(self.pulls.moved))

    def go_far(self, share: float) -> None:
        """Go this share of the way of the best approximation of what is painted."""
        self.pulls = self.pulls._replace(share=share)
