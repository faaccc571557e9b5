"""Kernels with a support radius: piecewise polynomials of r/s that are 0 from r = s on."""

from __future__ import annotations

import math

from rbfevo.errors import UserError
from rbfevo.geometry.lengths import length
from rbfevo.scoring.kernels.kernel import Kernel


class Compact(Kernel):
    """A kernel that is 0 beyond its support radius s.

    Raises:
        UserError: unless s is a positive number.
    """

    def __init__(self, support: float) -> None:
        if not (isinstance(support, int | float) and math.isfinite(support) and support > 0):
            raise UserError(f"kernel.support={support}: the support radius must be a positive number, in model units")
        self._radius = self.support = float(support)


def support_radius(
    name: str, dimension: int, default: float, diagonal: float | None, support: float | str | None
) -> float:
    """The support radius of one of Wendland's functions, model units.

    Args:
        name: of the function; dimension: d; default: the scenario's, where `support` is None; diagonal: of the box.

    Raises:
        UserError: unless the dimension is 1, 2 or 3 (beyond that it is not positive definite) and the radius positive.
    """
    if dimension not in (1, 2, 3):
        raise UserError(f"{name} is positive definite for up to 3 dimensions, not for {dimension}")
    return default if support is None else length("kernel.support", support, diagonal)
