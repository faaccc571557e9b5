"""The target that a template should become: read, checked against the template's unit and place, and paired with it."""

from __future__ import annotations

import math

import numpy as np

from rbfevo.errors import UserError
from rbfevo.geometry import placement
from rbfevo.geometry.correspondence import Points
from rbfevo.geometry.pairing import Pairing, pair
from rbfevo.scenarios.outline import target_curve
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.reading import checked_extent, read_surface
from rbfevo.scenarios.units import nearest_unit

MIXED_UNITS = 20.0  # ratio of sizes: metres and millimetres, or inches and millimetres


def paired(
    vertices: Points, normals: Points, target: str, scale: float | None, reject: str, flat: Planar | None = None
) -> tuple[Pairing, dict[str, str], list[str]]:
    """Pairs of vertices [n, 3] with normals [n, 3] and the target in a file, after a check of its unit.

    Returns the pairs, notes and warnings.

    Args:
        scale: by which the target is multiplied; None is 1, but mixed units are refused.
        reject: as `pair` takes it; flat: of a planar design, whose pairs lie in its plane.

    Raises:
        UserError: if the file is unusable, the unit another one, or every pair is rejected.
    """
    curve = None if flat is None else target_curve(target, flat.plane)
    points, triangles = read_surface(target) if curve is None else curve
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise UserError(f"scenario.target_scale={scale}: give a positive number")
    if scale is not None:
        with np.errstate(over="ignore"):
            points = points * scale
        checked_extent(f"{target} times scenario.target_scale={scale:g}", points)
    mine, its = (float(np.linalg.norm(np.ptp(part, axis=0))) for part in (vertices, points))
    if scale is None and not 1.0 / MIXED_UNITS < its / mine < MIXED_UNITS:
        raise UserError(
            f"{target}: the target's diagonal is {its:.4g}, the template's {mine:.4g}: are their units different? Set "
            f"scenario.target_scale={nearest_unit(mine / its):g} to scale the target, or 1 to keep its size"
        )
    apart = np.maximum(points.min(axis=0) - vertices.max(axis=0), vertices.min(axis=0) - points.max(axis=0))
    places = vertices
    if flat is not None:
        points, triangles = flat.target(target, points, triangles)
        places, apart = flat.plane.pinned(vertices), apart[flat.plane.others]
        reject = "none" if triangles is None else reject  # a cloud of a curve is all rim
    points, triangles = placement.merge_coincident(points, triangles)
    if triangles is not None and len(triangles) == 0:
        raise UserError(f"{target}: merging coincident vertices leaves no triangle; check the file")
    found = pair(places, normals, points, triangles, reject)
    if flat is not None:
        found = flat.kept_in_plane(found)
    kind = "a cloud" if triangles is None else f"{len(triangles)} triangles"
    notes = {"target": f"{target}: {len(points)} distinct vertices, {kind}"}
    if curve is not None:
        notes = {"target": f"{target}: a curve of {len(curve[1]) // 2} segments"}
    if found.rejected.all():
        raise UserError(
            f"{target}: all pairs of template and target are rejected; check that both are in the same place, or set "
            "scenario.reject=none"
        )
    warnings = []
    if apart.max() > mine:
        warnings.append(
            f"the target lies {apart.max():.3g} away from the template: do both have the same coordinate system?"
        )
    return found, notes | found.notes, warnings
