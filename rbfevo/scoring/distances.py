"""Distances between points, without cancellation."""

from __future__ import annotations

from torch import Tensor


def distances(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distances [*pop, p, q] between points a [*pop, p, d] and b [*pop, q, d], without cancellation.

    The differences are formed before squaring: |a|^2 - 2ab + |b|^2 would lose half of the digits of small distances.
    """
    squared = (a[..., :, None, 0] - b[..., None, :, 0]).square_()
    for axis in range(1, a.shape[-1]):
        difference = a[..., :, None, axis] - b[..., None, :, axis]
        squared.addcmul_(difference, difference)
    return squared.sqrt_()
