"""Closed bodies, boxes and closed surfaces: which points are within, and how far their boundary is."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.geometry.correspondence import Mask


class Solid(Protocol):
    """A closed body.

    Attributes:
        low, high: [3] its corners, model units; infinite where it is open.
    """

    low: Array
    high: Array

    def heights(self, points: Array) -> Array:
        """How far points [q, 3] are within [q], model units: 0 on the boundary, negative outside; to rounding."""
        ...


class Box:
    """The box between corners [3]; sides may be infinite."""

    def __init__(self, low: Array, high: Array) -> None:
        self.low, self.high = low, high

    def heights(self, points: Array) -> Array:
        """See `Solid`."""
        ways = np.concatenate([points - self.low, self.high - points], axis=1)
        depth = ways.min(axis=1)
        away = np.linalg.norm(np.maximum(-ways, 0.0), axis=1)
        return np.where(depth >= 0.0, depth, -away)


class Enclosed:
    """The inside of a closed surface of triangles [f, 3] into points [n, 3], wound one way."""

    def __init__(self, points: Array, triangles: Ints) -> None:
        import pyvista as pv  # which takes a while

        surface: Any = pv.PolyData.from_regular_faces(points.astype(np.float64), triangles)
        corners = points[triangles]
        six_volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        self._sign = 1.0 if six_volumes.sum() > 0 else -1.0  # wound outwards, or inwards
        self._surface = surface
        used = points[np.unique(triangles)]
        self.low, self.high = used.min(axis=0), used.max(axis=0)

    def heights(self, points: Array) -> Array:
        """See `Solid`; by VTK's signed distance to the closest triangle."""
        import pyvista as pv

        if not len(points):
            return np.empty(0)
        cloud: Any = pv.PolyData(np.ascontiguousarray(points, np.float64))
        return -self._sign * np.asarray(cloud.compute_implicit_distance(self._surface)["implicit_distance"], np.float64)


def within(solids: list[Solid], points: Array) -> Mask:
    """Which of points [q, 3] are in at least one of some bodies, their boundaries included."""
    found = np.zeros(len(points), bool)
    for solid in solids:
        near = ~found & ((points >= solid.low) & (points <= solid.high)).all(axis=1)
        found[near] = solid.heights(points[near]) >= 0.0
    return found
