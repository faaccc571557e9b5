"""The mesh of a channel in three parts, half of it, by blockMesh: straight, the part that may change, straight."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import steps

GRADING = "(1 ((0.5 0.5 1) (0.5 0.5 0.5)) ((0.5 0.5 2) (0.5 0.5 0.5)))"  # cells at walls are half as thick
# The corners of a block, 0 to 3 at its lower end in x, 4 to 7 at its upper end; corner k + 4 is corner k of the next.
HEX = (0, 4, 5, 1, 3, 7, 6, 2)
SIDES = {"floor": (0, 1, 5, 4), "ceiling": (3, 7, 6, 2), "flank": (1, 2, 6, 5), "middle": (0, 4, 7, 3)}
CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))  # shares of the half width and of the height, of corners 0 to 3
SOLID = ("floor", "ceiling", "flank")


class Section(NamedTuple):
    """A rectangular section: heights of its lower and of its upper wall, and half its width."""

    floor: float
    ceiling: float
    half_width: float


class Channel(NamedTuple):
    """A channel along x.

    Attributes:
        lengths: of the three parts; the second begins at x = 0. section: of x.
        cells: along x in each part, across half the width, over the height.
        patch: the name of the walls of the second part; the others are `walls`.
    """

    lengths: tuple[float, float, float]
    section: Callable[[float], Section]
    cells: tuple[tuple[int, int, int], int, int]
    patch: str

    def files(self, case: Path, scale: float) -> None:
        """Write system/blockMeshDict: three blocks in a row, the middle one with curved edges."""
        first, second, third = self.lengths
        along, *sizes = self.cells
        across, high = (2 * max(1, round(scale * n / 2)) for n in sizes)
        lines = ["scale 1;", "", "vertices", "("]
        ends = np.cumsum([-first, first, second, third]).tolist()
        lines += [f"    {self.point(x, corner)}" for x in ends for corner in CORNERS]
        lines += [");", "", "blocks", "("]
        for block, count in enumerate(along):
            corners = " ".join(str(4 * block + corner) for corner in HEX)
            count = max(2, round(scale * count))
            lines.append(f"    hex ({corners}) ({count} {across} {high}) simpleGrading {GRADING}")
        lines += [");", "", "edges", "("]
        inner = np.linspace(0.0, second, 41)[1:-1].tolist()
        for k, corner in enumerate(CORNERS):
            lines.append(f"    polyLine {4 + k} {8 + k} ({' '.join(self.point(x, corner) for x in inner)})")
        lines += [");", "", "boundary", "("]
        for name, kind, listed in (
            ("inlet", "patch", "(0 3 2 1)"),
            ("outlet", "patch", "(12 13 14 15)"),
            ("symmetry", "symmetryPlane", faces((0, 1, 2), ("middle",))),
            (self.patch, "wall", faces((1,), SOLID)),
            ("walls", "wall", faces((0, 2), SOLID)),
        ):
            lines.append(f"    {name} {{ type {kind}; faces ({listed}); }}")
        steps.write(case / "system" / "blockMeshDict", "\n".join([*lines, ");", ""]))

    def point(self, x: float, corner: tuple[int, int]) -> str:
        """One of the four corners of the section at x."""
        floor, ceiling, half_width = self.section(x)
        return f"({x:.12g} {corner[0] * half_width:.12g} {(floor, ceiling)[corner[1]]:.12g})"


def faces(blocks: tuple[int, ...], sides: tuple[str, ...]) -> str:
    """Faces of blocks, as blockMesh wants them."""
    listed = [[4 * block + corner for corner in SIDES[side]] for block in blocks for side in sides]
    return " ".join("(" + " ".join(map(str, face)) + ")" for face in listed)


def ramp(t: float) -> float:
    """From 0 at t = 0 to 1 at t = 1, with two continuous derivatives."""
    t = min(max(t, 0.0), 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)
