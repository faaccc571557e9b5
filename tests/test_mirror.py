"""The symmetry plane: what lies on it within rounding, wherever it is, and what images are."""

from __future__ import annotations

import math

import pytest
import torch

from rbfevo.geometry.mirror import Mirror


@pytest.mark.parametrize("at", [0.0, 0.1, -0.7, 1e6 + 0.1, 1e-6])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rounding_at_the_plane_is_no_distance(axis: int, at: float) -> None:
    middle = torch.full((3,), at, dtype=torch.float64)
    size = min(1.0, abs(at)) or 1.0
    mirror = Mirror.across(axis, at, middle - size, middle + 2.0 * size)
    steps = [at, math.nextafter(at, math.inf), math.nextafter(math.nextafter(at, -math.inf), -math.inf)]
    points = middle + 0.3 * size
    points = points.repeat(len(steps) + 2, 1)
    points[:3, axis] = torch.tensor(steps, dtype=torch.float64)
    points[3, axis], points[4, axis] = at + 1e-6 * size, at - 1e-6 * size
    assert mirror.on_plane(points).tolist() == [True, True, True, False, False]
    snapped = mirror.snapped(points)
    assert torch.equal(snapped[:3, axis], torch.full((3,), at, dtype=torch.float64))
    assert torch.equal(snapped[3:], points[3:])
    assert torch.equal(mirror.image(snapped)[:3], snapped[:3])  # their own images, to the last bit
    others = [other for other in range(3) if other != axis]
    assert torch.equal(mirror.image(points)[:, others], points[:, others])
    image = mirror.image(points)[3, axis]
    assert float(image - at) == pytest.approx(-float(points[3, axis] - at), abs=4e-16 * abs(at))
