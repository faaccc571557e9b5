"""The best step of one setup under both norms of a criterion: `python docs/car/norms.py RUN OUT.png [--pick knee]`.

RUN is a run on the car with `criterion.norm=16`. The picture shows the wanted displacement of its run and, for one and
the same setup, the displacement within reach that gains most for a bounded mean square (P, `criterion.norm=2`) and for
a bounded 16-norm (P_16), both with the same largest displacement. The lines on the screen check both potentials
against the file and give the predicted and the real change of the drag.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import body
import numpy as np
import pyvista as pv
import torch
from numpy.typing import NDArray

from rbfevo.recorded.moves import predicted_change
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import EPS, setup
from rbfevo.scoring.maxnorm import Block, best_displacement, dual_norm

Array = NDArray[np.float64]
CAMERA = [(-10.0, -8.0, 5.0), (0.05, 0.0, 0.45), (0.0, 0.0, 1.0)]
LOOK = {"cmap": "viridis", "smooth_shading": True, "ambient": 0.25, "show_scalar_bar": False}
BAR: dict[str, Any] = {"n_labels": 5, "fmt": "%.0f", "title_font_size": 24, "label_font_size": 22, "color": "black"}
BAR |= {"height": 0.12, "width": 0.6, "position_x": 0.2, "position_y": 0.03}


class Step(NamedTuple):
    """The step of a norm.

    Attributes:
        potential: P_p of the setup.
        displacement: [n, 3] with the largest displacement that was asked for.
        predicted, real: the change of the drag.
    """

    potential: float
    displacement: Array
    predicted: float
    real: float


def steps(record: Record, row: int, largest: float) -> dict[float, Step]:
    """The best step of a setup under each norm, the run's vertex weights in both."""
    chosen, a = setup(record, row), record.weights[:, None] * record.gradient
    blocks = []
    for components, across, columns in chosen.parities(a.shape[1]):
        basis, values, _ = np.linalg.svd(chosen.blended(record.vertices, across)[:, columns], full_matrices=False)
        blocks.append(Block(components, basis[:, values > len(a) * EPS * values[0]]))
    before, made = drag_of(record, 0.0 * record.vertices), {}
    for p in (2.0, float(record.summary["criterion_norm"])):
        found = best_displacement(blocks, a, record.weights, p)
        displacement = found.displacement * (largest / np.linalg.norm(found.displacement, axis=1).max())
        made[p] = Step(
            (found.gain / dual_norm(a, record.weights, p)) ** 2,
            displacement,
            predicted_change(record, displacement) or 0.0,
            drag_of(record, displacement) - before,
        )
    return made


def drag_of(record: Record, displacement: Array) -> float:
    """The drag of the displaced body."""
    vertices, faces = torch.from_numpy(record.vertices + displacement), torch.from_numpy(record.faces)
    return float(body.drag(vertices, faces))


def draw(record: Record, found: dict[float, Step], largest: float, out: Path) -> None:
    """Three bodies side by side, all lengths as percentages of the largest one of their own field."""
    wanted, whole = np.linalg.norm(record.gradient, axis=1), drag_of(record, 0.0 * record.vertices)
    panels = [("wanted displacement\n(minus the smoothed sensitivity)", wanted / wanted.max())]
    for p, step in found.items():
        title = f"best step for criterion.norm={p:g}\ndrag {100 * step.real / whole:+.1f} %"
        panels.append((title, np.linalg.norm(step.displacement, axis=1) / largest))
    plotter: Any = pv.Plotter(shape=(1, len(panels)), off_screen=True, window_size=[2100, 700], border=False)
    for column, (title, shares) in enumerate(panels):
        plotter.subplot(0, column)
        surface: Any = pv.PolyData.from_regular_faces(record.vertices, record.faces)
        surface["percent of the largest displacement"] = 100.0 * shares
        plotter.add_mesh(surface, clim=[0.0, 100.0], **LOOK)
        plotter.add_text(title, font_size=14, position="upper_edge", color="black")
        plotter.camera_position = CAMERA
        plotter.camera.zoom(1.75)
    plotter.subplot(0, 1)
    plotter.add_scalar_bar(title="percent of the largest displacement\n", **BAR)
    plotter.background_color = pv.Color("white")
    out.parent.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(out)


def main() -> None:
    """Carry out the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--pick", default="knee")
    parser.add_argument("--step", type=float, default=0.02, help="the largest displacement, in diagonals of the box")
    options = parser.parse_args()
    record = read(options.run)
    if record.bounded_potential is None:
        raise SystemExit(f"{options.run}: made with criterion.norm=2; make a run with criterion.norm=16")
    row = pick(record, options.pick)
    largest = options.step * float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    found, whole = steps(record, row, largest), drag_of(record, 0.0 * record.vertices)
    saved = (float(record.improvement_potential[row]), float(record.bounded_potential[row]))
    for (p, step), potential in zip(found.items(), saved, strict=True):
        lengths = np.linalg.norm(step.displacement, axis=1)
        print(
            f"norm {p:g}: potential {step.potential:.4f} (saved {potential:.4f}), "
            f"drag {100 * step.real / whole:+.1f} %, predicted {100 * step.predicted / whole:+.1f} %; "
            f"{100 * np.mean(lengths > 0.5 * largest):.0f} % of the vertices move by more than half of {largest:.3g}"
        )
    draw(record, found, largest, options.out)


if __name__ == "__main__":
    main()
