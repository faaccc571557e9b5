"""Before and after a step: `python examples/openfoam/picture.py OUT/case OUT/export-S OUT/step-S PICTURE.png`.

Left: the design patch, coloured by how strongly each vertex wants to move (its sensitivity after smoothing), and the
control points with the ways they go. Right: the patch as it moved, coloured by how far. Other walls are grey. Both
halves of the model are drawn; displacements are drawn larger than they are, by the factor that is printed.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv

from rbfevo.meshes.mesh import Mesh
from rbfevo.meshes.openfoam import case_of, read_case

SHOWN = 0.06  # the largest displacement in the picture, in diagonals of the design
THIN = pv.Arrow(tip_length=0.25, tip_radius=0.07, shaft_radius=0.025)
PLANE = (0.0, 1.0, 0.0)
AWAY = np.array([-0.45, -1.9, 0.75])  # the camera from the middle of the design, in its diagonals


def main(case: Path, export: Path, step: Path, out: Path) -> None:
    """Draw both into one picture."""
    before, after = mesh_of(case), mesh_of(step / "0")
    displacement = after.points - before.points
    template: Any = pv.read(export / "template.vtp")
    centers: Any = pv.read(export / "centers.vtp")
    strength = np.linalg.norm(template["wanted"], axis=1)
    template["wanted, of the largest\n"] = strength / strength.max()
    design = patch_of(before, set(before.patches), np.asarray(template.points))
    length = np.linalg.norm(displacement, axis=1)
    diagonal = float(np.linalg.norm(np.ptp(template.points, axis=0)))
    factor = float(f"{SHOWN * diagonal / length.max():.1g}")
    moved = surface(before, [design], before.points + factor * displacement)
    moved["displacement\n"] = length[moved["point"]]
    at = float(surface(before, ["symmetry"], before.points).points[0, 1])
    middle = (template.points.min(axis=0) + template.points.max(axis=0)) / 2
    middle[1] = at
    others = [name for name, kind in before.patch_types.items() if kind == "wall" and name != design]
    walls = surface(before, others, before.points) if others else None
    plotter: Any = pv.Plotter(shape=(1, 2), off_screen=True, window_size=[1800, 700], border=False)
    bars = {"n_labels": 3, "fmt": "%.2g", "height": 0.09, "width": 0.5, "position_x": 0.25, "position_y": 0.02}
    bars |= {"title_font_size": 22, "label_font_size": 18}
    panels = ((template, "wanted, of the largest\n", "viridis"), (moved, "displacement\n", "magma_r"))
    for column, (part, name, colors) in enumerate(panels):
        plotter.subplot(0, column)
        see_through = 0.55 if column == 0 else 1.0
        for half in (part, part.reflect(PLANE, point=(0.0, at, 0.0))):
            plotter.add_mesh(half, scalars=name, cmap=colors, scalar_bar_args=bars, opacity=see_through)
        for half in [] if walls is None else [walls, walls.reflect(PLANE, point=(0.0, at, 0.0))]:
            plotter.add_mesh(half, color="#c8c8c8", opacity=see_through)
        if column == 0:
            balls = centers.glyph(geom=pv.Sphere(radius=0.012 * diagonal), scale=False, orient=False)
            plotter.add_mesh(balls, color="#d7301f")
            arrows = centers.glyph(orient="displacement", scale="displacement", factor=factor, geom=THIN)
            plotter.add_mesh(arrows, color="black")
        plotter.camera_position = [tuple(middle + diagonal * AWAY), tuple(middle), (0.0, 0.0, 1.0)]
    plotter.background_color = pv.Color("white")
    out.parent.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(out)
    print(f"{out}: displacements {factor:g} times as long as they are")


def mesh_of(path: Path) -> Mesh:
    """The mesh of a case, or of a time of it."""
    case = case_of(path)
    if case is None:
        raise SystemExit(f"{path} is no case")
    return read_case(case)


def patch_of(mesh: Mesh, names: set[str], points: np.ndarray) -> str:
    """The patch that has these points."""
    wanted = {tuple(point) for point in points.tolist()}
    for name in sorted(names):
        if {tuple(point) for point in np.asarray(surface(mesh, [name], mesh.points).points).tolist()} == wanted:
            return name
    raise SystemExit("no patch has the points of template.vtp")


def surface(mesh: Mesh, names: list[str], points: np.ndarray) -> Any:
    """The faces of patches, with other points; the array `point` has the numbers of the mesh's points."""
    ends = np.cumsum(mesh.cells.sizes)
    faces = [mesh.cells.corners[ends[i] - mesh.cells.sizes[i] : ends[i]] for name in names for i in mesh.patches[name]]
    used, corners = np.unique(np.concatenate(faces), return_inverse=True)
    sizes = [len(face) for face in faces]
    cells = np.insert(corners, np.cumsum([0, *sizes[:-1]]), sizes)
    made = pv.PolyData(points[used], faces=cells)
    made["point"] = used
    return made


if __name__ == "__main__":
    if len(sys.argv) != 5:
        raise SystemExit("usage: python examples/openfoam/picture.py OUT/case OUT/export-S OUT/step-S PICTURE.png")
    main(*(Path(word) for word in sys.argv[1:]))
