"""Regions that cannot move: a smooth blend of 0 at held points and 1 at some distance from them."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING

import numpy as np

from rbfevo.arrays import Array
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.planar import Plane

if TYPE_CHECKING:
    from scipy.spatial import KDTree


@dataclasses.dataclass(frozen=True)
class Hold:
    """The blend beta of held points: a function of space, 0 at the points and 1 from `width` on, that multiplies U.

    With t the distance to the nearest held point over the width, beta = t^3 (10 - 15 t + 6 t^2), whose first two
    derivatives vanish at both ends: what a smooth kernel deforms stays smooth but where two held points are equally
    near.

    Attributes:
        points: [h, d] held points, model units; width: in model units, positive.
        mirror: a plane of symmetry, or None: the images of held points are held too.
        plane: the mid-plane of a planar design, or None: distances are then those within the plane.
    """

    points: Array
    width: float
    mirror: Mirror | None = None
    plane: Plane | None = None

    @functools.cached_property
    def _tree(self) -> KDTree:
        from scipy.spatial import KDTree  # which takes a while, and most commands need none

        points = self.points if self.plane is None else self.plane.pinned(self.points)
        if self.mirror is not None:
            points = np.concatenate([points, self.mirror.image(points)])
        return KDTree(points)

    def __call__(self, points: Array) -> Array:
        """The blend [q] at points [q, d], from 0 to 1, float64."""
        points = points if self.plane is None else self.plane.pinned(points)
        t = np.minimum(self._tree.query(points)[0] / self.width, 1.0)
        return t**3 * (10.0 + t * (6.0 * t - 15.0))
