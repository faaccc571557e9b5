"""Pair every vertex of the design with a point of the scan, and reject meaningless pairs, as ICP does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from rbfevo.geometry.triangles import doubled_area_vectors

Points = NDArray[np.float64]
Triangles = NDArray[np.int64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Query = Callable[[Points], tuple[Points, Indices]]  # points [p, 3] -> closest points [p, 3] and their triangles [p]

_TOUCHING = 1e-9  # of the scan's size: closest points on an edge are that exact
_NEIGHBOURS = 24
_WIDEST_GAP = np.deg2rad(120.0)
_SIDEWAYS = 0.5
_ORDINARY = 200  # binary digits before or after the point: VTK computes products of four lengths in floats


def closest_on_surface(points: Points, vertices: Points, triangles: Triangles) -> tuple[Points, Indices]:
    """Find the closest point [p, 3] on the surface (vertices [n, 3], triangles [f, 3]) to each of points [p, 3].

    Returned with it is the triangle [p] it lies in; where several meet, any of them.
    """
    return surface_query(vertices, triangles)(points)


def surface_query(vertices: Points, triangles: Triangles) -> Query:
    """Return `closest_on_surface` for one surface, for many queries: the search tree is built once."""
    import pyvista

    size = int(np.frexp(np.abs(vertices).max())[1])
    exponent = size if abs(size) > _ORDINARY else 0
    surface = pyvista.PolyData.from_regular_faces(np.ldexp(vertices, -exponent), triangles)

    def query(points: Points) -> tuple[Points, Indices]:
        found: Any = surface.find_closest_cell(np.ldexp(points, -exponent), return_closest_point=True)
        closest = np.ldexp(np.asarray(found[1], np.float64).reshape(-1, 3), exponent)
        return closest, np.asarray(found[0], np.int64).reshape(-1)

    return query


def on_open_boundary(closest: Points, triangle: Indices, vertices: Points, triangles: Triangles) -> Mask:
    """Tell which points `closest` [p, 3], each in its `triangle` [p], lie on an edge or vertex of the open boundary.

    Boundary edges are those of one triangle only. Pairs that end there are rejected after Turk and Levoy (1994),
    "Zippered polygon meshes from range images".
    """
    corners = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges, edge, uses = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True, return_counts=True)
    open_edge = (uses == 1)[edge].reshape(-1, 3)
    open_vertex = np.zeros(len(vertices), bool)
    open_vertex[edges[uses == 1]] = True

    tolerance = _TOUCHING * float(np.ptp(vertices, axis=0).max())
    rim = np.zeros(len(closest), bool)
    for k in range(3):
        start, end = triangles[triangle, k], triangles[triangle, (k + 1) % 3]
        a, along = vertices[start], vertices[end] - vertices[start]
        length = (along**2).sum(axis=1)
        t = (((closest - a) * along).sum(axis=1) / np.where(length > 0.0, length, 1.0)).clip(0.0, 1.0)
        rim |= open_edge[triangle, k] & (np.linalg.norm(closest - a - t[:, None] * along, axis=1) <= tolerance)
        rim |= open_vertex[start] & (np.linalg.norm(closest - a, axis=1) <= tolerance)
    return rim


def from_behind(triangle: Indices, outward: Points, kept: Mask, vertices: Points, triangles: Triangles) -> Mask:
    """Tell which `kept` [p] points are paired with the inner side of the surface, in their `triangle` [p].

    `outward` [p, 3] are the points' own normals. Outer is the side that most of the kept pairs see, since a scan may
    be turned inside out as a whole.
    """
    agreement = (doubled_area_vectors(vertices, triangles[triangle]) * outward).sum(axis=1)
    sign = -1.0 if (agreement[kept] < 0.0).sum() > kept.sum() / 2 else 1.0
    return kept & (sign * agreement < 0.0)


def closest_in_cloud(points: Points, cloud: Points) -> tuple[Points, Indices]:
    """Find the closest point [p, 3] of `cloud` [n, 3] to each of points [p, 3], and its index [p]."""
    return cloud_query(cloud)(points)


def cloud_query(cloud: Points) -> Query:
    """Return `closest_in_cloud` for one cloud, for many queries: the search tree is built once."""
    tree = KDTree(cloud)

    def query(points: Points) -> tuple[Points, Indices]:
        _, index = tree.query(points)
        return cloud[index], np.asarray(index, np.int64)

    return query


def beyond_rim(points: Points, index: Indices, cloud: Points) -> Mask:
    """Tell which of points [p, 3] reach out beyond the rim of the cloud [n, 3] of which `index` [p] is the closest.

    The counterpart of `on_open_boundary` where no surface is known. A cloud's point is on the rim if, among its 24
    nearest neighbours seen in their own plane, no one lies within some 120 degrees. A pair that ends there is
    rejected if it leaves the point sideways, within that plane, by more than half the mean distance of the neighbours.
    """
    ends, pair = np.unique(index, return_inverse=True)
    distance, near = map(np.asarray, KDTree(cloud).query(cloud[ends], k=min(_NEIGHBOURS, len(cloud) - 1) + 1))
    around = cloud[near[:, 1:]] - cloud[ends][:, None]
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normal, plane = axes[:, :, 0], axes[:, :, 1:]
    flat = around @ plane
    angle = np.sort(np.arctan2(flat[:, :, 1], flat[:, :, 0]), axis=1)
    gap = np.diff(angle, axis=1, append=angle[:, :1] + 2.0 * np.pi).max(axis=1)
    spacing = distance[:, 1:].mean(axis=1)

    leaving = points - cloud[index]
    sideways = leaving - (leaving * normal[pair]).sum(axis=1, keepdims=True) * normal[pair]
    return (gap > _WIDEST_GAP)[pair] & (np.linalg.norm(sideways, axis=1) > _SIDEWAYS * spacing[pair])
