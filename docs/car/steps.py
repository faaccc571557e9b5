"""A sensitivity raw and smoothed, and the step of each rule: `python docs/car/steps.py RUN OUT.png [--pick knee]`.

RUN is a run on the car with `scenario.smooth`. For each rule the picture shows how far the vertices move, and the
lines on the screen give the predicted and the real change of the drag, with the same largest displacement.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import body
import numpy as np
import pyvista as pv
import torch

from rbfevo.geometry import sobolev
from rbfevo.recorded.moves import RULES, wanted_move
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import setup


def measured(record: Record, pick_name: str, step: float) -> dict[str, tuple[np.ndarray, float, float]]:
    """Of each rule the displacement [n, 3] of its step, and the predicted and the real change of the drag."""
    chosen, faces = setup(record, pick(record, pick_name)), torch.from_numpy(record.faces)
    before = float(body.drag(torch.from_numpy(record.vertices), faces))
    found = {}
    for rule in RULES:
        move = wanted_move(record, chosen, step, rule)
        after = float(body.drag(torch.from_numpy(record.vertices + move.reached), faces))
        found[rule] = move.reached, float(move.change or 0.0), after - before
    return found


def draw(record: Record, steps: dict[str, tuple[np.ndarray, float, float]], out: Path) -> None:
    """Draw the sensitivity per area, raw and smoothed on one scale, and the steps on another."""
    areas = sobolev.mass(record.vertices, record.faces)[:, None]
    raw = record.gradient if record.gradient_raw is None else record.gradient_raw
    fields = (raw, record.gradient, raw - record.gradient)
    per_area = [np.linalg.norm(field * record.weights[:, None] / areas, axis=1) for field in fields]
    top = float(np.percentile(per_area[0], 99.5))
    moves = {rule: np.linalg.norm(displacement, axis=1) for rule, (displacement, _, _) in steps.items()}
    largest = max(float(move.max()) for move in moves.values())
    panels = [
        ("sensitivity per area, raw", per_area[0], "viridis", top),
        ("smoothed", per_area[1], "viridis", top),
        ("what smoothing removes", per_area[2], "viridis", top),
        *(
            (f"{rule}: drag {100 * real / drag_of(record):+.1f} %", moves[rule], "magma_r", largest)
            for rule, (_, _, real) in steps.items()
        ),
    ]
    plotter: Any = pv.Plotter(shape=(2, 3), off_screen=True, window_size=[1800, 820], border=False)
    for place, (title, values, colors, most) in zip(
        [(row, column) for row in (0, 1) for column in (0, 1, 2)], panels, strict=True
    ):
        plotter.subplot(*place)
        surface: Any = pv.PolyData.from_regular_faces(record.vertices, record.faces)
        plotter.add_mesh(surface, scalars=values, cmap=colors, clim=[0.0, most], show_scalar_bar=False)
        plotter.add_text(title, font_size=11, position="upper_edge", color="black")
        plotter.camera_position = [(-7.5, -9.5, 5.5), (-0.1, 0.0, 0.55), (0.0, 0.0, 1.0)]
        plotter.camera.zoom(2.0)
    plotter.background_color = pv.Color("white")
    out.parent.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(out)


def drag_of(record: Record) -> float:
    """The drag of the undeformed body."""
    return float(body.drag(torch.from_numpy(record.vertices), torch.from_numpy(record.faces)))


def main() -> None:
    """Carry out the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--pick", default="knee")
    parser.add_argument("--step", type=float, default=0.02)
    options = parser.parse_args()
    record = read(options.run)
    steps = measured(record, options.pick, options.step)
    whole = drag_of(record)
    for rule, (_, predicted, real) in steps.items():
        print(f"{rule}: drag {100 * real / whole:+.1f} %, predicted {100 * predicted / whole:+.1f} %")
    draw(record, steps, options.out)


if __name__ == "__main__":
    main()
