"""fit.png: the design at the start, its target, the fit with its residual, and the error by generation."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from rbfevo.arrays import Array
from rbfevo.figures import style, surface
from rbfevo.figures.panels import Colors
from rbfevo.figures.space import CLAY
from rbfevo.figures.view import FRONT, UP, view_of
from rbfevo.recorded.record import FitRecord

SIDE, CURVE = 2.4, 1.9  # inches: a panel's side, the curve's height
LEFT, RIGHT, GAP, TOP, BOTTOM = 0.8, 0.85, 0.12, 0.95, 0.55
ABOVE, HEIGHTS_UP = np.array([-1.0, 0.5, 0.95]), np.array([0.0, 0.0, 1.0])  # a height field is seen from one side


def picture(record: FitRecord, *, opengl: bool = True) -> Figure:
    """Draw a fit: four renderings at one scale, and the error of the strategy's mean by generation.

    Args:
        record: the fit.
        opengl: whether renderings may use OpenGL; without it matplotlib draws them.
    """
    run, summary = record.run, record.summary
    flat = run.vertices.shape[1] == 2
    start = _lifted(run.vertices)
    wanted = (run.gradient_norm or 1.0) * run.gradient
    target = start + (np.pad(wanted, ((0, 0), (2, 0))) if wanted.shape[1] == 1 else _lifted(wanted))
    centers = _lifted(record.centers)
    diagonal = float(np.linalg.norm(np.ptp(start, axis=0)))
    radius = 0.0125 * diagonal * min(1.0, np.sqrt(25 / len(centers)))
    shown = np.concatenate([start, target, record.deformed, centers, record.moved_centers])
    view = view_of(shown, 2 * radius, *((ABOVE, HEIGHTS_UP) if flat else (FRONT, UP)))
    across, upward = np.ptp(view.project(shown)[0], axis=0) / 2 + 2 * radius
    high = SIDE * float(upward / across) if upward < across else SIDE  # a panel is no higher than its contents
    colors = Colors(Normalize(0.0, float(record.local_error.max()) or 1.0), style.ERROR)
    clay = np.tile(to_rgb(CLAY), (len(start), 1))
    none = np.empty((0, 3))
    panels = [
        ("start and centers", start, clay, centers),
        ("target height field" if flat else "wanted shape", target, clay, none),
        ("fit", record.deformed, clay, none),
        ("local error and centers", record.deformed, colors.rgb(record.local_error), record.moved_centers),
    ]
    width = LEFT + len(panels) * (SIDE + GAP) - GAP + RIGHT
    height = TOP + high + 0.4 + CURVE + BOTTOM
    with style.typography():
        figure = Figure(figsize=(width, height))

        def place(left: float, low: float, wide: float, tall: float) -> Axes:
            return figure.add_axes((left / width, low / height, wide / width, tall / height))

        low = height - TOP - high
        for i, (title, vertices, painted, balls) in enumerate(panels):
            axes = place(LEFT + i * (SIDE + GAP), low, SIDE, high)
            axes.set_title(title, fontsize=10, weight="bold", pad=5)
            axes.set_xlim(-across, across)
            axes.set_ylim(-across * high / SIDE, across * high / SIDE)
            if upward > across:
                axes.set_xlim(-upward, upward)
                axes.set_ylim(-upward, upward)
            axes.set_axis_off()
            paint = surface.render if opengl else surface.project
            limits = axes.get_xlim(), axes.get_ylim()
            paint(axes, view, vertices, run.faces, painted, balls, radius)
            axes.set_xlim(limits[0])
            axes.set_ylim(limits[1])
            axes.set_aspect("equal")
        bar = figure.colorbar(
            ScalarMappable(*colors), cax=place(width - RIGHT + 0.1, low + 0.08 * high, 0.11, 0.84 * high)
        )
        bar.set_label("local error [model units]", fontsize=8.5)
        bar.ax.tick_params(labelsize=8)
        bar.outline.set_linewidth(0.5)  # pyright: ignore[reportCallIssue]
        _curve(place(LEFT, BOTTOM, width - LEFT - RIGHT, CURVE), record)
        left = 0.15 / width
        figure.text(left, 1 - 0.24 / height, _title(record), fontsize=12, weight="bold", va="center")
        line = f"{summary['pick']} (row {summary['row']}, {summary['method']})   R = {summary['regularity']:.4g}   "
        line += f"P = {summary['improvement_potential']:.4g} · {summary['strategy']} strategy, seed {summary['seed']}"
        figure.text(left, 1 - 0.48 / height, line, color=style.GREY, va="center")
    return figure


def _curve(axes: Axes, record: FitRecord) -> None:
    """The error by generation on a logarithmic axis, the optimum and the goal."""
    summary = record.summary
    generations = np.arange(len(record.errors))
    goal = (1 + summary["within"]) * summary["optimum"]
    axes.semilogy(generations, record.errors, color=style.BLUE, linewidth=1.6, label="error of the strategy's mean")
    label = f"{100 * summary['within']:.3g}% above the optimum"
    if summary["reached"]:
        label += f": reached in {summary['generations']:,} generations, {summary['evaluations']:,} evaluations"
    else:
        label += f": not reached in {summary['generations']:,} generations"
        label += f", {summary['stop_reason']}" if summary["stop_reason"] != "generations" else ""
    axes.axhline(goal, color=style.ORANGE, linewidth=1.0, linestyle=(0, (5, 2)), label=label)
    axes.axhline(summary["optimum"], color=style.INK, linewidth=1.0, label=f"optimum {summary['optimum']:.4g}")
    end = max(len(record.errors) - 1, 1)
    axes.set_xlim(0, 1.02 * end)
    if summary["reached"]:
        axes.plot(end, record.errors[-1], "o", color=style.BLUE, markersize=6, markeredgecolor="white", clip_on=False)
    axes.legend(loc="upper right", fontsize=9)
    positive = [value for value in (*record.errors, summary["optimum"]) if value > 0]
    low, high = min(positive), max(positive)
    span = max(np.log10(high / low), 0.3)
    axes.set_ylim(low / 10 ** (0.2 * span), high * 10 ** (0.08 * span))
    axes.yaxis.set_major_formatter("{x:g}")
    if span < 2:
        axes.yaxis.set_minor_locator(LogLocator(subs=(2, 3, 5)))
        axes.yaxis.set_minor_formatter("{x:g}")
    else:
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("generation")
    axes.set_ylabel("error")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=style.PALE, linewidth=0.5, alpha=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8.5, which="both")


def _title(record: FitRecord) -> str:
    before, now = record.run.summary.get("manipulation"), record.summary["manipulation"]
    return record.run.title.replace(f"{before} manipulation", f"{now} manipulation")


def _lifted(points: Array) -> Array:
    """Points [q, 2 or 3] as [q, 3]."""
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
