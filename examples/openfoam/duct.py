"""A laminar S-bend, half of it: less loss of total pressure by another bend. `python examples/openfoam/duct.py OUT`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import steps

INLET, BEND, OUTLET = 1.0, 3.0, 3.0  # lengths along x
HALF_WIDTH, HEIGHT, RISE = 0.5, 1.0, 1.5
CELLS = (10, 40, 26), 8, 16  # along x in the three parts, along y, along z
GRADING = "(1 ((0.5 0.5 1) (0.5 0.5 0.5)) ((0.5 0.5 2) (0.5 0.5 0.5)))"  # cells at walls are half as thick
# python -m rbfevo.advise scenario=mesh scenario.template=outputs/duct/case 'scenario.patches=[bend]' \
#   'scenario.hold=[walls]' hydra.run.dir=outputs/duct/advice
# recommended (gain 0.941, in 3 minutes) the settings from manipulation on, before any step was tried:
SETTINGS = (
    *("scenario.patches=[bend]", "scenario.hold=[walls]", "manipulation=direct", "kernel=wendland"),
    *("kernel.support=2.911", "centers=6", "scenario.smooth=0.1332", "criterion.norm=16", "method=gradient"),
)
# The corners of a block, 0 to 3 at its lower end in x, 4 to 7 at its upper end; corner k + 4 is corner k of the next.
HEX = (0, 4, 5, 1, 3, 7, 6, 2)
SIDES = {"floor": (0, 1, 5, 4), "ceiling": (3, 7, 6, 2), "flank": (1, 2, 6, 5), "middle": (0, 4, 7, 3)}
CORNERS = ((0.0, 0.0), (HALF_WIDTH, 0.0), (HALF_WIDTH, HEIGHT), (0.0, HEIGHT))  # y and z of corners 0 to 3


def floor(x: float) -> float:
    """The height of the lower wall: 0, then RISE, with two continuous derivatives."""
    t = min(max(x / BEND, 0.0), 1.0)
    return RISE * t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def point(x: float, y: float, z: float) -> str:
    """A point at height z above the lower wall."""
    return f"({x:.12g} {y:.12g} {floor(x) + z:.12g})"


def faces(blocks: tuple[int, ...], sides: tuple[str, ...]) -> str:
    """Faces of blocks, as blockMesh wants them."""
    listed = [[4 * block + corner for corner in SIDES[side]] for block in blocks for side in sides]
    return " ".join("(" + " ".join(map(str, face)) + ")" for face in listed)


def files(case: Path, scale: float) -> None:
    """Write system/blockMeshDict: three blocks in a row, the middle one with bent edges."""
    along, across, high = CELLS
    across, high = (2 * max(1, round(scale * n / 2)) for n in (across, high))
    ends = np.cumsum([-INLET, INLET, BEND, OUTLET]).tolist()
    lines = ["scale 1;", "", "vertices", "("]
    lines += [f"    {point(x, y, z)}" for x in ends for y, z in CORNERS]
    lines += [");", "", "blocks", "("]
    for block, count in enumerate(along):
        corners = " ".join(str(4 * block + corner) for corner in HEX)
        count = max(2, round(scale * count))
        lines.append(f"    hex ({corners}) ({count} {across} {high}) simpleGrading {GRADING}")
    lines += [");", "", "edges", "("]
    inner = np.linspace(0.0, BEND, 41)[1:-1].tolist()
    for corner, (y, z) in enumerate(CORNERS):
        lines.append(f"    polyLine {4 + corner} {8 + corner} ({' '.join(point(x, y, z) for x in inner)})")
    lines += [");", "", "boundary", "("]
    solid = ("floor", "ceiling", "flank")
    for name, kind, listed in (
        ("inlet", "patch", "(0 3 2 1)"),
        ("outlet", "patch", "(12 13 14 15)"),
        ("symmetry", "symmetryPlane", faces((0, 1, 2), ("middle",))),
        ("bend", "wall", faces((1,), solid)),
        ("walls", "wall", faces((0, 2), solid)),
    ):
        lines.append(f"    {name} {{ type {kind}; faces ({listed}); }}")
    steps.write(case / "system" / "blockMeshDict", "\n".join([*lines, ");", ""]))


EXAMPLE = steps.Example("duct", files, (("blockMesh",),), "losseslosses", SETTINGS, 0.005)

if __name__ == "__main__":
    sys.exit(steps.main(EXAMPLE))
