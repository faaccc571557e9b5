"""What the paper calls triharmonic: the thin-plate spline on the plane, the cubic in space."""

from __future__ import annotations

from typing import Any

from rbfevo.errors import UserError
from rbfevo.geometry.namespaces import namespace
from rbfevo.scoring.kernels.kernel import Kernel


class ThinPlate(Kernel):
    """The thin-plate spline r^2 log r, 0 at r = 0: the paper's triharmonic kernel on the plane."""

    name = "triharmonic"
    page = "thin_plate"

    def phi(self, r: Any) -> Any:
        xp, q = namespace(r), r * r
        return 0.5 * (q * xp.log(xp.where(q > 0, q, 1.0)))

    def slope(self, r: Any) -> Any:
        xp = namespace(r)
        return xp.where(r > 0, 2.0 * xp.log(xp.where(r > 0, r, 1.0)) + 1.0, 0.0)


class Cubic(Kernel):
    """The cubic r^3: the paper's triharmonic kernel in space."""

    name = "triharmonic"
    page = "cubic"

    def phi(self, r: Any) -> Any:
        return r * r * r

    def slope(self, r: Any) -> Any:
        return 3.0 * r


def triharmonic(dimension: int, default_support: float | None = None, diagonal: float | None = None) -> Kernel:
    """The paper's triharmonic kernel: r^2 log r for d = 2, r^3 for d = 3; it has no use for a support radius.

    Raises:
        UserError: for any other dimension.
    """
    if dimension == 2:
        return ThinPlate()
    if dimension == 3:
        return Cubic()
    raise UserError(f"the triharmonic kernel is defined here for 2 and 3 dimensions, not for {dimension}")
