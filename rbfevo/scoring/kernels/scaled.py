"""Kernels that reach everywhere and have a scale, a length at which they change."""

from __future__ import annotations

import math

from rbfevo.errors import UserError
from rbfevo.geometry.lengths import length
from rbfevo.scoring.kernels.kernel import Kernel

DEFAULT = 0.5  # of the scenario's default support radius: about where Wendland's C2 function has fallen to a fifth


class Scaled(Kernel):
    """A kernel of r/s with a scale s and without a support radius.

    Raises:
        UserError: unless s is a positive number.
    """

    def __init__(self, scale: float) -> None:
        if not (isinstance(scale, int | float) and math.isfinite(scale) and scale > 0):
            raise UserError(f"kernel.scale={scale}: the scale must be a positive number, in model units")
        self.scale = float(scale)

    def numbers(self) -> dict[str, float]:
        """The scale."""
        return {"scale": self.scale}


def scale_of(default_support: float, diagonal: float | None, scale: float | str | None) -> float:
    """`scale` in model units: a number or a percentage of the diagonal of the box; None: half the default support.

    Raises:
        UserError: unless it is positive.
    """
    return DEFAULT * default_support if scale is None else length("kernel.scale", scale, diagonal)
