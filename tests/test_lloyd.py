"""Lloyd against scikit-learn, against NumPy, and against what k-means must satisfy."""

import numpy as np
import pytest
import torch
import trimesh
from sklearn.cluster import KMeans

from rbfevo.errors import UserError
from rbfevo.methods.lloyd import _seed, _step, inertia, lloyd


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=seeded(seed), dtype=torch.float64)


def plane() -> torch.Tensor:
    x, y = (torch.linspace(0.0, high, 150, dtype=torch.float64) for high in (1.0, 2.0))
    return torch.cartesian_prod(x, y)


def sphere() -> torch.Tensor:
    return torch.tensor(np.asarray(trimesh.creation.icosphere(subdivisions=5).vertices))


def scikit_learn(X: torch.Tensor, count: int, weights: torch.Tensor | None = None) -> float:
    """Inertia that scikit-learn reaches from ten starts."""
    model = KMeans(count, n_init=10, random_state=0)  # pyright: ignore[reportArgumentType]
    model.fit(X.numpy(), sample_weight=None if weights is None else weights.numpy())
    return float(model.inertia_ or 0.0)


def squares(X: np.ndarray, C: np.ndarray) -> np.ndarray:
    return ((X[:, None] - C) ** 2).sum(-1)


@pytest.mark.parametrize("mesh", [plane, sphere])
def test_inertia_is_within_two_percent_of_scikit_learn(mesh):
    X = mesh()
    reference = scikit_learn(X, 25)
    for seed in range(3):
        centers = lloyd(X, 25, generator=seeded(seed))
        assert centers.shape == (25, X.shape[1])
        assert centers.dtype == torch.float64
        assert float(inertia(X, centers)) <= 1.02 * reference


def test_weighted_inertia_is_within_two_percent_of_scikit_learn():
    X, w = random(6000, 3), random(6000, seed=1) ** 4 + 1e-3
    reference = scikit_learn(X, 12, w)
    assert float(inertia(X, lloyd(X, 12, generator=seeded(), weights=w), w)) <= 1.02 * reference


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_inertia_is_the_sum_of_squared_distances_to_the_nearest_center(batch):
    X, C, w = random(50, 2), random(*batch, 4, 2, seed=1), random(50, seed=2)
    for weights in (None, w):
        mass = np.ones(50) if weights is None else weights.numpy()
        flat = [mass @ squares(X.numpy(), c).min(1) for c in C.reshape(-1, 4, 2).numpy()]
        values = inertia(X, C, weights)
        assert values.shape == batch
        np.testing.assert_allclose(values.reshape(-1).numpy(), flat, rtol=1e-13)


@pytest.mark.parametrize(("n", "count"), [(300, 7), (9000, 10)])  # below and above the size at which a part runs first
def test_centers_are_the_centroids_of_their_cells(n, count):
    X, w = random(n, 3), random(n, seed=1) + 0.1
    C = lloyd(X, count, generator=seeded(), weights=w, iterations=1000).numpy()
    cell = squares(X.numpy(), C).argmin(1)
    centroids = [np.average(X.numpy()[cell == j], axis=0, weights=w.numpy()[cell == j]) for j in range(count)]
    np.testing.assert_allclose(C, centroids, atol=1e-12)


def test_batch_of_starts_steps_as_each_alone_does():
    X, w, C = random(500, 3), random(500, seed=1) + 0.1, random(4, 9, 3, seed=2)
    moved, value = _step(X, w, C)
    for i in range(4):
        alone, value_alone = _step(X, w, C[i : i + 1])
        torch.testing.assert_close(moved[i], alone[0], rtol=1e-13, atol=1e-13)
        torch.testing.assert_close(value[i], value_alone[0], rtol=1e-12, atol=0.0)
        torch.testing.assert_close(value[i], inertia(X, C[i], w), rtol=1e-12, atol=0.0)
        cell = squares(X.numpy(), C[i].numpy()).argmin(1)
        for j in np.unique(cell):
            mean = np.average(X.numpy()[cell == j], axis=0, weights=w.numpy()[cell == j])
            np.testing.assert_allclose(moved[i, j].numpy(), mean, atol=1e-13)


def test_starts_are_drawn_by_squared_distance_and_weight():
    """A thousand vertices near the origin, and four far off, which are drawn unless they weigh next to nothing."""
    far = torch.tensor([[50.0, 0.0], [0.0, 50.0], [-50.0, 0.0], [0.0, -50.0]], dtype=torch.float64)
    X = torch.cat([1e-3 * random(1000, 2), far])
    seeds = _seed(X, torch.ones(1004, dtype=torch.float64), 5, 20, seeded())
    assert bool((torch.cdist(far, seeds).amin(-1) == 0).all())
    mass = torch.cat([torch.ones(1000), torch.full((4,), 1e-18)]).double()
    seeds = _seed(X, mass, 5, 20, seeded())
    assert bool((torch.linalg.vector_norm(seeds, dim=-1) < 1.0).all())


def test_more_iterations_never_raise_the_inertia():
    X = random(2000, 2)
    values = [float(inertia(X, lloyd(X, 15, generator=seeded(3), starts=1, iterations=i))) for i in (1, 2, 4, 8, 50)]
    assert values == sorted(values, reverse=True)
    assert values[-1] < 0.97 * values[0]


def test_more_starts_do_better_in_the_median():
    X = random(400, 2)
    one, ten = (
        np.median([float(inertia(X, lloyd(X, 20, generator=seeded(s), starts=starts))) for s in range(15)])
        for starts in (1, 10)
    )
    assert ten < one


