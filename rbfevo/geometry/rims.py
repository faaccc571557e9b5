"""The open boundary of a surface, or the ends of a curve, and how much of it lies in a plane across an axis."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Ints, Points, Triangles
from rbfevo.geometry.curves import ends
from rbfevo.geometry.topology import edges_of

FLAT_RIM = 1e-6  # of the diagonal: within it an edge lies in a plane


class Rim(NamedTuple):
    """The edges of one triangle only, e of them, of a mesh with n vertices.

    Attributes:
        vertices: [n, 3]; edges: [e, 2] their ends; inner: [e] the third corner of their triangles; sizes: [e] lengths.
    """

    vertices: Points
    edges: Ints
    inner: Ints
    sizes: NDArray[np.float64]

    def share(self, axis: int, at: float) -> float:
        """The share of its length at which the surface ends in the plane where coordinate `axis` is `at`, 0 to 1.

        An edge of a triangle that lies in the plane itself, as on the side of a box, does not count.
        """
        total = float(self.sizes.sum())
        return float(self.sizes[self._cut(axis, at)].sum()) / total if total > 0.0 else 0.0

    def reach(self, axis: int, at: float) -> float:
        """How much of the extent of the vertices the edges that `share` counts span, 0 to 1: the smaller of both."""
        cut = np.unique(self.edges[self._cut(axis, at)])
        if not cut.size:
            return 0.0
        whole, own = (np.delete(np.ptp(points, axis=0), axis) for points in (self.vertices, self.vertices[cut]))
        return float(np.divide(own, whole, out=np.ones(2), where=whole > 0.0).min())

    def _cut(self, axis: int, at: float) -> NDArray[np.bool_]:
        near = FLAT_RIM * float(np.linalg.norm(np.ptp(self.vertices, axis=0)))
        heights = np.abs(self.vertices[:, axis] - at)
        return (heights[self.edges] <= near).all(axis=1) & (heights[self.inner] > near)


def rim_of(vertices: Points, triangles: Triangles, without: int | None = None) -> Rim:
    """The rim of triangles [f, 3].

    Args:
        without: an axis: edges that run across it are left out, as those of front and back of a slab.
    """
    found = edges_of(len(vertices), triangles)
    half = np.flatnonzero(found.uses[found.index] == 1)
    edges = found.ends[found.index[half]]
    inner = triangles.reshape(-1, 3)[found.triangle[half]].sum(axis=1) - edges.sum(axis=1)
    along = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    kept = np.ones(len(edges), bool)
    if without is not None:
        kept = np.abs(along[:, without]) > FLAT_RIM * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    return Rim(vertices, edges[kept], inner[kept], np.linalg.norm(along[kept], axis=1))


def rim_of_curve(vertices: Points, segments: Ints) -> Rim:
    """The open ends of segments [s, 2], each with the size 1."""
    loose = ends(len(vertices), segments)
    neighbour = np.zeros(len(vertices), np.int64)  # right for those that have only one
    neighbour[segments[:, 0]] = segments[:, 1]
    neighbour[segments[:, 1]] = np.where(np.isin(segments[:, 1], loose), segments[:, 0], neighbour[segments[:, 1]])
    return Rim(vertices, np.stack([loose, loose], axis=1), neighbour[loose], np.ones(len(loose)))
