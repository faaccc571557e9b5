"""The panels of a surface in space: centers on the local error, on the residual, and the shape within reach."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_rgb

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.figures import style, surface
from rbfevo.figures.local_error import local_error
from rbfevo.figures.panels import Choice, Colors, Row
from rbfevo.figures.view import View, standpoint, view_of
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import setup

CLAY = "#cfc3b4"
SIDE = 2.7  # inches
EXAGGERATED = (
    0.15  # of the mesh's diagonal: the largest displacement where the true one is unknown or out of proportion
)
ONE_STEP = 0.05  # the same for a sensitivity


def rows(record: Record, choices: list[Choice], opengl: bool, whole: Record | None = None) -> tuple[list[Row], float]:
    """Return the rows of panels for `choices`, by OpenGL or by matplotlib alone, and their height in inches.

    Of one of several objectives, `whole` is the run with all of them, which have one view; shapes are left out.
    """
    unit = "local error [model units]" if record.gradient_norm else "local error (unit norm)"
    first = "initial local error"
    if record.summary.get("gradient_is") == "direction":
        unit, first = "unit norm", "wanted by the sensitivity"
    scale = record.gradient_norm or 1.0
    errors = local_error(record.gradient)
    known = all(choice.reached is not None for choice in choices)
    left = {
        choice.index: local_error(record.gradient - choice.reached) for choice in choices if choice.reached is not None
    }
    factor, remark = stretch(record, errors)
    shapes = {}
    if known and record.gradient.shape[1] == 3 and whole is None:
        shapes = {choice.index: record.vertices + factor * np.asarray(choice.reached) for choice in choices}
    centers = [_with_images(record, choice.index) for choice in choices]
    diagonal = float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    radius = 0.0125 * diagonal * min(1.0, np.sqrt(25 / max(record.centers.shape[1], 1)))
    view = view_of(
        np.concatenate([record.vertices, *centers, *shapes.values()]), 2 * radius, *standpoint(whole or record)
    )
    panel = functools.partial(_panel, record, view, radius, surface.render if opengl else surface.project)

    colors = Colors(Normalize(0.0, scale * float(errors.max())), style.ERROR)
    initial = colors.rgb(scale * errors)
    made = [Row(first, panel(lambda _: initial), colors, unit)]
    if known:
        highest = scale * max(float(error.max()) for error in left.values())
        colors = Colors(Normalize(0.0, highest or 1.0), style.ERROR)
        remaining = {index: colors.rgb(scale * error) for index, error in left.items()}
        made.append(Row("residual of the setup", panel(lambda choice: remaining[choice.index]), colors, unit))
    if shapes:
        clay = np.tile(to_rgb(CLAY), (len(record.vertices), 1))
        made.append(Row(f"shape within reach{remark}", panel(lambda _: clay, shapes)))
    return made, SIDE * view.tall / view.half


def _with_images(record: Record, index: int) -> Array:
    """All centers of a setup: those of a symmetric one on both sides."""
    try:
        return setup(record, index).centers_and_images().points
    except UserError:  # a kernel that is unknown here still has centers to show
        return record.centers[index]


def stretch(record: Record, errors: Array) -> tuple[float, str]:
    """Return the factor from the unit gradient to the displacement shown, and a remark where it is not the true one."""
    largest, diagonal = float(errors.max()), float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    true = record.gradient_norm
    if true is not None and true * largest <= diagonal:
        return true, ""
    exaggerated = EXAGGERATED if record.summary.get("gradient_is") != "direction" else ONE_STEP
    return exaggerated * diagonal / largest, "\n(displacement not to scale)"


def _panel(
    record: Record,
    view: View,
    radius: float,
    paint: Callable[..., None],
    colors: Callable[[Choice], Array],
    shapes: dict[int, Array] | None = None,
) -> Callable[[Axes, Choice], None]:
    def draw(axes: Axes, choice: Choice) -> None:
        vertices = record.vertices if shapes is None else shapes[choice.index]
        centers = _with_images(record, choice.index) if shapes is None else np.empty((0, 3))
        paint(axes, view, vertices, record.faces, colors(choice), centers, radius)
        axes.set_xlim(-view.half, view.half)
        axes.set_ylim(-view.tall, view.tall)
        axes.set_aspect("equal")
        axes.set_axis_off()

    return draw
