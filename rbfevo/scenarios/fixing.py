"""Vertices that should not move, or cannot: inside a box, marked in an array, or in patches of the template's file."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from rbfevo.arrays import Points
from rbfevo.errors import UserError
from rbfevo.geometry.correspondence import Mask
from rbfevo.geometry.holding import Hold
from rbfevo.geometry.lengths import length
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.parameterization import BoxRegion, Region, VertexRegion
from rbfevo.meshes.surface import shown
from rbfevo.scenarios.boxes import box_of
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.templates import Template
from rbfevo.scenarios.vertex_arrays import vertex_array

VERBS = {"fixed": "fixes", "hold": "holds"}


class Marking(NamedTuple):
    """Which vertices [n] a setting marks, the points [h, 3] that it marks, and its box, if it is one."""

    mask: Mask
    points: Points
    box: tuple[Points, Points] | None


def marked(key: str, value: Any, template: Template, planar: Planar | None = None) -> Marking:
    """The vertices that `scenario.{key}=value` marks.

    Args:
        key: `fixed` or `hold`.
        value: six numbers of a box (null: open); the name of a point or cell array or a file of one, where any value
            but 0 marks a vertex; or names of patches of the file, in a list or one alone.
        planar: of a planar design, or None: front and back are both marked, and a box is open along the axis.

    Raises:
        UserError: for anything else, or if no vertex is marked, or every one is.
    """
    box, points, names = None, None, _patches(key, value, template)
    if names:
        points = template.patch_points(f"scenario.{key}", names)
        mask = _among(template.vertices, points)
    elif isinstance(value, str):
        try:
            marks = vertex_array(value, template, key, kind="marks").values
        except UserError as error:
            named = f"; its patches are {shown(template.patches)}" if template.patches else ""
            raise UserError(f"{error}{named}") from None
        mask = np.asarray((marks.reshape(len(marks), -1) != 0.0).any(axis=1), bool)
    else:
        box = low, high = box_of(key, value, "or give the name of a point array, a file or a patch")
        if planar is not None:
            low[planar.plane.axis], high[planar.plane.axis] = -np.inf, np.inf
        mask = np.asarray(((template.vertices >= low) & (template.vertices <= high)).all(axis=1), bool)
    mask = mask if planar is None else planar.either(mask)
    if not mask.any() and (points is None or not len(points)):
        spans = ", ".join(f"{a:g} to {b:g}" for a, b in zip(*_extent(template.vertices), strict=True))
        raise UserError(f"scenario.{key}={value}: this {VERBS[key]} no vertex (the template spans {spans})")
    if mask.all():
        raise UserError(f"scenario.{key}={value}: this {VERBS[key]} every vertex, so nothing can move")
    return Marking(mask, template.vertices[mask] if points is None else points, box)


@dataclasses.dataclass(frozen=True)
class Fixing:
    """What of a template does not move.

    Attributes:
        stays: [n] vertices that should stay (`scenario.fixed`) or cannot move (`scenario.hold`): their rows of g are 0.
        hold: the blend of the held ones, and its values [n] at the vertices; None where none are held.
        region: where no center may sit, or None.
        notes: a line each.
    """

    stays: Mask
    hold: Hold | None
    blend: Points | None
    region: Region | None
    notes: dict[str, str]


def fixing(
    fixed: Any,
    hold: Any,
    hold_width: Any,
    keep_out: bool | None,
    template: Template,
    box: tuple[Tensor, Tensor],
    mirror: Mirror | None = None,
    planar: Planar | None = None,
) -> Fixing:
    """What `scenario.fixed`, `hold`, `hold_width` and `keep_out` mean for a template.

    Args:
        fixed, hold: as `marked` takes them, or None.
        hold_width: from the held points to where all moves freely, as `length` takes it.
        keep_out: whether centers may not sit among the fixed and held vertices; None: only where some are held.
        box: [3], [3] corners of the scenario's box.
        mirror: the symmetry plane, or None: the region where no center may sit, and what is held, is then symmetric.
        planar: of a planar design, or None: front and back are fixed and held alike, and regions reach through both.

    Raises:
        UserError: for a wrong value, or where nothing may move any more.
    """
    if keep_out and fixed is None and hold is None:
        raise UserError("scenario.keep_out=true needs scenario.fixed or scenario.hold; give one of them")
    out = keep_out or (keep_out is None and hold is not None)
    notes: dict[str, str] = {}
    stays, region = np.zeros(len(template.vertices), bool), None
    soft = None if fixed is None else marked("fixed", fixed, template, planar)
    if soft is not None:
        stays |= soft.mask
        notes["fixed"] = f"{int(soft.mask.sum())} of {len(stays)} vertices are fixed"
        if keep_out:
            region, notes["fixed"] = (
                _region(soft, template, box, mirror, planar),
                f"{notes['fixed']}, centers are kept out",
            )
    if hold is None:
        return Fixing(stays, None, None, region, notes)
    hard = marked("hold", hold, template, planar)
    width = length("scenario.hold_width", hold_width, float((box[1] - box[0]).norm()))
    held = Hold(hard.points, width, mirror, None if planar is None else planar.plane)
    blend = held(template.vertices)
    if not (blend < 1.0).any():
        raise UserError(f"scenario.hold={hold}: every vertex is farther than scenario.hold_width={width:.4g} from it")
    stays |= blend == 0.0
    if stays.all():
        raise UserError("scenario.hold and scenario.fixed mark every vertex, so nothing can move")
    between = int(((blend > 0.0) & (blend < 1.0)).sum())
    notes["hold"] = (
        f"{int((blend == 0.0).sum())} of {len(blend)} vertices cannot move, {between} within {width:.4g} of them move "
        "less" + (", centers are kept out" if out else "")
    )
    if out:
        both = hard if soft is None or not keep_out else Marking(soft.mask | hard.mask, hard.points, None)
        region = _region(both, template, box, mirror, planar)
    return Fixing(stays, held, blend, region, notes)


def _region(
    marking: Marking,
    template: Template,
    box: tuple[Tensor, Tensor],
    mirror: Mirror | None,
    planar: Planar | None,
) -> Region:
    if marking.box is not None:
        low, high = (torch.from_numpy(corner) for corner in marking.box)
        return BoxRegion(low, high, box, mirror)
    beyond = marking.points[~_among(marking.points, template.vertices)]
    places = np.concatenate([template.vertices, beyond])
    vertices = torch.from_numpy(places if planar is None else planar.plane.pinned(places))
    mask = torch.from_numpy(np.concatenate([marking.mask, np.ones(len(beyond), bool)]))
    return VertexRegion(vertices, mask, mirror)


def _among(points: Points, others: Points) -> Mask:
    """Which of points [q, 3] coincide with one of others [h, 3]."""
    return KDTree(others).query(points)[0] == 0.0


def _patches(key: str, value: Any, template: Template) -> tuple[str, ...]:
    """The names of patches that a value lists; none where it is a box, an array or a file."""
    if isinstance(value, str):
        patch, array = value in template.patches, value in template.arrays or value in template.cell_arrays
        if patch and array:
            raise UserError(
                f"scenario.{key}={value}: the file has a patch and an array of this name; scenario.{key}=[{value}] is "
                "the patch; for the array, rename one of them"
            )
        return (value,) if patch else ()
    listed = list(value) if isinstance(value, Sequence) else []
    return tuple(listed) if listed and all(isinstance(name, str) for name in listed) else ()


def _extent(vertices: Points) -> tuple[Points, Points]:
    return vertices.min(axis=0), vertices.max(axis=0)
