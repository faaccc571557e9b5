"""The wanted displacement of each vertex: to its closest point on a scan or target, unless the pair is rejected."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.errors import UserError
from rbfevo.geometry import correspondence
from rbfevo.geometry.correspondence import Mask, Points, Query, Triangles

REJECTIONS = ("boundary", "none")


class Pairing(NamedTuple):
    """Displacements [n, 3] of vertices to their closest points, 0 where the pair is `rejected` [n]; notes.

    `query` gives the closest points of any others.
    """

    displacement: NDArray[np.float64]
    rejected: Mask
    notes: dict[str, str]
    query: Query


def pair(points: Points, outward: Points, vertices: Points, triangles: Triangles | None, reject: str) -> Pairing:
    """Pair points [n, 3], whose own normals are `outward` [n, 3], with a surface, or a cloud where `triangles` is None.

    Args:
        reject: "boundary" rejects pairs that end on the surface's open boundary, or reach beyond a cloud's rim; "none".

    Raises:
        UserError: for another choice.
    """
    if reject not in REJECTIONS:
        raise UserError(f"scenario.reject={reject}: choose one of {', '.join(REJECTIONS)}")
    rejected = behind = np.zeros(len(points), bool)
    if triangles is None:
        query = correspondence.cloud_query(vertices)
        closest, index = query(points)
        if reject == "boundary":
            rejected = correspondence.beyond_rim(points, index, vertices)
    else:
        query = correspondence.surface_query(vertices, triangles)
        closest, triangle = query(points)
        if reject == "boundary":
            rejected = correspondence.on_open_boundary(closest, triangle, vertices, triangles)
        behind = correspondence.from_behind(triangle, outward, ~rejected, vertices, triangles)
    displacement = np.where(rejected[:, None], 0.0, closest - points)
    notes = {"rejected": f"{int(rejected.sum())} of {len(points)} vertices have no pair and stay (reject={reject})"}
    total = (displacement**2).sum()
    if behind.any() and total > 0:
        share = (displacement[behind] ** 2).sum() / total
        notes["from behind"] = (
            f"{int(behind.sum())} vertices are paired with the inner side of the scan ({share:.1%} of |g|^2)"
        )
    return Pairing(displacement, rejected, notes, query)
