"""OLS against a slow textbook implementation, and against what a greedy choice must satisfy."""

import functools
import subprocess
import sys

import numpy as np
import pytest
import torch

from rbfevo.errors import UserError
from rbfevo.methods.candidates import grid_candidates
from rbfevo.methods.ols import ols
from rbfevo.scoring import gram
from rbfevo.scoring.distances import distances
from rbfevo.scoring.kernels import Wendland


def textbook(Phi, g, count, tolerance=1e-9, vanish=1e-12):
    """Gram-Schmidt of all columns of Phi [n, c] against every pick; indices and gains."""
    W = Phi.astype(float)
    own = (W**2).sum(0)
    usable = np.isfinite(own) & (own > 0)
    W[:, ~usable] = 0.0
    g = g / np.linalg.norm(g)
    indices, gains = [], []
    for _ in range(count):
        square = (W**2).sum(0)
        usable &= square >= vanish * own
        gain = np.full(len(own), -np.inf)
        gain[usable] = ((W[:, usable].T @ g) ** 2).sum(1) / square[usable]
        j = int(np.flatnonzero(gain >= gain.max() - tolerance)[0])
        indices.append(j)
        gains.append(gain[j])
        usable[j] = False
        q = W[:, j] / np.linalg.norm(W[:, j])
        W -= np.outer(q, q @ W)
        g = g - np.outer(q, q @ g)
    return indices, gains


def potential(Phi: np.ndarray, g: np.ndarray) -> float:
    """P by the definition."""
    g = g / np.linalg.norm(g)
    return float(1.0 - ((g - Phi @ np.linalg.lstsq(Phi, g, rcond=None)[0]) ** 2).sum())


def plane(resolution: int):
    """Vertices, height field and box of the plane scenario."""
    x, y = (np.linspace(0.0, high, resolution) for high in (1.0, 2.0))
    X = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    u, v = X[:, 1], X[:, 0]
    q = (u - 1.5) ** 2 + (v - 0.5) ** 2
    bump = np.where(q <= 1 / 16, (np.cos(4 * np.pi * np.sqrt(q)) + 1) / 2, 0.0)
    height = np.where(v - u >= 0.5, 1.0, np.where(v - u >= 0, 2 * (v - u), bump))
    box = torch.tensor([0.0, 0.0], dtype=torch.float64), torch.tensor([1.0, 2.0], dtype=torch.float64)
    return torch.tensor(X), torch.tensor(height[:, None]), box


def wendland(support: float):
    return lambda r: (1 - r / support).clamp(min=0) ** 4 * (4 * r / support + 1)


def thin_plate(r):
    return torch.xlogy(r * r, r)


def kernel_columns(X, phi):
    return lambda centers: phi(torch.cdist(X, centers, compute_mode="donot_use_mm_for_euclid_dist"))


def looked_up(Phi):
    """Columns of a given matrix, for candidates that are merely its column numbers, and these candidates."""
    return lambda centers: Phi[:, centers[:, 0].long()], torch.arange(Phi.shape[1], dtype=torch.float64)[:, None]


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


KERNELS = {"wendland 0.5": wendland(0.5), "wendland 0.25": wendland(0.25), "thin plate": thin_plate}
FULL, PARTLY, NOTHING = 7e6, 2.7e6, 0.0  # bytes, for 900 columns of 1,600 rows


