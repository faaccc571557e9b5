"""Pictures of docs/car.md: `python docs/car/picture.py CAR EXPORT DEFORMED OUT.png`, off-screen.

Left: the body, its wanted displacement (what the sensitivity asks for, wheels fixed) and the control points with the
way each is to go (four times as long). Right: the deformed body, coloured by how far it moved.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv

THIN = pv.Arrow(tip_length=0.2, tip_radius=0.05, shaft_radius=0.015)


def main(car: Path, export: Path, deformed: Path, out: Path) -> None:
    """Draw both bodies into one picture."""
    before: Any = pv.read(export / "template.vtp")
    after: Any = pv.read(deformed)
    centers: Any = pv.read(export / "centers.vtp")
    before["wanted, unit norm\n"] = np.linalg.norm(before["wanted"], axis=1)
    after["displacement [m]\n"] = np.linalg.norm(after.points - pv.read(car).points, axis=1)
    plotter: Any = pv.Plotter(shape=(1, 2), off_screen=True, window_size=[1800, 640], border=False)
    bars = {"n_labels": 3, "fmt": "%.3g", "height": 0.10, "width": 0.5, "position_x": 0.25, "position_y": 0.02}
    bars |= {"title_font_size": 22, "label_font_size": 18}
    for column, (surface, name, colors) in enumerate(
        ((before, "wanted, unit norm\n", "viridis"), (after, "displacement [m]\n", "magma_r"))
    ):
        plotter.subplot(0, column)
        plotter.add_mesh(surface, scalars=name, cmap=colors, smooth_shading=True, scalar_bar_args=bars)
        if column == 0:
            plotter.add_mesh(centers.glyph(geom=pv.Sphere(radius=0.035), scale=False, orient=False), color="#d7301f")
            arrows = centers.glyph(orient="displacement", scale="displacement", factor=4.0, geom=THIN)
            plotter.add_mesh(arrows, color="black")
        plotter.camera_position = [(-7.5, -9.5, 5.5), (-0.1, 0.0, 0.55), (0.0, 0.0, 1.0)]
        plotter.camera.zoom(1.9)
    plotter.background_color = pv.Color("white")
    out.parent.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(out)


if __name__ == "__main__":
    if len(sys.argv) != 5:
        raise SystemExit("usage: python docs/car/picture.py CAR.vtp EXPORT_DIRECTORY DEFORMED.vtp OUT.png")
    main(*(Path(word) for word in sys.argv[1:]))
