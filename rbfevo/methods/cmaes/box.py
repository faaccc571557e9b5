"""Coordinates in which a box has no bounds, so that CMA-ES never sees a repaired point."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Box:
    """Search coordinates u [..., D], free on all of R^D, and the points x [..., D] of a box that they stand for.

    A side with two finite bounds is scaled to [0, 1]. Then u is x itself up to a margin M of each bound, bends into the
    bound as a parabola that touches it at M outside, and is mirrored there: continuously differentiable everywhere.
    An objective that pushes linearly against a bound becomes a smooth bowl in u, which reflection (a kink) or clipping
    (a plateau) would not give; inside, and without bounds, nothing changes at all. The idea is that of pycma's
    BoundTransform; the margin here is 5% of the side (`sigma` where the other side is open), so that translating and
    scaling the box changes nothing.
    """

    MARGIN = 0.05

    def __init__(self, lower: Tensor, upper: Tensor, sigma: float) -> None:
        below, above = lower.isfinite(), upper.isfinite()
        zero, inf = torch.zeros_like(lower), torch.full_like(lower, math.inf)
        self.lower, self.upper, self.closed = lower, upper, below & above
        self.bounded = bool((below | above).any())
        self.scale = torch.where(self.closed, upper - lower, 1.0)
        self.offset = torch.where(below, lower, torch.where(above, upper, 0.0))
        self.low = torch.where(below, zero, -inf)
        self.high = torch.where(self.closed, 1.0, torch.where(above, zero, inf))
        self.margin = torch.where(self.closed, self.MARGIN, torch.full_like(lower, sigma))
        self.left, self.right = self.low - self.margin, self.high + self.margin  # where u is mirrored
        self.period = torch.where(self.closed, 2 * (self.right - self.left), 1.0)

    def to_box(self, u: Tensor) -> Tensor:
        """Points of the box for search coordinates."""
        if not self.bounded:
            return u
        turns = torch.where(self.closed, ((u - 0.5) / self.period).round(), 0.0)
        u = u - turns * self.period
        u = torch.where(u < self.left, 2 * self.left - u, u)
        u = torch.where(u > self.right, 2 * self.right - u, u)
        x = torch.where(u < self.low + self.margin, self.low + (u - self.left) ** 2 / (4 * self.margin), u)
        x = torch.where(u > self.high - self.margin, self.high - (self.right - u) ** 2 / (4 * self.margin), x)
        return (self.offset + self.scale * x).clamp(self.lower, self.upper)

    def to_search(self, x: Tensor) -> Tensor:
        """Search coordinates of points of the box, between the mirrors; the inverse of `to_box` there."""
        if not self.bounded:
            return x
        x = (x - self.offset) / self.scale
        from_low, from_high = (x - self.low).clamp(min=0), (self.high - x).clamp(min=0)
        u = torch.where(from_low < self.margin, self.left + 2 * (self.margin * from_low).sqrt(), x)
        return torch.where(from_high < self.margin, self.right - 2 * (self.margin * from_high).sqrt(), u)