@pytest.mark.parametrize("kernel", KERNELS)
def test_picks_on_the_plane_are_those_of_the_textbook(kernel):
    X, g, box = plane(40)
    columns, candidates = kernel_columns(X, KERNELS[kernel]), grid_candidates(*box)
    Phi = columns(candidates)
    indices, gains = textbook(Phi.numpy(), g.numpy(), 25)
    chosen = ols(columns, candidates, g, 25, memory=FULL)
    assert torch.equal(chosen.centers, candidates[chosen.indices])
    assert abs(float(chosen.gains.sum()) - potential(Phi[:, indices].numpy(), g.numpy())) <= 1e-9
    again = [ols(*looked_up(Phi), g, 25, memory=memory) for memory in (PARTLY, NOTHING)]
    for selection in (chosen, *again):
        assert selection.indices.tolist() == indices
        np.testing.assert_allclose(selection.gains.numpy(), gains, rtol=1e-6, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_picks_on_the_whole_plane_are_those_of_the_textbook(kernel):
    X, g, box = plane(150)
    columns, candidates = kernel_columns(X, KERNELS[kernel]), grid_candidates(*box)
    indices, _ = textbook(columns(candidates).numpy(), g.numpy(), 25)
    for memory in (1e9, 4e7):
        assert ols(columns, candidates, g, 25, memory=memory).indices.tolist() == indices


@pytest.mark.parametrize("weighted", [False, True])
def test_random_problem_with_three_columns_is_solved_as_the_textbook_does(weighted):
    X, g, candidates = normal(700, 3), normal(700, 3, seed=1), normal(400, 3, seed=2)
    weights = normal(700, seed=3) ** 2 + 0.01 if weighted else None
    columns = kernel_columns(X, lambda r: r**3)
    root = np.ones((700, 1)) if weights is None else weights.sqrt()[:, None].numpy()
    Phi, scaled = root * columns(candidates).numpy(), root * g.numpy()
    indices, gains = textbook(Phi, scaled, 25)
    for memory in (1e9, 6e5, 0.0):
        chosen = ols(columns, candidates, g, 25, weights=weights, memory=memory, block=37)
        assert chosen.indices.tolist() == indices
        np.testing.assert_allclose(chosen.gains.numpy(), gains, rtol=1e-8)
        assert abs(float(chosen.gains.sum()) - potential(Phi[:, indices], scaled)) <= 1e-9


@pytest.mark.parametrize("seed", range(30))
def test_small_problems_run_until_nothing_is_left(seed):
    """Rank 9 in 12 rows, with copies: the gain ends at what is attainable, ties end on the lowest index."""
    Phi = (normal(12, 9, seed=seed) @ normal(9, 20, seed=seed + 100))[:, [*range(20), 3, 0, 7]]
    g = normal(12, 2, seed=seed + 200) if seed % 2 else Phi[:, :2] @ normal(2, 2, seed=seed + 200)
    columns, candidates = looked_up(Phi)
    indices, gains = textbook(Phi.numpy(), g.numpy(), 9)
    for memory in (1e9, 1e3, 0.0):
        chosen = ols(columns, candidates, g, 9, memory=memory, block=5)
        assert chosen.indices.tolist() == indices
        np.testing.assert_allclose(chosen.gains.numpy(), gains, rtol=1e-7, atol=1e-12)
    assert abs(float(chosen.gains.sum()) - potential(Phi.numpy(), g.numpy())) <= 1e-9
    with pytest.raises(UserError, match="only 9 of the 23 OLS candidates"):
        ols(columns, candidates, g, 10)


@pytest.mark.parametrize("memory", [1e9, 6e3, 0.0])
def test_of_mirrored_candidates_the_lowest_index_wins(memory):
    axis = torch.linspace(-1.0, 1.0, 21, dtype=torch.float64)
    X = torch.cartesian_prod(axis, axis)
    g = (4 * X[:, 0] ** 2 - X[:, 1])[:, None]
    columns = kernel_columns(X, wendland(0.8))
    left = torch.tensor([[-0.9, 0.1], [-0.6, -0.7], [-0.3, 0.4]], dtype=torch.float64)
    right = left * torch.tensor([-1.0, 1.0], dtype=torch.float64)
    for candidates in (torch.cat([left, right]), torch.cat([right, left])):
        chosen = ols(columns, candidates, g, 6, memory=memory).indices.tolist()
        assert chosen[0] < 3
        assert chosen == textbook(columns(candidates).numpy(), g.numpy(), 6)[0]


@pytest.mark.parametrize(("lead", "winner"), [(0.0, 2), (5e-10, 2), (5e-9, 7)])
@pytest.mark.parametrize("memory", [1e9, 200.0, 0.0])
def test_ties_are_a_billionth_wide(lead, winner, memory):
    """Columns of gain 0.5, at 2, and 0.5 + lead, at 7, among others of gain 0.3."""
    first, second, other = np.sqrt([0.5, 0.5 + lead, 0.3])
    gains = torch.tensor([other, other, first, other, first, other, other, second, other], dtype=torch.float64)
    Phi = torch.zeros(10, 9, dtype=torch.float64)
    Phi[0] = gains
    Phi[1:].fill_diagonal_(1.0).mul_((1 - gains**2).sqrt())
    g = torch.eye(10, 1, dtype=torch.float64)
    columns, candidates = looked_up(Phi)
    chosen = ols(columns, candidates, g, 1, memory=memory, block=2)
    assert chosen.indices.tolist() == [winner] == textbook(Phi.numpy(), g.numpy(), 1)[0]
    assert float(chosen.gains[0]) == pytest.approx(float(gains[winner] ** 2), abs=1e-13)


@pytest.mark.parametrize("memory", [1e9, 1e3, 0.0])
def test_copies_zeros_and_values_that_are_not_finite_are_skipped(memory):
    Phi = normal(50, 8)
    nan, infinite, zero, copy = Phi[:, 0].clone(), Phi[:, 1].clone(), torch.zeros(50).double(), -3.0 * Phi[:, 2]
    nan[7], infinite[9] = torch.nan, torch.inf
    columns, candidates = looked_up(torch.stack([nan, zero, *Phi.T, copy, infinite], 1))
    chosen = ols(columns, candidates, normal(50, 2, seed=1), 8, memory=memory, block=3)
    assert sorted(chosen.indices.tolist()) == list(range(2, 10))
    with pytest.raises(UserError, match="only 8 of the 12"):
        ols(columns, candidates, normal(50, 2, seed=1), 9, memory=memory)


@pytest.mark.parametrize(("new", "used"), [(1e-5, True), (1e-7, False)])
@pytest.mark.parametrize("memory", [1e9, 1e3, 0.0])
def test_a_column_must_bring_a_trillionth_of_its_square(new, used, memory):
    """Three directions: one picked first, one that a nearly parallel column would add, and a third."""
    a, b, c = (torch.eye(120, 3, dtype=torch.float64)[:, i] for i in range(3))
    columns, candidates = looked_up(torch.stack([a, a + new * b, c], 1))
    g = (10 * a + 3 * b + c)[:, None]
    chosen = ols(columns, candidates, g, 2, memory=memory)
    # (a + new b) leads a by 6 new / 11, which is no tie, and then a holds new^2 of its square
    assert chosen.indices.tolist() == ([1, 0] if used else [1, 2])


@pytest.mark.parametrize("memory", [1e9, 2e4, 0.0])
def test_nearly_parallel_columns_keep_the_gains_exact(memory):
    """A few millionths of each column are its own: orthogonalized only once, the gains would be off by 7e-9."""
    Phi, g = normal(100, 1) + 2e-6 * normal(100, 90, seed=1), normal(100, 2, seed=2)
    chosen = ols(*looked_up(Phi), g, 40, memory=memory)
    for t in (2, 5, 20, 40):
        Q, _ = np.linalg.qr(Phi[:, chosen.indices[:t]].numpy())
        exact = ((Q.T @ g.numpy()) ** 2).sum() / float(g.square().sum())
        assert abs(float(chosen.gains[:t].sum()) - exact) <= 1e-10


def test_one_center_is_the_candidate_of_the_smallest_angle():
    X, g, candidates = normal(300, 2), normal(300, 3, seed=1), normal(60, 2, seed=2)
    columns = kernel_columns(X, thin_plate)
    Phi = columns(candidates)
    cosines = ((Phi / torch.linalg.vector_norm(Phi, dim=0)).T @ g).square().sum(1) / g.square().sum()
    chosen = ols(columns, candidates, g, 1)
    assert chosen.indices.tolist() == [int(cosines.argmax())]
    torch.testing.assert_close(chosen.gains, cosines.max()[None])


def test_units_of_gradient_and_columns_do_not_matter():
    X, g, box = plane(30)
    candidates, columns = grid_candidates(*box, per_axis=8), kernel_columns(X, wendland(0.5))
    scale = torch.logspace(-60, 60, 64, dtype=torch.float64)
    plain = ols(columns, candidates, g, 10)
    Phi = columns(candidates) * scale
    scaled_columns, numbers = looked_up(Phi)
    for memory in (1e9, 1e5, 0.0):
        scaled = ols(scaled_columns, numbers, 1e6 * g, 10, memory=memory)
        assert torch.equal(scaled.indices, plain.indices)
        torch.testing.assert_close(scaled.gains, plain.gains, rtol=1e-9, atol=1e-13)


@functools.cache
def picked_by_the_textbook() -> tuple[list[int], list[float]]:
    X, g, box = plane(40)
    return textbook(Wendland(0.5)(distances(X, grid_candidates(*box))).numpy(), g.numpy(), 25)


@pytest.mark.parametrize("memory", [FULL, PARTLY])
@pytest.mark.parametrize("weight", [None, 1.0, 2.0])
def test_threads_and_equal_weights_change_no_pick(memory, weight):
    X, g, box = plane(40)
    candidates, kernel = grid_candidates(*box), Wendland(0.5)
    weights = None if weight is None else torch.full((len(X),), weight, dtype=torch.float64)
    indices, gains = picked_by_the_textbook()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        chosen = ols(gram.kernel_columns(X, kernel), candidates, g, 25, weights=weights, memory=memory)
        assert chosen.indices.tolist() == indices
        np.testing.assert_allclose(chosen.gains.numpy(), gains, rtol=1e-6, atol=1e-11)


def test_columns_that_autograd_follows_are_no_trouble():
    X, g, box = plane(12)
    columns, candidates = kernel_columns(X.requires_grad_(), thin_plate), grid_candidates(*box, per_axis=5)
    torch.set_num_threads(2)
    assert not ols(columns, candidates, g, 5).gains.requires_grad


def test_neither_columns_nor_gradient_are_written_to():
    Phi, g = normal(40, 12), normal(40, 1, seed=1)
    before, gradient = Phi.clone(), g.clone()
    ols(lambda centers: Phi[:, :12] if len(centers) == 12 else Phi[:, centers[:, 0].long()], looked_up(Phi)[1], g, 5)
    assert torch.equal(Phi, before)
    assert torch.equal(g, gradient)


@pytest.mark.parametrize("kernel", KERNELS)
def test_few_columns_are_computed_twice(kernel):
    """What makes it quick: 25 picks cost not 25 but barely two computations of all columns."""
    X, g, box = plane(40)
    computed = 0

    def columns(centers):
        nonlocal computed
        computed += len(centers)
        return kernel_columns(X, KERNELS[kernel])(centers)

    ols(columns, grid_candidates(*box), g, 25, memory=FULL)
    assert computed <= 2 * 900


@pytest.mark.parametrize("d", [1, 2, 3])
def test_candidates_fill_the_box_to_its_ends(d):
    lower, upper = -torch.arange(1.0, 1.0 + d).double(), torch.arange(2.0, 2.0 + d).double() / 3
    grid = grid_candidates(lower, upper, per_axis=7)
    axes = [np.linspace(a, b, 7) for a, b in zip(lower.tolist(), upper.tolist(), strict=True)]
    expected = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, d)
    np.testing.assert_allclose(grid.numpy(), expected, atol=1e-15)
    assert torch.equal(grid[0], lower)
    assert torch.equal(grid[-1], upper)
    assert len(grid_candidates(lower, upper)) == 30**d


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "at least one center, not 0"),
        ({"count": 13}, "13 centers from 12 candidates"),
        ({"gradient": torch.zeros(40, 1, dtype=torch.float64)}, "not zero everywhere"),
        ({"gradient": torch.full((40, 1), torch.nan, dtype=torch.float64)}, "finite"),
    ],
)
def test_mistakes_are_answered_with_one_line(change, message):
    columns, candidates = looked_up(normal(40, 12))
    settings = {"gradient": normal(40, 1, seed=1), "count": 2} | change
    with pytest.raises(UserError, match=message) as caught:
        ols(columns, candidates, **settings)
    assert "\n" not in str(caught.value)


def test_a_grid_of_one_point_per_axis_is_refused():
    with pytest.raises(UserError, match="at least 2 points per axis"):
        grid_candidates(torch.zeros(2), torch.ones(2), per_axis=1)


@pytest.mark.slow
def test_the_face_stays_within_two_gigabytes():
    program = """
import resource, torch, trimesh
from rbfevo.methods.candidates import grid_candidates
from rbfevo.methods.ols import ols
X = torch.tensor(trimesh.creation.icosphere(subdivisions=5).vertices.copy())
g = X * torch.sin(4 * X + 1).prod(1, keepdim=True)
box = torch.ones(3, dtype=torch.float64)
chosen = ols(lambda c: torch.cdist(X, c) ** 3, grid_candidates(-box, box), g, 25)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, len(chosen.indices.unique()))
"""
    kilobytes, distinct = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    ).stdout.split()
    assert int(kilobytes) < 2e6
    assert int(distinct) == 25