def test_whole_weights_count_as_repeated_vertices():
    X, times = random(200, 2), torch.randint(1, 5, (200,), generator=seeded(1))
    repeated = X.repeat_interleave(times, 0)
    C = lloyd(X, 6, generator=seeded(), weights=times.double(), starts=40)
    D = lloyd(repeated, 6, generator=seeded(), starts=40)
    torch.testing.assert_close(inertia(X, C, times.double()), inertia(repeated, C))
    torch.testing.assert_close(inertia(repeated, C), inertia(repeated, D), rtol=5e-3, atol=0.0)


@pytest.mark.parametrize("seed", range(5))
def test_well_separated_blobs_get_one_center_each(seed):
    middles = 10.0 * torch.cartesian_prod(torch.arange(3.0), torch.arange(3.0)).double()
    X = (middles[:, None] + random(9, 60, 2, seed=seed) - 0.5).reshape(-1, 2)
    C = lloyd(X, 9, generator=seeded(seed))
    expected = X.reshape(9, 60, 2).mean(1)
    nearest = torch.cdist(expected, C).argmin(1)
    assert sorted(nearest.tolist()) == list(range(9))
    torch.testing.assert_close(C[nearest], expected, rtol=0.0, atol=1e-12)


def test_same_seed_gives_the_same_centers_and_another_seed_others():
    X = random(5000, 3)
    first = lloyd(X, 10, generator=seeded(4))
    assert torch.equal(first, lloyd(X, 10, generator=seeded(4)))
    assert not torch.equal(first, lloyd(X, 10, generator=seeded(5)))


def test_moving_and_scaling_the_vertices_moves_and_scales_the_centers():
    X = random(1000, 3)
    C = lloyd(X, 8, generator=seeded())
    moved = lloyd(1e-3 * X + 1000.0, 8, generator=seeded())
    torch.testing.assert_close(moved, 1e-3 * C + 1000.0, rtol=0.0, atol=1e-11)


def test_one_center_is_the_weighted_mean():
    X, w = random(40, 3), random(40, seed=1)
    torch.testing.assert_close(lloyd(X, 1, generator=seeded(), weights=w)[0], w @ X / w.sum())


def test_centers_on_a_sphere_are_centroids_inside_it():
    C = lloyd(sphere(), 25, generator=seeded())
    norms = torch.linalg.vector_norm(C, dim=1)
    assert bool(((norms > 0.85) & (norms < 0.98)).all())


@pytest.mark.parametrize("copies", [1, 3, 1000])
def test_as_many_centers_as_distinct_vertices_cover_them(copies):
    X = random(12, 2).repeat(copies, 1)
    C = lloyd(X, 12, generator=seeded())
    assert float(inertia(X, C)) < 1e-22
    assert len(C.unique(dim=0)) == 12


def test_rare_vertices_among_many_copies_are_found():
    """All vertices but nine coincide, so that the part on which the starts run first misses most of them."""
    X = torch.cat([torch.zeros(20_000, 2, dtype=torch.float64), random(9, 2) + 1.0])[
        torch.randperm(20_009, generator=seeded(7))
    ]
    assert float(inertia(X, lloyd(X, 10, generator=seeded()))) < 1e-22


def test_center_without_vertices_goes_to_the_farthest_vertex():
    X = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [9.0, 9.0], [-5.0, 0.0]], dtype=torch.float64)
    far = torch.tensor([[[0.0, 0.0], [1e3, 1e3], [1e3, 2e3]]], dtype=torch.float64)
    moved, _ = _step(X, torch.ones(5, dtype=torch.float64), far)
    torch.testing.assert_close(moved[0, 0], X.mean(0))
    assert moved[0, 1].tolist() == [9.0, 9.0]
    assert moved[0, 2].tolist() == [-5.0, 0.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "at least one center, not 0"),
        ({"count": 31}, "31 centers on 30 distinct vertices"),
        ({"starts": 0}, "at least one start"),
        ({"iterations": 0}, "one iteration"),
        ({"weights": torch.zeros(60, dtype=torch.float64)}, "positive"),
        ({"weights": torch.full((60,), torch.nan, dtype=torch.float64)}, "positive"),
    ],
)
def test_mistakes_are_answered_with_one_line(change, message):
    settings = {"vertices": random(30, 2).repeat(2, 1), "count": 3, "generator": seeded()} | change
    with pytest.raises(UserError, match=message) as caught:
        lloyd(**settings)
    assert "\n" not in str(caught.value)


def test_starts_are_those_of_plain_greedy_k_means():
    """Greedy k-means++ with masses, written out again for one start after the other, on the same random numbers."""
    X, mass = random(200, 2), random(200, seed=1) ** 6 + 1e-3
    count, starts = 5, 4
    found = _seed(X, mass, count, starts, seeded(3)).numpy()
    generator, x, w = seeded(3), X.numpy(), mass.numpy()
    square = np.full((starts, 200), np.inf)
    for j in range(count):
        trials = 2 + int(np.log(count)) if j else 1
        draws = torch.rand(starts, trials, generator=generator, dtype=torch.float64).numpy()
        for s in range(starts):
            cumulative = np.cumsum(w if j == 0 else square[s] * w)
            tried = [int(np.searchsorted(cumulative, u * cumulative[-1], side="right")) for u in draws[s]]
            nearer = [np.minimum(square[s], ((x - x[i]) ** 2).sum(1)) for i in tried]
            best = int(np.argmin([(w * each).sum() for each in nearer]))
            square[s] = nearer[best]
            np.testing.assert_array_equal(found[s, j], x[tried[best]])
