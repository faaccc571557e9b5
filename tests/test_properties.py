"""What holds for every population, whatever is in it: scores, fronts, selection and search states, by hypothesis."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import moocore
import numpy as np
import pytest
import torch
from designs import DESIGNS, Design, numpy_phi
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from torch import Tensor

from rbfevo.methods.cmaes.algorithm import CMAES
from rbfevo.methods.method import Rows
from rbfevo.methods.nsga2 import NSGA2
from rbfevo.runs.storage import setup_table
from rbfevo.scoring.deformation import MANIPULATIONS
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.evolvability import Scores
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland
from rbfevo.scoring.pareto import best, crowding, hypervolume, knee, nondominated, ranks, well_spread
from rbfevo.scoring.representations import RBF

NAN, INF = math.nan, math.inf
TINY, HUGE = 5e-324, 1.7976931348623157e308
Row = tuple[float, float]

# ------------------------------------------------------------------ tables of objectives

# Few values, so that ties are everywhere; neighbours in the last bit; the ends of float64; and any others.
few = st.sampled_from([0.0, -0.0, 0.5, math.nextafter(0.5, 1.0), 1.0, -1.0])
HARD = [TINY, -TINY, 2.2e-308, HUGE, -HUGE, 1e-300, 1e300]
OTHERS = [0.1, 0.2, 0.3, math.nextafter(0.3, 0.0), -0.7, 3.0, 1e-9, 7e22, 0.9, 2.0 / 3.0]
infinite = st.sampled_from([INF, -INF])
number = st.sampled_from([0.0, -0.0, 0.5, 1.0, INF, -INF, *HARD, *OTHERS])  # one draw a number: quick
rows = st.one_of(st.tuples(number, number), st.tuples(few, few))
nan_rows = st.tuples(number, number, st.sampled_from([(1, 0), (0, 1), (1, 1)])).map(
    lambda t: (NAN if t[2][0] else t[0], NAN if t[2][1] else t[1])
)


def tables(row: st.SearchStrategy[Row], most: int = 12) -> st.SearchStrategy[list[Row]]:
    """Tables of rows: any, all equal, on one front, and with copies of some rows."""
    some = st.lists(row, min_size=1, max_size=most)
    equal = st.tuples(row, st.integers(1, most)).map(lambda pair: [pair[0]] * pair[1])
    front = some.map(lambda t: [(f, g) for (f, _), (g, _) in zip(sorted(t), sorted(t)[::-1], strict=True)])
    copied = st.tuples(some, st.lists(st.integers(0, most - 1), max_size=most)).map(
        lambda pair: pair[0] + [pair[0][i % len(pair[0])] for i in pair[1]]
    )
    return st.one_of(some, equal, front, copied)


def table(some: list[Row]) -> Tensor:
    return torch.tensor(some, dtype=torch.float64).reshape(-1, 2)


@st.composite
def with_failures(draw: st.DrawFn) -> tuple[list[Row], list[int], list[Row]]:
    """A table without NaN, where its rows went, and the same with NaN rows put between them, at any place."""
    sound = draw(tables(rows, 8))
    failures = draw(st.lists(nan_rows, min_size=1, max_size=4))
    order = draw(st.permutations(range(len(sound) + len(failures))))
    mixed: list[Row] = [(NAN, NAN)] * len(order)
    for place, row in zip(order, sound + failures, strict=True):
        mixed[place] = row
    return sound, list(order[: len(sound)]), mixed


def beats(a: Row, b: Row) -> bool:
    return a[0] >= b[0] and a[1] >= b[1] and a != b


@given(tables(rows))
@settings(max_examples=120)
def test_ranks_and_fronts_are_moocores_and_those_of_the_longest_chain(some: list[Row]) -> None:
    F = table(some)
    found = ranks(F)
    assert found.tolist() == moocore.pareto_rank(F.numpy(), maximise=True).tolist()
    wanted = moocore.is_nondominated(F.numpy(), maximise=True, keep_weakly=True)
    assert nondominated(F).tolist() == wanted.tolist()

    @functools.cache
    def above(row: Row) -> int:  # a rank is the length of the longest chain of rows, each better than the next
        return max((1 + above(other) for other in some if beats(other, row)), default=0)

    assert found.tolist() == [above(row) for row in some]


@given(with_failures())
@settings(max_examples=100)
def test_nan_rows_change_no_rank_no_crowding_and_no_hypervolume_and_are_on_no_front(case: Any) -> None:
    sound, places, mixed = case
    F, G = table(sound), table(mixed)
    failed = G.isnan().any(dim=1)
    rank = ranks(G)
    assert torch.equal(rank[places], ranks(F))
    assert (rank[failed] == int(ranks(F).max()) + 1).all()
    assert torch.equal(nondominated(G)[places], nondominated(F))
    assert not nondominated(G)[failed].any()
    order = torch.tensor(places)
    inward = torch.argsort(order)  # the sound rows in the order in which they now stand: crowding breaks ties by row
    alone = crowding(F[inward], ranks(F[inward]))
    assert torch.equal(crowding(G, rank)[order[inward]], alone)  # bit for bit
    assert (crowding(G, rank)[failed] == 0.0).all()
    assert hypervolume(G) == hypervolume(F[inward])
    assert not failed[best(G, len(sound))].any()
    assert not failed[well_spread(G, 3)].any()


@given(tables(rows))
@settings(max_examples=100)
def test_crowding_is_that_of_a_loop(some: list[Row]) -> None:
    F = table(some)
    rank = ranks(F)
    wanted = [0.0] * len(some)
    for k in set(rank.tolist()):
        front = [i for i in range(len(some)) if rank[i] == k]
        for axis in (0, 1):
            values = [some[i][axis] for i in front]
            spread = max(values) - min(values)
            walk = sorted(front, key=lambda i: -some[i][axis])  # stable
            for place, i in enumerate(walk):
                if len(front) <= 2:
                    wanted[i] = INF
                elif 0.0 < spread < INF:
                    ends = place in (0, len(walk) - 1)
                    wanted[i] += INF if ends else (some[walk[place - 1]][axis] - some[walk[place + 1]][axis]) / spread
    np.testing.assert_allclose(crowding(F, rank).numpy(), wanted, rtol=1e-12)


score = st.one_of(st.sampled_from([0.0, -0.0, TINY, 1e-300, 1e-12, 0.5, 1.0]), st.integers(0, 99).map(lambda i: i / 99))
scored = tables(st.tuples(score, score))
scale = st.sampled_from([1e-300, 1e-12, 1.0, 1e9, 1e150])


@given(scored, scale, scale)
@settings(max_examples=100)
def test_hypervolume_is_moocores_at_any_scale(some: list[Row], wide: float, high: float) -> None:
    F = table(some) * torch.tensor([wide, high], dtype=torch.float64)
    wanted = float(moocore.hypervolume(F.numpy(), ref=[0.0, 0.0], maximise=True))
    assert hypervolume(F) == pytest.approx(wanted, rel=1e-12, abs=1e-320)


@given(scored, st.randoms(use_true_random=False), st.tuples(score, score))
@settings(max_examples=100)
def test_hypervolume_ignores_order_and_copies_and_grows_with_every_row(some: list[Row], random: Any, more: Row) -> None:
    area = hypervolume(table(some))
    shuffled = some + random.choices(some, k=5)
    random.shuffle(shuffled)
    assert hypervolume(table(shuffled)) == pytest.approx(area, rel=1e-14, abs=1e-320)
    grown = hypervolume(table([*some, more]))
    assert grown >= area * (1.0 - 1e-15)
    dominated = any(beats(row, more) or row == more for row in some)
    if dominated or 0.0 in more:
        assert grown == pytest.approx(area, rel=1e-14, abs=1e-320)
    assert area <= hypervolume(table([*some, (1.0, 1.0)])) <= 1.0 + 1e-15


@given(tables(st.one_of(st.tuples(score, score), nan_rows, st.tuples(infinite, score))))
@settings(max_examples=100)
def test_the_knee_is_finite_and_on_the_front_and_no_other_row_of_it_is_farther_from_the_chord(some: list[Row]) -> None:
    finite = [row for row in some if all(map(math.isfinite, row))]
    assume(finite)
    row = knee(table(some))
    assert some[row] in finite
    assert not any(beats(other, some[row]) for other in finite)
    front = [a for a in finite if not any(beats(b, a) for b in finite)]
    low, high = ([f(a[axis] for a in front) for axis in (0, 1)] for f in (min, max))

    def distance(a: Row) -> float:
        unit = [(a[k] - low[k]) / (high[k] - low[k]) if high[k] > low[k] else 0.0 for k in (0, 1)]
        return abs(unit[0] + unit[1] - 1.0)

    assert distance(some[row]) >= max(map(distance, front)) - 1e-11


@given(tables(st.one_of(st.tuples(score, score), nan_rows)), st.integers(2, 6))
@settings(max_examples=100)
def test_well_spread_rows_are_distinct_nondominated_and_keep_both_ends(some: list[Row], count: int) -> None:
    F = table(some)
    kept = well_spread(F, count)
    assert len(kept) <= count
    assert nondominated(F)[kept].all()
    front = F[nondominated(F)]
    assert len(kept) == min(count, len({(f + 0.0, g + 0.0) for f, g in front.tolist()}))
    if len(front):
        assert (F[kept[-1], 0], F[kept[0], 1]) == (front[:, 0].max(), front[:, 1].max())
        assert (F[kept, 0].diff() > 0).all()


# ------------------------------------------------------------------ populations of setups


@functools.cache
def design(name: str) -> Design:
    return DESIGNS[name](6, 7, k=1, weighted=True) if name == "plane" else DESIGNS[name](1, k=3, weighted=True)


KERNELS: dict[str, Callable[[], Kernel]] = {
    "plane, Wendland": lambda: Wendland(0.7),
    "plane, r^2 log r": ThinPlate,
    "sphere, r^3": Cubic,
}
each = pytest.mark.parametrize("case", KERNELS)
both = pytest.mark.parametrize("manipulation", MANIPULATIONS)


@functools.cache
def evaluator(case: str, manipulation: str) -> Evaluator:
    some = design(case.split(",")[0])
    return Evaluator(some.vertices, some.gradient, KERNELS[case](), manipulation, some.weights)


BROKEN = (NAN, INF, -INF)
FAR = (1e155, -1e200, HUGE)  # whose squares overflow: out of a compact kernel's reach, and infinitely far for others
ODD = (30.0, -1e8, 1e60, -1e100, 0.0, -0.0, TINY)
KINDS = ("box", "box", "vertex", "again", "near", "odd", "far")
M = 4


class Recipe(NamedTuple):
    """M centers by number, and the coordinate that is not finite and what it is, or None."""

    centers: list[int]
    broken: int | None


center = st.integers(0, 41 * len(KINDS) - 1)  # one draw a center: quick
whole = st.lists(center, min_size=M, max_size=M).map(lambda centers: Recipe(centers, None))
broken = st.tuples(st.lists(center, min_size=M, max_size=M), st.integers(0, 2 * M * len(BROKEN) - 1)).map(
    lambda pair: Recipe(*pair)
)
recipes = st.one_of(whole, broken)


def setup(recipe: Recipe, some: Design) -> Tensor:
    """Centers [M, d]: from the box, on vertices, on or next to one another, at odd places, far away, not finite."""
    d, box = some.vertices.shape[1], some.centers(41, seed=5)
    found: list[Tensor] = []
    for value, kind in ((i // len(KINDS), KINDS[i % len(KINDS)]) for i in recipe.centers):
        if kind in ("again", "near") and found:
            found.append(found[value % len(found)] + (1e-9 * (1 + value) if kind == "near" else 0.0))
        elif kind in ("odd", "far"):
            numbers = ODD if kind == "odd" else FAR
            found.append(torch.full((d,), numbers[value % len(numbers)], dtype=torch.float64))
        else:
            found.append((some.vertices if kind == "vertex" else box)[value])
    centers = torch.stack(found)
    if recipe.broken is not None:
        place, which = divmod(recipe.broken, len(BROKEN))
        centers[place // 2, place % 2] = BROKEN[which]
    return centers


populations = st.lists(recipes, min_size=1, max_size=5)


def population(drawn: list[Recipe], case: str) -> Tensor:
    some = design(case.split(",")[0])
    return torch.stack([setup(recipe, some) for recipe in drawn])


def columns(scores: Scores, index: Any = slice(None)) -> list[list[float]]:
    """As lists, bit for bit but for the sign of a zero."""
    return [column[index].tolist() for column in scores]


@each
@both
@given(populations)
@settings(max_examples=20)
def test_every_member_scores_as_if_it_were_alone_bit_for_bit(case: str, manipulation: str, drawn: list[Recipe]) -> None:
    centers = population(drawn, case)
    fast = evaluator(case, manipulation)
    together = fast(centers)
    alone = [fast(centers[i : i + 1]) for i in range(len(centers))]
    assert columns(together) == columns(Scores(*(torch.cat(parts) for parts in zip(*alone, strict=True))))
    backwards = fast(centers.flip(0))
    assert columns(Scores(*(column.flip(0) for column in backwards))) == columns(together)
    by_definition = fast.definition(centers)
    for i in range(len(centers)):
        assert columns(by_definition, slice(i, i + 1)) == columns(fast.definition(centers[i : i + 1]))


@each
@both
@given(populations)
@settings(max_examples=20)
def test_exactly_those_fail_whose_centers_or_columns_are_not_finite(
    case: str, manipulation: str, drawn: list[Recipe]
) -> None:
    centers = population(drawn, case)
    fast = evaluator(case, manipulation)
    some = design(case.split(",")[0])
    with np.errstate(all="ignore"):
        Phi = [numpy_phi(fast.deformation.kernel, cdist(some.vertices.numpy(), C)) for C in centers.numpy()]
    wanted = [not (bool(C.isfinite().all()) and bool(np.isfinite(U).all())) for C, U in zip(centers, Phi, strict=True)]
    before = fast.failed_evaluations
    found = fast(centers)
    assert found.failed.tolist() == wanted
    assert fast.failed_evaluations - before == sum(wanted)
    assert fast.definition(centers).failed.tolist() == wanted
    for column in found[:3]:
        assert ((column >= 0.0) & (column <= 1.0)).all()  # false for NaN
        assert (column[found.failed] == 0.0).all()


@each
@both
@given(populations)
@settings(max_examples=20)
def test_broken_members_have_no_gradient_and_leave_those_of_the_others_alone(
    case: str, manipulation: str, drawn: list[Recipe]
) -> None:
    centers, wrong = population(drawn, case), [recipe.broken is not None for recipe in drawn]
    sound = [i for i, fails in enumerate(wrong) if not fails]
    fast = evaluator(case, manipulation)

    def gradient(some: Tensor) -> Tensor:
        spectrum = Spectrum(fast, some)
        return spectrum.backward(torch.ones_like(spectrum.sigma) * torch.arange(M), torch.ones_like(spectrum.potential))

    found = gradient(centers)
    assert found.isfinite().all()
    assert (found[wrong] == 0.0).all()
    if sound:
        assert torch.equal(found[sound], gradient(centers[sound]))


@each
@given(whole, st.permutations(range(M)))
@settings(max_examples=15)
def test_the_order_of_the_centers_changes_rounding_alone(case: str, recipe: Recipe, order: list[int]) -> None:
    centers = population([recipe], case)
    fast = evaluator(case, "indirect")
    assume(not fast(centers).failed.any())
    found, turned = fast(centers), fast(centers[:, order])
    torch.testing.assert_close(turned.regularity, found.regularity, rtol=1e-6, atol=1e-12)
    assert turned.variability.tolist() == found.variability.tolist()
    # A rank that is cut off at a singular value of rounding error leaves P to it, see `test_evaluator`.
    bound = 1e-8 + 1e-15 / float(found.regularity) if found.regularity > 0.0 else 1e-6
    torch.testing.assert_close(turned.improvement_potential, found.improvement_potential, rtol=0.0, atol=bound)


# ------------------------------------------------------------------ results, selection, search


@given(
    st.lists(
        st.lists(st.tuples(st.tuples(score, score), st.booleans()), min_size=1, max_size=6), min_size=1, max_size=4
    )
)
@settings(max_examples=50)
def test_a_results_front_is_that_of_all_rows_that_did_not_fail(parts: list[list[tuple[Row, bool]]]) -> None:
    series = []
    for k, part in enumerate(parts):
        failed = torch.tensor([fails for _, fails in part])
        objectives = table([row for row, _ in part]).where(~failed[:, None], 0.0)  # as the evaluator leaves them
        p = len(part)
        scores = Scores(objectives[:, 0], objectives[:, 1], torch.zeros(p, dtype=torch.float64), failed)
        series.append(Rows(f"method {k}", torch.zeros(p, M, 2, dtype=torch.float64), scores, torch.full((p,), NAN)))
    entries = [entry for part in parts for entry in part]
    sound = [row for row, fails in entries if not fails]
    wanted = [not fails and not any(beats(other, row) for other in sound) for row, fails in entries]
    assert setup_table(series, RBF(Cubic()))["nondominated"].tolist() == wanted


@each
@both
@given(populations)
@settings(max_examples=25)
def test_a_result_of_any_population_has_no_nan_score_and_no_failure_on_its_front(
    case: str, manipulation: str, drawn: list[Recipe]
) -> None:
    centers = population(drawn, case)
    scores = evaluator(case, manipulation)(centers)
    p = len(centers)
    found = setup_table([Rows("random", centers, scores, torch.full((p,), NAN))], RBF(Cubic()))
    for name in ("regularity", "improvement_potential", "variability"):
        assert np.isfinite(found[name]).all()
    assert not found["nondominated"][scores.failed.numpy()].any()
    assert found["nondominated"].any() == (not scores.failed.all())


N = 6


@given(st.lists(st.lists(st.one_of(rows, nan_rows), min_size=N, max_size=N), min_size=2, max_size=4), st.integers(0, 9))
@settings(max_examples=40)
def test_selection_keeps_no_failure_while_there_are_enough_others(generations: list[list[Row]], seed: int) -> None:
    lower, upper = torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    nsga2 = NSGA2(torch.rand(N, 2, dtype=torch.float64, generator=generator), lower, upper, generator=generator)
    sound = 0
    for generation in generations:
        asked = nsga2.ask()
        assert ((asked >= lower) & (asked <= upper)).all()
        before = nsga2.objectives
        F = table(generation)
        nsga2.tell(F)
        everyone = torch.cat([before, F]) if len(before[0]) else F
        sound = int((~everyone.isnan().any(dim=1)).sum())
        kept = ~nsga2.objectives.isnan().any(dim=1)
        assert int(kept.sum()) == min(N, sound)
        front = everyone[nondominated(everyone)]
        if len(front) <= N:  # all of it survives
            assert sorted(front.tolist()) == sorted(nsga2.objectives[: len(front)].tolist())
        else:
            assert nondominated(everyone)[[everyone.tolist().index(row) for row in nsga2.objectives.tolist()]].all()


fitness = st.one_of(few, st.sampled_from([NAN, INF, -INF, *HARD]))


@given(st.lists(st.lists(fitness, min_size=6, max_size=6), min_size=1, max_size=8), st.booleans(), st.booleans())
@example([[NAN] * 6] * 3, True, False)
@example([[INF] * 5 + [NAN]] * 3, True, True)
@example([[1.0, *[-1.0] * 5], [0.5, *[-1.0] * 5]], True, True)  # the best was told before
@example([[HUGE, -HUGE, INF, -INF, NAN, 0.0]] * 8, True, False)
@settings(max_examples=50)
def test_no_fitness_breaks_cmaes_or_moves_the_element_beside(
    rounds: list[list[float]], covariance: bool, bounded: bool
):
    D = 3

    def started() -> CMAES:
        most = 1.0 if bounded else INF
        mean = torch.full((2, D), 0.25, dtype=torch.float64)
        generators = [torch.Generator().manual_seed(b) for b in range(2)]
        bounds = torch.full((D,), 0.0 if bounded else -INF), torch.full((D,), most)
        return CMAES(mean, 0.3, *bounds, generators=generators, parents=2, offspring=6, covariance=covariance)

    tried, calm = started(), started()
    for values in rounds:
        x, y = tried.ask(), calm.ask()
        assert torch.equal(x[1], y[1])
        assert x.isfinite().all()
        if bounded:
            assert ((x >= 0.0) & (x <= 1.0)).all()
        other = -(x[1].square().sum(-1))
        mean = tried.mean[0].clone()
        tried.tell(torch.stack([torch.tensor(values, dtype=torch.float64), other]))
        calm.tell(torch.stack([torch.zeros(6, dtype=torch.float64), other]))
        if len({-INF if math.isnan(value) else value for value in values}) == 1:
            assert torch.equal(tried.mean[0], mean)
    for name, value in tried.state_dict().items():
        if isinstance(value, Tensor) and name != "best_fitness":
            assert value.isfinite().all(), name
    assert not tried.best_fitness.isnan().any()
    above = [value for values in rounds for value in values if not math.isnan(value)]
    assert float(tried.best_fitness[0]) == max([-INF, *above])
    for name, value in calm.state_dict().items():
        if isinstance(value, Tensor):
            assert torch.equal(value[1], tried.state_dict()[name][1]), name
