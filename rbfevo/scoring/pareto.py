"""Pareto dominance: ranks, crowding distance, hypervolume and knee; every objective is maximized, NaN is worst."""

import heapq
import itertools
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.scoring.fronts import knee_of


def ranks(objectives: Tensor, enough: int | None = None) -> Tensor:
    """Nondominated sorting: the number of fronts to peel off before each row is nondominated.

    Fast path for two objectives: one sort, then O(n) a front. Otherwise the n x n dominance matrix is built.

    Args:
        objectives: [n, M], maximized. Rows with a NaN share one rank behind all other rows (0 if there are no others).
        enough: stop once this many rows are ranked; the rows then left share the next rank. None ranks every row.

    Returns:
        [n] int64, 0 for the nondominated rows; duplicates share a rank.

    Source: Deb et al. 2002, "A fast and elitist multiobjective genetic algorithm: NSGA-II", section III A.
    """
    enough = len(objectives) if enough is None else enough
    if objectives.shape[1] == 2:
        return torch.from_numpy(_ranks_of_two(_on_host(objectives), enough)).to(objectives.device)
    return _ranks_of_many(objectives, enough)


def _on_host(objectives: Tensor) -> NDArray[np.float64]:
    """Populations are so small that NumPy is done with an operation before torch, or a GPU, has begun with it."""
    return objectives.detach().to("cpu", torch.float64).numpy()


def _ranks_of_two(objectives: NDArray[np.float64], enough: int) -> NDArray[np.int64]:
    n = len(objectives)
    f, g = -objectives.T  # minimized from here on
    failed = np.isnan(f) | np.isnan(g)
    f, g = np.where(failed, math.inf, f), np.where(failed, math.inf, g)
    # Walk by f, then g, best first: only rows met earlier can dominate a row, and duplicates are neighbours.
    order = np.lexsort((g, f))
    f, g, failed = f[order], g[order], failed[order]
    # Place of each row by g, then f. A row is dominated where an earlier one has a smaller place; duplicates share one.
    by_g = g.argsort(kind="stable")
    distinct = np.ones(n, np.int64)
    distinct[1:] = (f[1:] != f[:-1]) | (g[1:] != g[:-1])
    place = np.empty(n, np.int64)
    place[by_g] = distinct[by_g].cumsum()

    peeled = n + 1  # behind every place
    place[failed] = peeled
    left = n - int(np.count_nonzero(failed))
    stop = max(left - enough, 0)
    walked, fronts = np.zeros(n, np.int64), 0
    while left > stop:
        place[place == np.minimum.accumulate(place)] = peeled
        waiting = place < peeled
        walked += waiting
        fronts += 1
        left = int(np.count_nonzero(waiting))
    walked[failed] = fronts
    rank = np.empty(n, np.int64)
    rank[order] = walked
    return rank


def _ranks_of_many(objectives: Tensor, enough: int) -> Tensor:
    n = len(objectives)
    failed = objectives.isnan().any(dim=1)
    as_good = torch.ones(n, n, dtype=torch.bool, device=objectives.device)
    for f in objectives.unbind(dim=1):
        as_good &= f[:, None] >= f[None, :]
    dominates = as_good & ~as_good.T  # all False for a NaN row
    dominators = dominates.sum(dim=0)
    waiting = ~failed
    rank, fronts = torch.zeros(n, dtype=torch.int64, device=objectives.device), 0
    left = int(waiting.sum())
    stop = max(left - enough, 0)
    while left > stop:
        front = waiting & (dominators == 0)
        waiting = waiting & ~front
        dominators -= dominates[front].sum(dim=0)
        rank += waiting
        fronts += 1
        left = int(waiting.sum())
    return rank.masked_fill_(failed, fronts)


def crowding(objectives: Tensor, ranks: Tensor) -> Tensor:
    """Crowding distance within each front: the gaps between a row's neighbours, over the front's spread, summed.

    Duplicates are ordered by row, so of many copies the middle ones have distance 0. An objective without (finite)
    spread in a front adds nothing there and has no ends.

    Args:
        objectives: [n, M]. Rows with a NaN have distance 0.
        ranks: [n] integers; rows with the same rank are one front.

    Returns:
        [n], larger is less crowded; +inf at both ends of each objective of each front, and in fronts of one or two.

    Source: Deb et al. 2002, section III B.
    """
    distance = _crowding(_on_host(objectives), ranks.cpu().numpy())
    return torch.from_numpy(distance).to(objectives)


