"""The Gaussian (Fasshauer, Meshfree Approximation Methods with MATLAB, 2007, section 2.1)."""

from __future__ import annotations

from typing import Any

from rbfevo.geometry.namespaces import namespace
from rbfevo.scoring.kernels.kernel import Kernel
from rbfevo.scoring.kernels.scaled import Scaled, scale_of


class Gaussian(Scaled):
    """exp(-(r/s)^2); positive definite in every dimension.

    The wider it is, the worse the condition of U: to 1e-16 and below for scales of the size of the design.
    """

    name = "gaussian"
    positive_definite = True
    page = "gaussian"

    def phi(self, r: Any) -> Any:
        q = r / self.scale
        return namespace(r).exp(-q * q)

    def slope(self, r: Any) -> Any:
        return (-2.0 / self.scale**2) * self.phi(r)


def gaussian(
    dimension: int, default_support: float, diagonal: float | None = None, scale: float | str | None = None
) -> Kernel:
    """The Gaussian with `scale`, or where that is None with half the scenario's default support radius."""
    return Gaussian(scale_of(default_support, diagonal, scale))
