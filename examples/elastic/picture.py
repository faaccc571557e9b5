"""The bracket before and after, coloured by its stress. `python examples/elastic/picture.py OUT PICTURE.png`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv

AWAY = np.array([0.6, 0.4, 1.7])  # the camera from the middle, in diagonals
STRESS = "von Mises stress (N/mm^2)\n"


def main(out: Path, picture: Path) -> None:
    """Draw optimized.vtu beside bracket.vtu, both with their other halves."""
    before, after = (whole(out / f"{name}.vtu") for name in ("bracket", "optimized"))
    middle, diagonal = np.array([50.0, 50.0, 0.0]), before.length
    limits = (0.0, float(before[STRESS].max()))
    plotter: Any = pv.Plotter(shape=(1, 2), off_screen=True, window_size=[1800, 850], border=False)
    bar = {"n_labels": 4, "fmt": "%.0f", "height": 0.07, "width": 0.45, "position_x": 0.05, "position_y": 0.02}
    bar |= {"title_font_size": 24, "label_font_size": 20}
    for column, (body, name) in enumerate(((before, "before"), (after, "after, the same volume"))):
        plotter.subplot(0, column)
        plotter.add_mesh(
            body,
            scalars=STRESS,
            cmap="viridis",
            clim=limits,
            show_edges=True,
            edge_opacity=0.3,
            scalar_bar_args=dict(bar),
        )
        plotter.add_text(name, font_size=14, color="black")
        if column:
            edges = before.extract_feature_edges(40)
            plotter.add_mesh(edges, color="#d7301f", line_width=3)
        arrow = pv.Arrow(start=(80.0, -2.0, 0.0), direction=(0.0, -1.0, 0.0), scale=20.0)
        plotter.add_mesh(arrow, color="black")
        plotter.camera_position = [tuple(middle + diagonal * AWAY), tuple(middle), (0.0, 1.0, 0.0)]
    plotter.background_color = pv.Color("white")
    picture.parent.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(picture)
    print(f"written: {picture}")


def whole(path: Path) -> Any:
    """The surface of a mesh and its mirror image, with the stress of cells averaged at points."""
    half: Any = pv.read(path)
    half.cell_data[STRESS] = half.cell_data.pop("von Mises")
    both = half.merge(half.reflect((0.0, 0.0, 1.0), point=(0.0, 0.0, 0.0)))
    return both.extract_surface(algorithm=None)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit("usage: python examples/elastic/picture.py OUT PICTURE.png")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
