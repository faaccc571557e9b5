"""Wendland's C0 function (Wendland 2004, table 9.1): a cusp at each center."""

from __future__ import annotations

from typing import Any

from rbfevo.geometry.namespaces import namespace
from rbfevo.scoring.kernels.compact import Compact, support_radius
from rbfevo.scoring.kernels.kernel import Kernel

TIP = 1e-150  # a smaller distance is 0: its reciprocal could be infinite


class WendlandC0(Compact):
    """(1 - r/s)^2 for r < s, else 0; positive definite to d = 3.

    It has a cusp at r = 0: a surface that passes through a center gets a peak there, and phi has no gradient in a
    center that sits on a vertex, where `slope` is 0.
    """

    name = "wendland_c0"
    positive_definite = True
    page = "wendland_c0"

    def phi(self, r: Any) -> Any:
        u = 1.0 - (r / self._radius).clip(max=1.0)
        return u * u

    def slope(self, r: Any) -> Any:
        xp, u = namespace(r), (1.0 - r / self._radius).clip(min=0.0)
        apart = r > TIP
        return xp.where(apart, (-2.0 / self._radius) * u / xp.where(apart, r, 1.0), 0.0 * u)


def wendland_c0(
    dimension: int, default_support: float, diagonal: float | None = None, support: float | str | None = None
) -> Kernel:
    """Wendland's C0 function; arguments and errors as of `wendland`."""
    return WendlandC0(support_radius("Wendland's C0 function", dimension, default_support, diagonal, support))
