"""Wendland's C4 function (Wendland 2004, table 9.1): smoother than C2, and narrower for the same support radius."""

from __future__ import annotations

from typing import Any

from rbfevo.scoring.kernels.compact import Compact, support_radius
from rbfevo.scoring.kernels.kernel import Kernel


class WendlandC4(Compact):
    """(1 - q)^6 (35 q^2 + 18 q + 3) / 3 for q = r/s < 1, else 0; positive definite to d = 3."""

    name = "wendland_c4"
    positive_definite = True
    page = "wendland_c4"

    def phi(self, r: Any) -> Any:
        q = (r / self._radius).clip(max=1.0)
        u = (1.0 - q) * (1.0 - q)
        return u * u * u * ((35.0 * q + 18.0) * q + 3.0) / 3.0

    def slope(self, r: Any) -> Any:
        """phi'(r)/r = -56/(3 s^2) (1 - q)^5 (5 q + 1) with q = r/s, and 0 from s on."""
        q = (r / self._radius).clip(max=1.0)
        u = 1.0 - q
        u2 = u * u
        return (-56.0 / (3.0 * self._radius**2)) * u2 * u2 * u * (5.0 * q + 1.0)


def wendland_c4(
    dimension: int, default_support: float, diagonal: float | None = None, support: float | str | None = None
) -> Kernel:
    """Wendland's C4 function; arguments and errors as of `wendland`."""
    return WendlandC4(support_radius("Wendland's C4 function", dimension, default_support, diagonal, support))
