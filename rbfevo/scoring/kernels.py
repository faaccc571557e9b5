"""Radial basis functions phi(r) and their slopes phi'(r)/r, as torch modules (paper, section 3)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from rbfevo.errors import UserError


class Kernel(nn.Module):
    """A radial basis function of the distance.

    `forward(r)` is phi(r), elementwise for distances r >= 0 of any shape; `slope(r)` is phi'(r)/r, which times the
    difference vector c - x is the gradient of phi(|c - x|) in c. Where that product has the limit 0 at r = 0 although
    the slope itself has none, `slope(0)` is 0.

    Attributes:
        name: as on the command line.
        support: support radius in model units, or None for a kernel that reaches everywhere.
        positive_definite: whether Psi is positive definite for distinct centers.
    """

    name: str = ""
    support: float | None = None
    positive_definite: bool = False

    def forward(self, r: Tensor) -> Tensor:
        raise TypeError(f"{type(self).__name__} does not define phi")

    def slope(self, r: Tensor) -> Tensor:
        """phi'(r)/r for distances r, elementwise."""
        raise TypeError(f"{type(self).__name__} does not define its slope")


class Wendland(Kernel):
    """Wendland's C2 function (1 - r/s)^4 (4 r/s + 1) for r < s, else 0 (Wendland 2004; positive definite to d = 3)."""

    name = "wendland"
    positive_definite = True

    def __init__(self, support: float) -> None:
        super().__init__()
        if not (isinstance(support, int | float) and math.isfinite(support) and support > 0):
            raise UserError(f"kernel.support={support}: the support radius must be a positive number, in model units")
        self._radius = self.support = float(support)

    def forward(self, r: Tensor) -> Tensor:
        q = (r / self._radius).clamp(max=1.0)
        u = (1.0 - q).square()  # pow(., 4) costs as much as ten products
        return u * u * (4.0 * q + 1.0)

    def slope(self, r: Tensor) -> Tensor:
        u = (1.0 - r / self._radius).clamp(min=0.0)
        return (-20.0 / self._radius**2) * u**3


class ThinPlate(Kernel):
    """The thin-plate spline r^2 log r, 0 at r = 0: the paper's triharmonic kernel on the plane."""

    name = "triharmonic"

    def forward(self, r: Tensor) -> Tensor:
        q = r * r
        return 0.5 * torch.special.xlogy(q, q)

    def slope(self, r: Tensor) -> Tensor:
        return torch.where(r > 0, 2.0 * torch.log(r) + 1.0, 0.0)


class Cubic(Kernel):
    """The cubic r^3: the paper's triharmonic kernel in space."""

    name = "triharmonic"

    def forward(self, r: Tensor) -> Tensor:
        return r * r * r

    def slope(self, r: Tensor) -> Tensor:
        return 3.0 * r


def wendland(
    dimension: int, default_support: float, diagonal: float | None = None, support: float | str | None = None
) -> Kernel:
    """Wendland's C2 function with `support`, or where that is None with the scenario's `default_support`.

    Args:
        dimension: d.
        default_support: model units.
        diagonal: of the scenario's box, model units, of which `support` may be a percentage.
        support: a number in model units, or a word such as "30%".

    Raises:
        UserError: unless the dimension is 1, 2 or 3 (beyond that it is not positive definite) and the radius positive.
    """
    if dimension not in (1, 2, 3):
        raise UserError(f"Wendland's C2 function is positive definite for up to 3 dimensions, not for {dimension}")
    return Wendland(default_support if support is None else length("kernel.support", support, diagonal))


def length(key: str, value: float | str, diagonal: float | None) -> float:
    """A length in model units: a positive number, or a percentage of the box's diagonal, such as "30%".

    Raises:
        UserError: naming `key`, for anything else.
    """
    text = str(value).strip()
    number, percent = (text[:-1], True) if text.endswith("%") else (text, False)
    try:
        found = float(number)
    except ValueError:
        found = math.nan
    if not (math.isfinite(found) and found > 0) or isinstance(value, bool) or (percent and diagonal is None):
        raise UserError(
            f"{key}={value}: it must be a positive number, in model units, or a percentage of the box's diagonal, "
            "such as 30%"
        )
    return found / 100.0 * diagonal if percent and diagonal is not None else found


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


def distances(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distances [*pop, p, q] between points a [*pop, p, d] and b [*pop, q, d], without cancellation.

    The differences are formed before squaring: |a|^2 - 2ab + |b|^2 would lose half of the digits of small distances.
    """
    squared = (a[..., :, None, 0] - b[..., None, :, 0]).square_()
    for axis in range(1, a.shape[-1]):
        difference = a[..., :, None, axis] - b[..., None, :, axis]
        squared.addcmul_(difference, difference)
    return squared.sqrt_()
