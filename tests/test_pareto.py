"""Ranks, crowding, hypervolume and knee against textbook loops, pymoo and moocore."""

import math

import moocore
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pymoo.operators.survival.rank_and_crowding.metrics import get_crowding_function
from pymoo.util.nds.non_dominated_sorting import NonDominatedSorting
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.scoring.pareto import best, crowding, hypervolume, knee, nondominated, ranks, well_spread

NAN, INF = math.nan, math.inf


def dominates(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.all(a >= b) and np.any(a > b))


def textbook_ranks(F: np.ndarray) -> np.ndarray:
    rank = np.full(len(F), -1)
    failed = np.flatnonzero(np.isnan(F).any(axis=1))
    left, k = [i for i in range(len(F)) if i not in failed], 0
    while left:
        front = [i for i in left if not any(dominates(F[j], F[i]) for j in left)]
        rank[front] = k
        left = [i for i in left if i not in front]
        k += 1
    rank[failed] = k
    return rank


def textbook_crowding(F: np.ndarray, rank: np.ndarray) -> np.ndarray:
    distance = np.zeros(len(F))
    for k in set(rank.tolist()):
        front = [i for i in range(len(F)) if rank[i] == k]
        if len(front) <= 2:
            distance[front] = INF
            continue
        for f in F.T:
            walk = sorted(front, key=lambda i: -f[i])  # stable: duplicates by row
            spread = f[walk[0]] - f[walk[-1]]
            if spread == 0:
                continue
            distance[walk[0]] = distance[walk[-1]] = INF
            for before, i, after in zip(walk, walk[1:], walk[2:], strict=False):
                distance[i] += (f[before] - f[after]) / spread
    return distance


