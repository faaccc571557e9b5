"""Hardy's multiquadric (Hardy 1971; Micchelli 1986)."""

from __future__ import annotations

from typing import Any

from rbfevo.scoring.kernels.kernel import Kernel
from rbfevo.scoring.kernels.scaled import Scaled, scale_of


class Multiquadric(Scaled):
    """sqrt(1 + (r/s)^2); it grows with the distance.

    Psi is indefinite, with one positive eigenvalue, but never singular for distinct centers (Micchelli 1986).
    """

    name = "multiquadric"
    page = "multiquadric"

    def phi(self, r: Any) -> Any:
        q = r / self.scale
        return (1.0 + q * q) ** 0.5

    def slope(self, r: Any) -> Any:
        return 1.0 / (self.scale**2 * self.phi(r))


def multiquadric(
    dimension: int, default_support: float, diagonal: float | None = None, scale: float | str | None = None
) -> Kernel:
    """The multiquadric with `scale`, or where that is None with half the scenario's default support radius."""
    return Multiquadric(scale_of(default_support, diagonal, scale))
