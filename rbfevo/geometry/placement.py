"""Bring a scan into the sphere's frame: clean it, turn it, and fit it into the box [-1,1]^3."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from rbfevo.errors import UserError

Points = NDArray[np.float64]
Triangles = NDArray[np.int64]

_COINCIDENT = 1e-6  # of the median distance from the middle
_STRAY_DISTANCE, _STRAY_SHARE = 5.0, 0.01


def merge_coincident(vertices: Points, triangles: Triangles | None) -> tuple[Points, Triangles | None]:
    """Merge vertices [n, 3] that coincide, as where a texture's seam or an STL file has split them.

    Two coincide if they are no farther apart than 1e-6 of the median distance from the median point. Triangles [f, 3]
    that collapse, or that repeat another, and vertices that belong to no triangle are dropped.
    """
    points, first = np.unique(vertices, axis=0, return_inverse=True)
    pairs = KDTree(points).query_pairs(_COINCIDENT * float(np.median(_from_middle(points))), output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, label = connected_components(links, directed=False)
    _, kept = np.unique(label, return_index=True)
    points = points[kept]
    if triangles is None:
        return points, None

    merged = np.asarray(label, np.int64)[first.reshape(-1)][triangles]
    a, b, c = merged.T
    merged = merged[(a != b) & (b != c) & (c != a)]
    _, once = np.unique(np.sort(merged, axis=1), axis=0, return_index=True)
    return _used(points, merged[np.sort(once)])


def drop_strays(vertices: Points, triangles: Triangles | None) -> tuple[Points, Triangles | None, int]:
    """Drop stray vertices, with their triangles, and return how many there were.

    Strays are farther from the median point than 5 times the median such distance, and at most 1% of the vertices;
    if there are more, they belong to the scan. A single outlier of a scanner must not set the scale.
    """
    distance = _from_middle(vertices)
    stray = distance > _STRAY_DISTANCE * np.median(distance)
    count = int(stray.sum())
    if count == 0 or count > _STRAY_SHARE * len(vertices):
        return vertices, triangles, 0
    if triangles is None:
        return vertices[~stray], None, count
    points, triangles = _used(vertices, triangles[~stray[triangles].any(axis=1)])
    return points, triangles, count


def turn(vertices: Points, up: str, front: str) -> Points:
    """Turn vertices [n, 3] so that the axis `up` becomes +y and `front` becomes +z, towards the viewer of a picture.

    Axes are x, y or z with or without a sign. The turn is a rotation, never a mirror image: +x is up x front.

    Raises:
        UserError: if an axis is not one of these, or the two are the same one.
    """
    y, z = _axis(up, "up"), _axis(front, "front")
    if y @ z != 0.0:
        raise UserError(
            f"scenario.up={up}, scenario.front={front}: these are one axis; set both, to two different axes"
        )
    return vertices @ np.stack([np.cross(y, z), y, z]).T


def fit_box(vertices: Points) -> tuple[Points, float]:
    """Move and uniformly scale vertices [n, 3] into [-1,1]^3; return them and the scale.

    The longest side of the scan's box becomes 2 long. The box is centred left to right (x) and bottom to top (y), and
    its front touches the front of the box, z = 1. In depth it is not centred: then most closest points of the
    sphere's front would be the tip of the nose, while this way the front of the sphere lies close to the face.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = 2.0 / float((high - low).max())
    placed = (vertices - (low + high) / 2.0) * scale
    placed[:, 2] += 1.0 - placed[:, 2].max()
    return placed.clip(-1.0, 1.0), scale  # the clip undoes rounding only


def _from_middle(points: Points) -> Points:
    return np.linalg.norm(points - np.median(points, axis=0), axis=1)


def _used(points: Points, triangles: Triangles) -> tuple[Points, Triangles]:
    used, renumbered = np.unique(triangles, return_inverse=True)
    return points[used], renumbered.reshape(-1, 3).astype(np.int64)


def _axis(name: str, key: str) -> Points:
    sign, letter = (name[0], name[1:]) if isinstance(name, str) and name[:1] in ("+", "-") else ("+", name)
    if not isinstance(letter, str) or letter.lower() not in ("x", "y", "z"):
        raise UserError(f"scenario.{key}={name}: choose x, y, z, -x, -y or -z")
    direction = np.zeros(3)
    direction["xyz".index(letter.lower())] = -1.0 if sign == "-" else 1.0
    return direction
