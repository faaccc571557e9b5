"""Vertices that should not move: inside a box, or marked in an array."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.correspondence import Mask, Points
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.parameterization import BoxRegion, Region, VertexRegion
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.templates import Template
from rbfevo.scenarios.vertex_arrays import vertex_array

SHAPE = "a box is six numbers, [xmin,ymin,zmin,xmax,ymax,zmax], where null leaves a side open"


class Fixing(NamedTuple):
    """Which vertices [n] are fixed, the region that they define, and a note on how many there are."""

    fixed: Mask
    region: Region
    note: str


def fixing(
    value: Any,
    template: Template,
    lower: Tensor,
    upper: Tensor,
    mirror: Mirror | None = None,
    planar: Planar | None = None,
) -> Fixing:
    """The vertices of a template that `scenario.fixed` fixes.

    Args:
        value: six numbers of a box (null: open), or the name of a point array or a file of one, where any value but 0
            marks a vertex as fixed.
        lower, upper: [3] corners of the scenario's box.
        mirror: the symmetry plane, or None: the region where no center may sit is then symmetric.
        planar: of a planar design, or None: front and back are both fixed, and the region reaches through both.

    Raises:
        UserError: for anything else, or if no vertex is fixed, or every one is.
    """
    if isinstance(value, str):
        marks = vertex_array(value, template, "fixed", kind="marks").values
        fixed = np.asarray((marks.reshape(len(marks), -1) != 0.0).any(axis=1), bool)
        low = high = None
    else:
        low, high = _box(value)
        fixed = np.asarray(((template.vertices >= low) & (template.vertices <= high)).all(axis=1), bool)
    if planar is not None:
        fixed = planar.either(fixed)
    if not fixed.any():
        spans = ", ".join(f"{a:g} to {b:g}" for a, b in zip(*_extent(template.vertices), strict=True))
        raise UserError(f"scenario.fixed={value}: this fixes no vertex (the template spans {spans})")
    if fixed.all():
        raise UserError(f"scenario.fixed={value}: this fixes every vertex, so nothing can move")
    if low is None or high is None:
        places = template.vertices if planar is None else planar.plane.pinned(template.vertices)
        region: Region = VertexRegion(torch.from_numpy(places), torch.from_numpy(fixed), mirror)
    else:
        if planar is not None:
            low[planar.plane.axis], high[planar.plane.axis] = -np.inf, np.inf
        region = BoxRegion(torch.from_numpy(low), torch.from_numpy(high), (lower, upper), mirror)
    return Fixing(fixed, region, f"{int(fixed.sum())} of {len(fixed)} vertices are fixed")


def _box(value: Any) -> tuple[Points, Points]:
    sides = list(value) if isinstance(value, Sequence) else []
    if len(sides) == 2 and all(isinstance(corner, Sequence) for corner in sides):
        sides = [*sides[0], *sides[1]]
    numbers = all(side is None or (isinstance(side, int | float) and not isinstance(side, bool)) for side in sides)
    if len(sides) != 6 or not numbers:
        raise UserError(f"scenario.fixed={value}: {SHAPE}; or give the name of a point array or a file")
    low = np.array([-np.inf if side is None else float(side) for side in sides[:3]])
    high = np.array([np.inf if side is None else float(side) for side in sides[3:]])
    if np.isnan(low).any() or np.isnan(high).any() or (low > high).any():
        raise UserError(f"scenario.fixed={value}: a lower side lies above its upper side; {SHAPE}")
    return low, high


def _extent(vertices: Points) -> tuple[Points, Points]:
    return vertices.min(axis=0), vertices.max(axis=0)
