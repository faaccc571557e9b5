"""The page: its variables, and the two views in it that trame makes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfevo.recorded.record import Record
from rbfevo.scenarios.templates import Template
from rbfevo.studio import frontier
from rbfevo.studio.brush import DIRECTIONS
from rbfevo.studio.choices import KERNELS, LENGTHS, Choices
from rbfevo.studio.keeping import State

if TYPE_CHECKING:
    from trame_server import Server

PAGE = Path(__file__).parent / "page"
REPORT = Path(__file__).parents[1] / "figures" / "report" / "page"
ACTIONS = [
    ["pull", "pull out"],
    ["push", "push in"],
    ["erase", "erase"],
    ["hold", "must stay"],
    ["release", "may move"],
]
BRUSH = {"action": "pull", "radius": 8.0, "strength": 2.0, "edge": 100, "direction": "normal"}
SEARCHED = ("kernel", "kernel_radius", "manipulation", "centers", "symmetry")
HINTS = {
    "paint": "Drag on the surface to paint where it should move.",
    "pull": "Drag a control point to pull it.",
}


def variables(state: State, template: Template | None, directory: Path) -> dict[str, Any]:
    """The variables of the page for a state.

    Args:
        template: of a mesh that can be deformed, with its point arrays, or None; directory: to save into at first.
    """
    diagonal = float(np.linalg.norm(np.ptp(state.vertices, axis=0)))
    return {
        "title": Path(state.source).name,
        "mode": "paint",
        "hint": HINTS["paint"],
        "actions": ACTIONS,
        "directions": list(DIRECTIONS),
        "kernels": list(KERNELS),
        "starts": starts_of(template),
        "start": "",
        "target": "",
        "offer": "",
        "problem": "",
        "announcement": "",
        "diagonal": f"{diagonal:.4g}",
        "kernel_length": "",
        "found": False,
        "busy": False,
        "progress": 0.0,
        "facts": [],
        "searching": "Nothing is painted yet.",
        "pulled": False,
        "writing": False,
        "written": "",
        "commands": [],
        "directory": str(directory),
        "appliable": template is not None,
        "painted": False,
        "undoable": False,
        "redoable": False,
        **of_state(state),
    }


def of_state(state: State) -> dict[str, Any]:
    """What a state has chosen, as the page shows it."""
    return {**BRUSH, **state.brush, **of_choices(state.choices), "share": round(100 * state.share)}


def of_choices(choices: Choices) -> dict[str, Any]:
    """What is searched, as the page shows it."""
    radius = "" if choices.radius is None else f"{choices.radius:.6g}"
    found = {"kernel": choices.kernel, "kernel_radius": radius, "manipulation": choices.manipulation}
    found |= {"centers": choices.centers, "symmetry": choices.symmetry or ""}
    lengths = {"support": "Support radius", "scale": "Scale"}
    return {**found, "length": lengths.get(LENGTHS.get(choices.kernel, ""), "")}


def kernel_length(record: Record) -> str:
    """The support radius or scale that a search has used, or nothing of a kernel that has none."""
    numbers = record.summary["representation"].get("kernel", {})
    found = [numbers[key] for key in set(LENGTHS.values()) if key in numbers]
    return f"{found[0]:.4g}" if found else ""


def starts_of(template: Template | None) -> list[str]:
    """The point arrays of a template that can be a wanted displacement."""
    arrays = {} if template is None else template.arrays
    return sorted(name for name, values in arrays.items() if values.ndim == 1 or values.shape[1:] in ((1,), (3,)))


def lay_out(server: Server, window: Any, clicked: Callable[[int, int], Any]) -> tuple[Any, Any]:
    """Make the page of a server; return its view of a VTK window, and its plot of the front.

    Args:
        clicked: takes the number of a curve of the plot, and that of a point of it.
    """
    from trame.ui.html import DivLayout
    from trame.widgets import plotly, vtk

    serve = {"rbfevo_studio": str(PAGE), "rbfevo_report": str(REPORT)}
    styles = ["rbfevo_report/page.css", "rbfevo_studio/studio.css"]
    server.enable_module({"serve": serve, "styles": styles, "scripts": ["rbfevo_studio/studio.js"]})
    server.state.trame__title = f"rbfevo studio: {server.state.title}"
    with DivLayout(server) as layout:
        layout.root.style = "height: 100%"
        view = vtk.VtkLocalView(window, ref="view")
        plot = plotly.Figure(
            frontier.figure(None, None, None),
            state_variable_name="front",
            display_mode_bar=("false",),
            click=(clicked, "[$event.points[0].curveNumber, $event.points[0].pointNumber]"),
        )
        views = str(view.html), str(plot.html)
        layout.root.clear()
        html = (PAGE / "studio.html").read_text(encoding="utf-8")
        layout.root.add_child(html.replace("$VIEW", views[0]).replace("$PLOT", views[1]))
    return view, plot
