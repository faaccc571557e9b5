"""Areas and normals of triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Points, Triangles


def doubled_area_vectors(vertices: Points, triangles: Triangles) -> Points:
    """Return the vectors [f, 3] normal to triangles [f, 3] of vertices [n, 3], each twice as long as its area."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return np.cross(b - a, c - a)


def triangle_areas(vertices: Points, triangles: Triangles) -> NDArray[np.float64]:
    """Return the areas [f] of triangles, in squared units."""
    return np.linalg.norm(doubled_area_vectors(vertices, triangles), axis=1) / 2.0
