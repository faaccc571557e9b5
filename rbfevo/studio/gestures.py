"""What a pointer does: a stroke of the brush, or a pull at a control point, of one window at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rbfevo.geometry.mirror import Mirror
from rbfevo.studio.brush import Brush
from rbfevo.studio.painting import Painting
from rbfevo.studio.picking import Camera, Surface
from rbfevo.studio.pulling import Chosen, Grip

IDLE = 10.0  # seconds without an event, after which another window may take over


class Canvas(NamedTuple):
    """What a pointer works on.

    Attributes:
        painting, chosen: the mesh and the setup; pulling: whether control points are pulled, and nothing is painted.
        brush: what paints; mirror: the plane in which strokes are mirrored, or None.
    """

    painting: Painting
    chosen: Chosen
    pulling: bool
    brush: Brush
    mirror: Mirror | None


class Gestures:
    """The strokes and pulls of all windows.

    Args:
        surface: that rays hit; canvas: returns what a pointer works on now.
        ended: is called after a gesture: True if something was painted, False if something was pulled.
    """

    def __init__(self, surface: Surface, canvas: Callable[[], Canvas], ended: Callable[[bool], None]) -> None:
        self._surface, self._canvas, self._ended = surface, canvas, ended
        self._owner: tuple[str, float] | None = None  # the window with a gesture, and when it was last heard
        self._camera: Camera | None = None
        self._grip: Grip | None = None

    @property
    def held(self) -> int | None:
        """The control point that is pulled now, or None."""
        return None if self._grip is None else self._grip.center

    def press(self, window: str, camera: Any, x: float, y: float, aspect: float) -> bool:
        """A pointer goes down; return whether it paints or pulls, and does not turn the view.

        Raises:
            UserError: for a camera or a brush that is none.
        """
        now = time.monotonic()
        if self._owner is not None and self._owner[0] != window and now - self._owner[1] < IDLE:
            return False
        self.end()
        seen, canvas = Camera.of(camera, aspect), self._canvas()
        if canvas.pulling:
            self._grip = canvas.chosen.grip(seen, x, y)
            if self._grip is None:
                return False
        else:
            spot = self._surface.hit(*seen.ray(x, y))
            if spot is None:
                return False
            canvas.painting.begin(canvas.brush)
            canvas.painting.touch(spot, canvas.mirror)
        self._owner, self._camera = (window, now), seen
        return True

    def drag(self, window: str, places: Sequence[Sequence[float]]) -> bool:
        """The pointer of a gesture has moved along these places; return whether there is such a gesture."""
        if self._owner is None or self._owner[0] != window or self._camera is None:
            return False
        self._owner, canvas = (window, time.monotonic()), self._canvas()
        if self._grip is not None:
            canvas.chosen.drag(self._grip, *places[-1])
        else:
            for x, y in places:
                canvas.painting.touch(self._surface.hit(*self._camera.ray(x, y)), canvas.mirror)
        return True

    def release(self, window: str) -> bool:
        """The pointer of a gesture goes up; return whether there was such a gesture."""
        if self._owner is None or self._owner[0] != window:
            return False
        self.end()
        return True

    def end(self) -> None:
        """End the gesture that is going on, if any."""
        pulled, self._grip, self._owner = self._grip is not None, None, None
        if pulled:
            self._ended(False)
        elif self._canvas().painting.end():
            self._ended(True)
