"""Wendland's C2 function (Wendland 2004)."""

from __future__ import annotations

from typing import Any

from rbfevo.scoring.kernels.compact import Compact, support_radius
from rbfevo.scoring.kernels.kernel import Kernel


class Wendland(Compact):
    """(1 - r/s)^4 (4 r/s + 1) for r < s, else 0; positive definite to d = 3.

    Raises:
        UserError: unless the support radius s is a positive number.
    """

    name = "wendland"
    positive_definite = True
    page = "wendland"

    def phi(self, r: Any) -> Any:
        """(1 - q)^4 (4 q + 1) at q = r/s below 1, else 0; of distances of any shape, NumPy or torch."""
        q = (r / self._radius).clip(max=1.0)
        u = 1.0 - q
        u = u * u  # pow(., 4) costs as much as ten products
        return u * u * (4.0 * q + 1.0)

    def slope(self, r: Any) -> Any:
        u = (1.0 - r / self._radius).clip(min=0.0)
        return (-20.0 / self._radius**2) * u**3


def wendland(
    dimension: int, default_support: float, diagonal: float | None = None, support: float | str | None = None
) -> Kernel:
    """Wendland's C2 function with `support`, or where that is None with the scenario's `default_support`.

    Args:
        dimension: d.
        default_support: model units.
        diagonal: of the scenario's box, model units, of which `support` may be a percentage.
        support: a number in model units, or a percentage such as "30%".

    Raises:
        UserError: unless the dimension is 1, 2 or 3 (beyond that it is not positive definite) and the radius positive.
    """
    return Wendland(support_radius("Wendland's C2 function", dimension, default_support, diagonal, support))