def fronts(kind: str, M: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    F = torch.rand(60, M, dtype=torch.float64, generator=generator)
    if kind == "duplicates":  # few values, so equal rows and equal coordinates everywhere
        F = (F * 4).floor()
    elif kind == "copies":
        F = F[torch.randint(12, (60,), generator=generator)]
    elif kind == "constant objective":
        F[:, 0] = 0.3
    elif kind == "constant":
        F[:] = 0.3
    elif kind == "one front":
        F = F / F.norm(dim=1, keepdim=True)
    elif kind == "chain":
        F = F[:, :1].expand(-1, M).contiguous()
    return F


KINDS = ["random", "duplicates", "copies", "constant objective", "constant", "one front", "chain"]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("M", [1, 2, 3, 4])
@pytest.mark.parametrize("kind", KINDS)
def test_ranks_equal_textbook_pymoo_and_moocore(kind: str, M: int, seed: int) -> None:
    F = fronts(kind, M, seed)
    rank = ranks(F)
    assert rank.dtype == torch.int64
    np.testing.assert_array_equal(rank.numpy(), textbook_ranks(F.numpy()))
    _, of_pymoo = NonDominatedSorting().do(-F.numpy(), return_rank=True)
    np.testing.assert_array_equal(rank.numpy(), of_pymoo)
    if M > 1:
        np.testing.assert_array_equal(rank.numpy(), moocore.pareto_rank(F.numpy(), maximise=True))
        np.testing.assert_array_equal(
            nondominated(F).numpy(), moocore.is_nondominated(F.numpy(), maximise=True, keep_weakly=True)
        )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("M", [2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_crowding_equals_textbook_and_pymoo(kind: str, M: int, seed: int) -> None:
    F = fronts(kind, M, seed)
    rank = ranks(F)
    distance = crowding(F, rank).numpy()
    np.testing.assert_allclose(distance, textbook_crowding(F.numpy(), rank.numpy()), rtol=1e-12, atol=1e-14)
    of_pymoo = np.zeros(len(F))
    for k in range(int(rank.max()) + 1):
        front = (rank == k).numpy()
        of_pymoo[front] = get_crowding_function("cd").do(-F.numpy()[front])
    np.testing.assert_allclose(distance / M, of_pymoo, rtol=1e-12, atol=1e-14)  # pymoo takes the mean, Deb the sum


small = st.sampled_from([-1.0, -0.0, 0.0, 0.25, 0.5, 1.0, NAN, -INF])
tables = st.tuples(st.integers(1, 14), st.integers(1, 3)).flatmap(lambda s: arrays(np.float64, s, elements=small))


@given(tables)
@settings(max_examples=150, deadline=None)
def test_any_table(table: np.ndarray) -> None:
    F = torch.from_numpy(table)
    failed = F.isnan().any(dim=1)
    rank = ranks(F)
    np.testing.assert_array_equal(rank.numpy(), textbook_ranks(table))
    assert (rank[failed] == int(rank.max())).all()
    assert (rank[failed, None] > rank[~failed]).all()
    assert not (nondominated(F) & failed).any()
    distance = crowding(F, rank)
    assert not distance.isnan().any()
    assert (distance >= 0).all()
    assert (distance[failed] == 0).all()
    for enough in range(1, len(F) + 1):  # stopping early changes nothing in the fronts that were asked for
        part = ranks(F, enough)
        last = int(part.max())
        if int((part < last).sum()) < enough:
            assert torch.equal(part, rank)
        else:
            assert torch.equal(part, rank.clamp_max(last))
            assert int((rank < last - 1).sum()) < enough


@given(tables, st.randoms(use_true_random=False))
@settings(max_examples=100, deadline=None)
def test_ranks_follow_a_permutation_and_ignore_monotone_scaling(table: np.ndarray, random) -> None:
    F = torch.from_numpy(table)
    shuffle = list(range(len(F)))
    random.shuffle(shuffle)
    assert torch.equal(ranks(F[shuffle]), ranks(F)[shuffle])
    assert torch.equal(ranks(F.exp() * 7 + 1), ranks(F))


def test_two_objectives_agree_with_the_dominance_matrix_on_many_rows() -> None:
    F = torch.randint(40, (1500, 2), generator=torch.Generator().manual_seed(1)).double()
    F[::17, 0] = NAN
    assert torch.equal(ranks(F), ranks(torch.cat([F, F[:, :1]], dim=1)))  # a repeated objective changes no dominance


def test_nan_rows_are_in_no_front() -> None:
    F = torch.tensor([[NAN, 9.0], [1.0, 2.0], [2.0, 1.0], [0.0, 0.0], [9.0, NAN], [-INF, -INF]], dtype=torch.float64)
    assert ranks(F).tolist() == [3, 0, 0, 1, 3, 2]
    assert nondominated(F).tolist() == [False, True, True, False, False, False]
    assert ranks(F.fill_(NAN)).tolist() == [0] * 6
    assert not nondominated(F).any()
    assert crowding(F, ranks(F)).tolist() == [0.0] * 6


@pytest.mark.parametrize("M", [2, 3])
def test_no_rows(M: int) -> None:
    F = torch.empty(0, M, dtype=torch.float64)
    assert ranks(F).shape == crowding(F, ranks(F)).shape == nondominated(F).shape == (0,)
    assert hypervolume(F[:, :2]) == 0.0


@pytest.mark.parametrize("M", [1, 2, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_the_best_are_those_of_a_sort_by_rank_crowding_and_row(kind: str, M: int) -> None:
    F = fronts(kind, M, 0)
    F[::9, 0] = NAN
    rank = ranks(F)
    distance = crowding(F, rank)
    order = sorted(range(len(F)), key=lambda i: (int(rank[i]), -float(distance[i])))
    for count in (1, 30, 60):
        part = ranks(F, count)
        if (part == rank).all():  # else the last front is another
            assert best(F, count).tolist() == order[:count]
        assert sorted(rank[best(F, count)].tolist()) == sorted(rank.tolist())[:count]


@pytest.mark.parametrize("dtype", [torch.float32, torch.int64])
def test_other_types_of_objectives(dtype: torch.dtype) -> None:
    F = torch.randint(20, (50, 2), generator=torch.Generator().manual_seed(0))
    assert torch.equal(ranks(F.to(dtype)), ranks(F.double()))
    distance = crowding(F.float().requires_grad_(), ranks(F.float()))
    assert distance.dtype == torch.float32
    assert torch.equal(distance, crowding(F.double(), ranks(F)).float())


def test_crowding_by_hand() -> None:
    F = torch.tensor([[0.0, 4.0], [1.0, 3.0], [3.0, 2.0], [4.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    assert crowding(F, ranks(F)).tolist() == [INF, 3 / 4 + 2 / 4, 3 / 4 + 3 / 4, INF, INF]


@pytest.mark.parametrize("reference", [(0.0, 0.0), (0.2, -0.3)])
@pytest.mark.parametrize("n", [1, 2, 7, 200])
def test_hypervolume_equals_moocore(n: int, reference: tuple[float, float]) -> None:
    F = torch.randn(n, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(n))
    F = torch.cat([F, F[: n // 2]])
    expected = moocore.hypervolume(F.numpy(), ref=list(reference), maximise=True)
    assert hypervolume(F, reference) == pytest.approx(expected, rel=1e-12, abs=1e-14)
    with_failures = torch.cat([F, torch.tensor([[NAN, 5.0], [5.0, NAN], [NAN, NAN], [9.0, -9.0]])])
    assert hypervolume(with_failures, reference) == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_hypervolume_by_hand() -> None:
    F = torch.tensor([[1.0, 3.0], [2.0, 2.0], [3.0, 1.0], [1.0, 1.0], [5.0, 0.0]], dtype=torch.float64)
    assert hypervolume(F) == 6.0
    assert hypervolume(F[:0]) == hypervolume(F[4:]) == hypervolume(F * NAN) == 0.0
    assert hypervolume(torch.tensor([[INF, 1.0], [2.0, INF]])) == INF


def textbook_knee(F: np.ndarray) -> int:
    front = [i for i in range(len(F)) if not any(dominates(b, F[i]) for b in F)]
    low, high = F[front].min(axis=0), F[front].max(axis=0)
    scaled = (F - low) / (high - low)
    a, b = scaled[max(front, key=lambda i: F[i, 0])], scaled[max(front, key=lambda i: F[i, 1])]
    (x, y), p = (b - a) / np.linalg.norm(b - a), scaled - a
    return max(front, key=lambda i: abs(x * p[i, 1] - y * p[i, 0]))


@pytest.mark.parametrize("seed", range(10))
def test_knee_is_farthest_from_the_chord(seed: int) -> None:
    F = torch.rand(80, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) ** (seed + 1)
    row = knee(F)
    assert row == textbook_knee(F.numpy())
    assert nondominated(F)[row]
    assert knee(F * torch.tensor([1e-6, 1e3]) + 5) == row  # both axes are scaled


def test_knee_of_degenerate_fronts() -> None:
    one = torch.tensor([[NAN, 9.0], [1.0, 1.0], [2.0, 2.0], [2.0, 2.0]], dtype=torch.float64)
    assert knee(one) == 2
    two = torch.tensor([[0.0, 0.0], [0.1, 3.0], [7.0, 0.3], [INF, 1.0]], dtype=torch.float64)
    assert knee(two) == 1
    line = torch.tensor([[0.1 * i, 1 - 0.1 * i] for i in range(11)], dtype=torch.float64)
    assert knee(line) == 0
    bulge = torch.tensor([[0.0, 1.0], [0.8, 0.9], [0.9, 0.2], [1.0, 0.0]], dtype=torch.float64)
    assert knee(bulge) == 1
    with pytest.raises(UserError, match=r"^there is no knee: [^\n]+$"):
        knee(one * NAN)


@pytest.mark.parametrize("seed", range(4))
def test_well_spread_removes_what_costs_least_hypervolume(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    angle = torch.rand(30, generator=generator, dtype=torch.float64) * 0.5 * math.pi
    table = torch.cat([torch.stack((angle.sin(), angle.cos()), 1), 0.1 * torch.rand(10, 2, dtype=torch.float64)])
    table[32] = table[3]
    table[33] = torch.nan
    left = table[nondominated(table)].unique(dim=0)
    assert len(left) == 30
    while len(left) > 8:
        without = [hypervolume(torch.cat([left[:i], left[i + 1 :]])) for i in range(1, len(left) - 1)]
        worst = 1 + int(np.argmax(without))
        left = torch.cat([left[:worst], left[worst + 1 :]])
    torch.testing.assert_close(table[well_spread(table, 8)], left, rtol=0, atol=0)


def test_well_spread_of_short_fronts() -> None:
    table = torch.tensor([[0.2, 0.9], [0.9, 0.1], [0.2, 0.9], [0.1, 0.2], [0.5, 0.5]], dtype=torch.float64)
    assert well_spread(table, 10).tolist() == [0, 4, 1]
    assert well_spread(table, 2).tolist() == [0, 1]
    assert well_spread(table[:1], 2).tolist() == [0]
    assert well_spread(table[:0], 2).tolist() == []
