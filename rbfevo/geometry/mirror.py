"""Symmetry about a plane: every center has a mirror image, and the two move as mirror images of each other.

With c' the image of c, the displacement that the parameters p_c cause is phi(|c - x|) p_c + phi(|c' - x|) p_c', where
p_c' is p_c with the sign of its component across the plane changed. So column c of U is phi_c + phi_c' for the
components of a displacement along the plane, and phi_c - phi_c' for the component across it.

A center on the plane is its own image: it counts twice along the plane and has no column across. So R jumps there: of
a pair that comes close, the column across vanishes and takes R with it, while a center on the plane has none to lose.
Searches therefore keep the number of centers on the plane, except for those that a bound stops exactly there.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbfevo.errors import UserError
from rbfevo.geometry.namespaces import copied, namespace

ON_PLANE = 1e-12  # of the box's diagonal: a center that close to the plane is its own image
ROUNDING = 8 * float(np.finfo(np.float64).eps)  # of the largest coordinate of the box: the same far from the origin


class Mirror(NamedTuple):
    """The plane on which coordinate `axis` is `at` (model units); within `tolerance` of it a center lies on it.

    Points are arrays of NumPy or tensors of torch.
    """

    axis: int
    at: float
    tolerance: float = 0.0

    @staticmethod
    def across(axis: int, at: float, lower: Any, upper: Any) -> Mirror:
        """The plane through a box [d], [d], with the tolerance that belongs to the box.

        Raises:
            UserError: if the plane does not cross the box.
        """
        if not float(lower[axis]) <= at <= float(upper[axis]):
            raise UserError(
                f"the symmetry plane {'xyz'[axis]} = {at:g} does not cross the box ({'xyz'[axis]} from "
                f"{float(lower[axis]):g} to {float(upper[axis]):g}); check scenario.symmetry_at"
            )
        return Mirror.of_box(axis, at, lower, upper)

    @staticmethod
    def of_box(axis: int, at: float, lower: Any, upper: Any) -> Mirror:
        """A plane with the tolerance that belongs to a box [d], [d], which it need not cross."""
        low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        farthest = float(np.abs([low, high]).max())
        return Mirror(axis, at, max(ON_PLANE * float(np.linalg.norm(high - low)), ROUNDING * farthest))

    def image(self, points: Any) -> Any:
        """Mirror images of points [..., d]."""
        images = copied(points)
        images[..., self.axis] = 2.0 * self.at - points[..., self.axis]
        return images

    def on_plane(self, points: Any) -> Any:
        """Which of points [..., d] lie on the plane, [...] bool."""
        return abs(points[..., self.axis] - self.at) <= self.tolerance

    def snapped(self, points: Any) -> Any:
        """Points [..., d], those on the plane exactly on it, so that they are their own images to the last bit."""
        points = copied(points)
        points[..., self.axis] = namespace(points).where(self.on_plane(points), self.at, points[..., self.axis])
        return points
