"""The plane: its grid, its height field against a plain Python oracle, its sampler, and what it refuses."""

import math
import random

import pytest
import torch

from rbfevo.errors import UserError
from rbfevo.scenarios import plane
from rbfevo.scenarios.plane import height_field


def heights_by_hand(x: float, y: float) -> float:
    """The test function of Giannelli et al. 2012, case by case."""
    u, v = y, x
    if v - u >= 0.5:
        return 1.0
    if v - u >= 0.0:
        return 2.0 * (v - u)
    q = (u - 1.5) ** 2 + (v - 0.5) ** 2
    return (math.cos(4.0 * math.pi * math.sqrt(q)) + 1.0) / 2.0 if q <= 1.0 / 16.0 else 0.0


def test_height_field_is_the_published_one():
    draw = random.Random(0)
    points = [(draw.random(), 2.0 * draw.random()) for _ in range(2000)]
    expected = torch.tensor([heights_by_hand(x, y) for x, y in points], dtype=torch.float64)
    found = height_field(torch.tensor(points, dtype=torch.float64))
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize(
    ("x", "y", "height"),
    [
        (0.5, 1.5, 1.0),  # top of the bump
        (0.5, 1.75, 0.0),  # its foot
        (0.5, 1.375, 0.5),  # half way down
        (1.0, 0.0, 1.0),  # plateau
        (1.0, 0.5, 1.0),  # its edge
        (0.75, 0.5, 0.5),  # on the ramp
        (0.0, 0.0, 0.0),  # foot of the ramp
        (0.1, 0.9, 0.0),
    ],
)
def test_height_field_values(x, y, height):
    found = height_field(torch.tensor([[x, y]], dtype=torch.float64))
    assert found.shape == (1,)
    assert found.item() == pytest.approx(height, abs=1e-12)


def test_height_field_is_continuous():
    x, y = torch.meshgrid(
        torch.linspace(0.0, 1.0, 801, dtype=torch.float64),
        torch.linspace(0.0, 2.0, 1601, dtype=torch.float64),
        indexing="ij",
    )
    z = height_field(torch.stack([x, y], dim=-1).reshape(-1, 2)).reshape(x.shape)
    steepest = 2.0 * math.pi / 800.0  # slope of the bump times the grid's step
    assert z.diff(dim=0).abs().max() <= steepest
    assert z.diff(dim=1).abs().max() <= steepest


@pytest.mark.parametrize(("nx", "ny"), [(2, 2), (3, 7), (150, 150)])
def test_grid_covers_the_box(nx, ny):
    scenario = plane(resolution=(nx, ny))
    assert scenario.vertices.shape == (nx * ny, 2)
    assert scenario.vertices.dtype == torch.float64
    assert scenario.faces.shape == (2 * (nx - 1) * (ny - 1), 3)
    assert scenario.faces.dtype == torch.int64
    assert scenario.vertices.min(dim=0).values.tolist() == [0.0, 0.0]
    assert scenario.vertices.max(dim=0).values.tolist() == [1.0, 2.0]
    assert len(torch.unique(scenario.vertices[:, 0])) == nx
    assert len(torch.unique(scenario.vertices[:, 1])) == ny
    a, b, c = scenario.vertices[scenario.faces].unbind(1)
    areas = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2.0
    torch.testing.assert_close(areas, torch.full_like(areas, 1.0 / ((nx - 1) * (ny - 1))))


def test_gradient_is_the_scaled_height_field():
    scenario = plane()
    assert scenario.name == "plane"
    assert scenario.support == 0.5
    assert scenario.gradient.shape == (22500, 1)
    assert scenario.gradient.norm().item() == pytest.approx(1.0, abs=1e-14)
    torch.testing.assert_close(scenario.gradient[:, 0] * scenario.gradient_norm, height_field(scenario.vertices))
    assert torch.equal(scenario.weights, torch.ones(22500, dtype=torch.float64))


def test_sampler_is_uniform_in_the_box_and_seeded():
    scenario = plane(resolution=(4, 4))
    first = scenario.sample(400, 25, torch.Generator().manual_seed(1))
    again = scenario.sample(400, 25, torch.Generator().manual_seed(1))
    other = scenario.sample(400, 25, torch.Generator().manual_seed(2))
    assert first.shape == (400, 25, 2)
    assert first.dtype == torch.float64
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert (first >= scenario.lower).all()
    assert (first <= scenario.upper).all()
    flat = first.reshape(-1, 2) / scenario.upper
    counts = torch.histogramdd(flat, bins=[4, 4], range=[0.0, 1.0, 0.0, 1.0]).hist
    chi_squared = ((counts - 625.0) ** 2 / 625.0).sum().item()
    assert chi_squared < 37.7  # 0.999 quantile for 15 degrees of freedom


@pytest.mark.parametrize(
    "resolution",
    [(1, 5), (5, 1), (0, 0), (-3, 4), (3,), (3, 3, 3), (), (3.0, 3), ("3", "3"), "33", 150, None, (True, 3)],
)
def test_bad_resolution(resolution):
    with pytest.raises(UserError, match="two whole numbers of at least 2") as caught:
        plane(resolution=resolution)
    assert "\n" not in str(caught.value)
