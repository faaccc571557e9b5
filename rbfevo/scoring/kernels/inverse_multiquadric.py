"""The inverse multiquadric (Hardy 1971; Fasshauer 2007, section 4.4)."""

from __future__ import annotations

from typing import Any

from rbfevo.scoring.kernels.kernel import Kernel
from rbfevo.scoring.kernels.scaled import Scaled, scale_of


class InverseMultiquadric(Scaled):
    """1 / sqrt(1 + (r/s)^2); positive definite in every dimension."""

    name = "inverse_multiquadric"
    positive_definite = True
    page = "inverse_multiquadric"

    def phi(self, r: Any) -> Any:
        q = r / self.scale
        return (1.0 + q * q) ** -0.5

    def slope(self, r: Any) -> Any:
        phi = self.phi(r)
        return (-1.0 / self.scale**2) * phi * phi * phi


def inverse_multiquadric(
    dimension: int, default_support: float, diagonal: float | None = None, scale: float | str | None = None
) -> Kernel:
    """The inverse multiquadric with `scale`, or where that is None with half the scenario's default support radius."""
    return InverseMultiquadric(scale_of(default_support, diagonal, scale))
