"""From points to centers: folded, pinned to the plane, and out of regions; and gradients on the way back."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.parameterization import BoxRegion, Parameterization, VertexRegion

ONES = torch.ones(3, dtype=torch.float64)
MIRROR = Mirror.across(1, 0.2, -2 * ONES, 2 * ONES)


def points(*shape: int) -> torch.Tensor:
    return 4 * torch.rand(*shape, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 2


def check_pull(place: Parameterization, where: torch.Tensor) -> None:
    """The pulled gradient of a linear function of the centers is that of differences."""
    slope = points(*where.shape[:-1])
    pulled = place.pull(where, slope)
    h = 1e-7
    for way in points(3, *where.shape[:-1]):
        ahead, behind = (slope * place(where + h * way)).sum(), (slope * place(where - h * way)).sum()
        torch.testing.assert_close((pulled * way).sum(), (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-6)


def test_without_mirror_and_region_it_is_the_identity() -> None:
    where = points(4, 5)
    assert Parameterization()(where) is where
    assert Parameterization().pull(where, where) is where


def test_centers_are_folded_to_one_side_and_the_last_of_an_odd_number_lies_on_the_plane() -> None:
    where = points(6, 5)
    for side in (1.0, -1.0):
        place = Parameterization(MIRROR, side)
        centers = place(where)
        assert bool((side * (centers[..., 1] - 0.2) >= 0).all())
        assert bool((centers[:, -1, 1] == 0.2).all())
        kept = (centers - where).abs()[..., [0, 2]]
        assert bool((kept == 0).all())
        torch.testing.assert_close((centers[:, :4, 1] - 0.2).abs(), (where[:, :4, 1] - 0.2).abs())
        torch.testing.assert_close(place(centers), centers, rtol=0, atol=0)
        check_pull(place, where)
        even = place(where[:, :4])
        assert not bool((even[:, -1, 1] == 0.2).any())


def test_a_heuristic_gives_up_its_center_nearest_to_the_plane() -> None:
    centers = torch.tensor([[[0.0, 1.0, 0.0], [1.0, 0.3, 0.0], [2.0, -0.9, 0.0]]], dtype=torch.float64)
    settled = Parameterization(MIRROR).settle(centers)
    assert settled.tolist() == [[[2.0, 1.3, 0.0], [0.0, 1.0, 0.0], [1.0, 0.2, 0.0]]]


def test_centers_leave_a_box_by_its_nearest_side() -> None:
    region = BoxRegion(
        torch.tensor([-1.0, -1.0, -torch.inf]), torch.tensor([1.0, 1.0, torch.inf]), (-2 * ONES, 2 * ONES)
    )
    inside = torch.tensor([[0.9, 0.0, 0.0], [0.0, -0.8, 1.9], [1.5, 0.0, 0.0]], dtype=torch.float64)
    placed, moved = region.project(inside)
    assert placed.tolist() == [[1.0, 0.0, 0.0], [0.0, -1.0, 1.9], [1.5, 0.0, 0.0]]
    assert moved.tolist() == [[True, False, False], [False, True, False], [False, False, False]]
    check_pull(Parameterization(region=region), points(5, 4))


def test_a_side_beyond_the_scenarios_box_is_no_way_out() -> None:
    region = BoxRegion(torch.tensor([1.0, -3.0, -3.0]), torch.tensor([5.0, 3.0, 3.0]), (-2 * ONES, 2 * ONES))
    placed, _ = region.project(torch.tensor([[1.9, 0.0, 0.0]], dtype=torch.float64))
    assert placed.tolist() == [[1.0, 0.0, 0.0]]


def test_centers_closest_to_a_fixed_vertex_go_to_the_nearest_free_one() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], dtype=torch.float64)
    region = VertexRegion(vertices, torch.tensor([True, True, False, False]))
    where = torch.tensor([[0.4, 0.1, 0], [1.4, 0.1, 0], [1.6, 0.1, 0], [torch.nan, 0, 0]], dtype=torch.float64)
    placed, moved = region.project(where)
    assert placed[2].tolist() == [1.6, 0.1, 0.0]
    assert moved[:, 0].tolist() == [True, True, False, False]
    assert bool(placed[3, 0].isnan())
    assert not bool(region.contains(placed).any())
    stop = (placed[:2] - vertices[2]).norm(dim=1)  # on their way to the vertex, not upon it: two of them do not meet
    torch.testing.assert_close(stop, torch.full((2,), 0.45, dtype=torch.float64))
    assert float((placed[0] - placed[1]).norm()) > 1e-3


@given(
    ends=st.lists(st.tuples(st.floats(-1.9, 1.9), st.floats(-1.9, 1.9)), min_size=3, max_size=3),
    side=st.sampled_from([1.0, -1.0]),
    count=st.integers(1, 6),
    seed=st.integers(0, 1000),
)
def test_neither_centers_nor_images_sit_in_a_box(
    ends: list[tuple[float, float]], side: float, count: int, seed: int
) -> None:
    """Whatever the box and the side: with three open axes there is always a way out, on the plane as well."""
    low, high = (torch.tensor([pick(pair) for pair in ends], dtype=torch.float64) for pick in (min, max))
    mirror = Mirror.across(1, 0.2, -2 * ONES, 2 * ONES)
    region = BoxRegion(low, high, (-2 * ONES, 2 * ONES), mirror)
    where = 4 * torch.rand(20, count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 2
    centers = Parameterization(mirror, side, region)(where)
    for points in (centers, mirror.image(centers)):
        inside = ((points > low + 1e-12) & (points < high - 1e-12)).all(-1)
        assert not bool(inside.any())
    assert bool((side * (centers[..., 1] - 0.2) >= 0).all())
    if count % 2:
        assert bool((centers[:, -1, 1] == 0.2).all())


def test_neither_centers_nor_images_are_closest_to_a_fixed_vertex() -> None:
    generator = torch.Generator().manual_seed(4)
    vertices = 4 * torch.rand(300, 3, generator=generator, dtype=torch.float64) - 2
    fixed = vertices[:, 0] > 0.5
    region = VertexRegion(vertices, fixed, MIRROR)
    centers = Parameterization(MIRROR, 1.0, region)(points(50, 4))
    for where in (centers, MIRROR.image(centers)):
        nearest = torch.cdist(where, vertices).argmin(-1)
        assert not bool(fixed[nearest].any())
    assert float(torch.cdist(centers, centers)[:, *torch.triu_indices(4, 4, 1)].min()) > 0


def test_mirror_and_region_pull_gradients_back() -> None:
    region = BoxRegion(torch.tensor([-1.0, -3.0, -3.0]), torch.tensor([1.0, 3.0, 3.0]), (-2 * ONES, 2 * ONES), MIRROR)
    place = Parameterization(MIRROR, 1.0, region)
    where = points(8, 5)
    centers = place(where)
    assert bool((centers[..., 0].abs() >= 1.0).all())
    check_pull(place, where)