def _crowding(objectives: NDArray[np.float64], ranks: NDArray[np.int64]) -> NDArray[np.float64]:
    rank = np.sort(ranks)
    first, last, place = rank.searchsorted(rank), rank.searchsorted(rank, "right") - 1, np.arange(len(rank))
    ends, few = (place == first) | (place == last), last - first < 2
    distance, gaps = np.zeros(len(rank)), np.zeros(len(rank))
    for costs in -objectives.T:
        order = np.lexsort((costs, ranks))  # front by front, best first
        costs = costs[order]
        with np.errstate(all="ignore"):
            spread = costs[last] - costs[first]
            gaps[1:-1] = costs[2:] - costs[:-2]
            gaps /= spread
        gaps[ends] = math.inf
        gaps[~((spread > 0) & (spread < math.inf))] = 0.0
        gaps[few] = math.inf
        distance[order] += gaps
    distance[np.isnan(objectives).any(axis=1)] = 0.0
    return distance


def best(objectives: Tensor, count: int) -> Tensor:
    """Indices [count] of the best rows by (rank, crowding), best first, ties by row."""
    values, rank = _on_host(objectives), ranks(objectives, enough=count).cpu().numpy()
    order = np.lexsort((-_crowding(values, rank), rank))[:count]
    return torch.from_numpy(order).to(objectives.device)


def nondominated(objectives: Tensor) -> Tensor:
    """Which rows no other row dominates.

    Args:
        objectives: [n, M], maximized.

    Returns:
        [n] bool; every duplicate of a nondominated row is nondominated, a row with a NaN never is.
    """
    return (ranks(objectives, enough=1) == 0) & ~objectives.isnan().any(dim=1)


def hypervolume(objectives: Tensor, reference: tuple[float, float] = (0.0, 0.0)) -> float:
    """Area that the rows dominate above the reference point.

    Args:
        objectives: [n, 2], maximized. Rows with a NaN, and rows not above the reference in both, add nothing.
        reference: the point from which the area is measured.

    Returns:
        The area: 0 where no row is above the reference, +inf where such a row is infinite.
    """
    above = objectives - objectives.new_tensor(reference)
    above = above[(above > 0).all(dim=1)]
    if bool(above.isinf().any()):
        return math.inf
    f, order = above[:, 0].sort(descending=True)
    height = above[order, 1]
    height = height.cummax(0).values if len(height) else height
    width = f - torch.cat([f[1:], f.new_zeros(min(len(f), 1))])
    return float((width * height).sum())


def well_spread(objectives: Tensor, count: int) -> Tensor:
    """Rows of the nondominated ones that keep most of the hypervolume, from the least to the largest first objective.

    The row that adds least to the hypervolume of those left is removed until `count` are left; the ends stay.
    Duplicates count once.

    Args:
        objectives: [n, 2], maximized. Rows with a NaN are left out.
        count: how many rows to keep at most; at least 2.

    Returns:
        [at most count] int64.
    """
    rows = nondominated(objectives).nonzero().squeeze(1)
    rows = rows[objectives[rows, 0].argsort(stable=True)]
    f = objectives[rows].tolist()
    kept = [i for i in range(len(f)) if i == 0 or f[i] != f[i - 1]]
    if len(kept) > count:
        after = dict(itertools.pairwise(kept))
        before = {right: left for left, right in after.items()}

        def loss(i: int) -> float:
            return (f[i][0] - f[before[i]][0]) * (f[i][1] - f[after[i]][1])

        current = {i: loss(i) for i in kept[1:-1]}
        heap = [(value, i) for i, value in current.items()]
        heapq.heapify(heap)
        while len(current) + 2 > max(count, 2):
            value, i = heapq.heappop(heap)
            if current.get(i) != value:  # an older entry of a row that has changed or gone
                continue
            del current[i]
            left, right = before.pop(i), after.pop(i)
            after[left], before[right] = right, left
            for neighbour in (left, right):
                if neighbour in current:
                    current[neighbour] = loss(neighbour)
                    heapq.heappush(heap, (current[neighbour], neighbour))
        kept = [kept[0], *sorted(current), kept[-1]]
    return rows[kept]


def knee(objectives: Tensor) -> int:
    """Row of the knee: the nondominated row farthest from the chord between the front's two ends (`knee_of`).

    Args:
        objectives: [n, 2], maximized. Rows that are not finite are left out.

    Raises:
        UserError: no row is finite.
    """
    finite = objectives.isfinite().all(dim=1)
    if not bool(finite.any()):
        raise UserError("there is no knee: no setup has finite objectives; check the scores of the setups")
    rows = finite.nonzero().squeeze(1)
    rows = rows[nondominated(objectives[rows])]
    return int(rows[knee_of(objectives[rows].cpu().numpy())])
