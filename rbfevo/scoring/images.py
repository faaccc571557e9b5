"""What mirror images of the centers add to the columns of U."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from rbfevo.geometry.mirror import Mirror
from rbfevo.scoring.distances import distances
from rbfevo.scoring.kernels import Kernel


class Image(NamedTuple):
    """What the mirror images add to the columns of U: sign +1 for components along the plane, -1 across it."""

    mirror: Mirror
    sign: float


def values(kernel: Kernel, centers: Tensor, points: Tensor, image: Image | None) -> Tensor:
    """phi(|c - x|), plus or minus that of the images of the centers: centers [*pop, m, d], points [*pop, q, d].

    Returns [*pop, m, q]; symmetric where the points are the centers.
    """
    plain = kernel(distances(centers, points))
    if image is None:
        return plain
    return plain + image.sign * kernel(distances(image.mirror.image(centers), points))
