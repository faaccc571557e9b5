"""Figure 1: the sphere with its centers, its deformation by them, and the target."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from rbfevo.arrays import Array
from rbfevo.figures import style, surface
from rbfevo.fit import Objective, deformation
from rbfevo.geometry import placement
from rbfevo.runs.config import build
from rbfevo.scenarios.face import average_face
from reproduction.figures import exhibits, surfaces, wording
from reproduction.figures.exhibits import Exhibit
from reproduction.figures.layout import Sheet
from reproduction.study import Study

SIDE, GAP, TOP = 2.7, 0.5, 0.55  # inches
TURNS, SMOOTHNESS = 100, 1.0  # of closest points and least squares; weight of the Laplacian's term
SKIN, STAYS = "#d2a98a", "#d4d2cd"  # vertices with and without a counterpart on the target


def picture(study: Study, caption: str, opengl: bool = True) -> Figure:
    """Draw initial mesh, deformed mesh and target side by side, in one view."""
    ((exhibit,),) = exhibits.of_figure(study, "figure1")
    scenario = study.scenario("face")
    vertices, faces = scenario.vertices.numpy(), scenario.faces.numpy()
    nothing = np.empty((0, 3))
    centers, deformed, scores = nothing, None, "no setup there"
    if exhibit is not None:
        centers, deformed = exhibit.centers, fitted(study, exhibit)
        R, P = wording.number(exhibit.regularity), wording.number(exhibit.improvement_potential)
        scores = f"R = {R}   P = {P}"
    scan, triangles = target()
    shapes = [
        ("initial mesh X and centers", f"{len(vertices):,} vertices, {len(centers)} centers", vertices, faces, centers),
        ("deformed mesh X'", scores, deformed, faces, nothing),
        ("target T", "average head, front", scan, triangles, nothing),
    ]
    seen = [points for _, _, points, _, _ in shapes if points is not None]
    frame = surfaces.frame_of(np.concatenate([*seen, centers]))
    height = SIDE * frame.ratio
    still = (scenario.gradient == 0).all(dim=1).numpy()
    sphere = np.where(still[:, None], to_rgb(STAYS), to_rgb(SKIN))
    with style.typography():
        sheet = Sheet(3 * (SIDE + GAP) - GAP + 0.2, TOP + height + 0.1, caption)
        for i, (title, subtitle, points, corners, dots) in enumerate(shapes):
            left = 0.1 + i * (SIDE + GAP)
            sheet.text(left + SIDE / 2, 0.2, title, ha="center", va="center", weight="bold", fontsize=10.5)
            sheet.text(left + SIDE / 2, 0.41, subtitle, ha="center", va="center", color=style.GREY, fontsize=9)
            axes = sheet.axes(left, TOP, SIDE, height)
            axes.set_axis_off()
            if points is not None:
                colors = np.tile(to_rgb(SKIN), (len(points), 1)) if points is scan else sphere
                surfaces.show(axes, frame, points, corners, colors, opengl, surface.AMBIENT)
                surfaces.place_centers(axes, frame, points, corners, dots)
        if exhibit is not None:
            _arrow(sheet.axes(0.1 + SIDE + 0.05, TOP + height / 2 - 0.2, GAP - 0.1, 0.4))
    return sheet.figure


def fitted(study: Study, exhibit: Exhibit) -> Array:
    """The sphere [n, 3] fitted to the scan by the setup's centers: closest points and least squares in turn."""
    scenario = study.scenario("face")
    kernel = build(exhibit.panel.settings("method=lloyd").kernel, 3, scenario.support)
    found = deformation(scenario, kernel, torch.from_numpy(exhibit.centers), "orthogonalized")
    objective = Objective(scenario, [found.U], SMOOTHNESS)
    (coordinates,) = objective.optimum(limit=TURNS).coordinates
    parameters = torch.linalg.solve_triangular(objective.T[0], coordinates, upper=True)
    return (scenario.vertices + found.U @ parameters).numpy()


def target() -> tuple[Array, Array]:
    """The built-in scan as the face scenario places it: vertices [n, 3] in the box [-1,1]^3 and triangles [f, 3]."""
    vertices, triangles = average_face()
    vertices, merged = placement.merge_coincident(placement.turn(vertices, "z", "y"), triangles)
    return placement.fit_box(vertices)[0], triangles if merged is None else merged


def _arrow(axes: Axes) -> None:
    axes.set_axis_off()
    look = {"arrowstyle": "-|>", "color": style.INK, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (1, 0.3), (0, 0.3), xycoords="axes fraction", arrowprops=look)
    axes.text(0.5, 0.45, "u(x)", transform=axes.transAxes, ha="center", va="bottom", style="italic", fontsize=10)
