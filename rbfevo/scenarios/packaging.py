"""`scenario.inside` and `scenario.outside`: boxes and closed surfaces in which control points may sit, or may not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from rbfevo.arrays import Points, Triangles
from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.packaging import Packaging
from rbfevo.geometry.parameterization import Region
from rbfevo.geometry.planar import Plane
from rbfevo.geometry.solids import Box, Enclosed, Solid
from rbfevo.scenarios.boxes import box_of, is_box
from rbfevo.scenarios.reading import read_surface

LITTLE = 1e-3  # of what may be left of the box


def packaging(
    inside: Any,
    outside: Any,
    box: tuple[Tensor, Tensor],
    mirror: Mirror | None,
    planar: Plane | None,
    other: Region | None,
) -> tuple[Packaging | None, dict[str, str]]:
    """The region that `scenario.inside` and `scenario.outside` keep free of centers, joined with another; and notes.

    Args:
        inside, outside: a box of six numbers (null: open), a file with a closed surface, a list of them, or None.
        box: [3], [3] corners of the scenario's box; mirror: the plane of symmetry; planar: the mid-plane; other: a
            region that is kept free anyway; or None each.

    Returns:
        No region where neither is set.

    Raises:
        UserError: if a value is neither, a surface is not closed, or nothing is left for centers.
    """
    if inside is None and outside is None:
        return None, {}
    bodies = {key: solids(key, value) for key, value in (("inside", inside), ("outside", outside)) if value is not None}
    flat = None if planar is None else (planar.axis, planar.at)
    region = Packaging(bodies.get("inside", []), bodies.get("outside", []), box, mirror, flat, other)
    if region.share < LITTLE:
        raise UserError(
            f"scenario.inside and scenario.outside leave only {region.share:.2%} of the part of the box that they span "
            "for centers; leave more room"
        )
    named = " and ".join(f"{key} {len(found)} bod{'y' if len(found) == 1 else 'ies'}" for key, found in bodies.items())
    return region, {"packaging": f"centers sit {named}"}


def solids(key: str, value: Any) -> list[Solid]:
    """The bodies that `scenario.{key}=value` names.

    Raises:
        UserError: if one is neither a box nor a file with a closed surface.
    """
    listed = [value] if isinstance(value, str) or is_box(value) else value
    if not isinstance(listed, Sequence) or not listed:
        raise UserError(
            f"scenario.{key}={value}: give a box [xmin,ymin,zmin,xmax,ymax,zmax] (null: open), a file with a closed "
            "surface, or a list of them"
        )
    found: list[Solid] = []
    for one in listed:
        if isinstance(one, str):
            found.append(Enclosed(*closed_surface(key, one)))
        else:
            low, high = box_of(key, one, "or give a file with a closed surface, or a list of boxes and files")
            found.append(Box(low, high))
    return found


def closed_surface(key: str, path: str) -> tuple[Points, Triangles]:
    """Points [n, 3] and triangles [f, 3] of a closed surface in a file, its normals outwards.

    Raises:
        UserError: if the file cannot be read, is a cloud, or the surface is not closed.
    """
    points, triangles = read_surface(path)
    if triangles is None:
        raise UserError(f"scenario.{key}={path}: it has no triangles, and a closed surface is needed")
    points, index = np.unique(points, axis=0, return_inverse=True)  # STL repeats them
    triangles = index.reshape(-1)[triangles]
    corners = [
        triangles[:, 0] != triangles[:, 1],
        triangles[:, 1] != triangles[:, 2],
        triangles[:, 2] != triangles[:, 0],
    ]
    triangles = triangles[np.logical_and.reduce(corners)]
    edges = topology.edges_of(len(points), triangles)
    open_edges, crowded = int((edges.uses == 1).sum()), int((edges.uses > 2).sum())
    if open_edges or crowded:
        parts = [f"{open_edges} edges belong to one triangle only"] if open_edges else []
        parts += [f"{crowded} edges belong to more than two"] if crowded else []
        raise UserError(f"scenario.{key}={path}: its surface is not closed: {' and '.join(parts)}; close it")
    if topology.volume(points, triangles) < 0.0:
        triangles = triangles[:, ::-1]
    return points, topology.oriented(points, triangles)[0]
