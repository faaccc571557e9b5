"""NSGA-II: convergence beside pymoo, operators beside pymoo's, elitism, reproducibility, resume, the box, bad input."""

import math
import statistics
from collections.abc import Callable
from typing import Any, cast

import moocore
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pymoo.algorithms.moo import nsga2 as pymoo
from pymoo.operators.crossover.sbx import SBX, cross_sbx
from pymoo.operators.mutation.pm import PM, mut_pm
from pymoo.optimize import minimize
from pymoo.problems import get_problem
from scipy.stats import ks_2samp
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.nsga2 import NSGA2, _crossover, _mutate
from rbfevo.scoring.pareto import crowding, nondominated, ranks

Objectives = Callable[[Tensor], Tensor]


def zdt(number: int) -> Objectives:
    """ZDT1, 2 or 3 (Zitzler, Deb and Thiele 2000), negated: maximized."""

    def objectives(x: Tensor) -> Tensor:
        f = x[:, 0]
        g = 1 + 9 * x[:, 1:].mean(dim=1)
        h = {1: 1 - (f / g).sqrt(), 2: 1 - (f / g) ** 2, 3: 1 - (f / g).sqrt() - f / g * torch.sin(10 * math.pi * f)}
        return -torch.stack([f, g * h[number]], dim=1)

    return objectives


def search(N: int = 20, D: int = 5, seed: int = 0, low: float = 0.0, high: float = 1.0, **settings) -> NSGA2:
    generator = torch.Generator().manual_seed(seed)
    lower, upper = torch.full((D,), low, dtype=torch.float64), torch.full((D,), high, dtype=torch.float64)
    initial = lower + (upper - lower) * torch.rand(N, D, dtype=torch.float64, generator=generator)
    return NSGA2(initial, lower, upper, generator=generator, **settings)


def advance(nsga2: NSGA2, objectives: Objectives, generations: int) -> NSGA2:
    for _ in range(generations):
        nsga2.tell(objectives(nsga2.ask()))
    return nsga2


def area(minimized: np.ndarray) -> float:
    return float(moocore.hypervolume(minimized, ref=[1.1, 1.1]))


@pytest.mark.parametrize("problem", [1, 2, 3])
@pytest.mark.parametrize("pymoo_seeds", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_median_hypervolume_within_one_percent_of_pymoo(problem: int, pymoo_seeds: int) -> None:
    ours = [area(-advance(search(100, 30, s), zdt(problem), 250).objectives.numpy()) for s in range(5)]
    theirs = []
    for seed in range(pymoo_seeds):  # prob is of a pair and of an individual, prob_var of each variable of it
        crossover, mutation = SBX(prob=0.9, prob_var=0.5, eta=20), PM(prob=1.0, prob_var=1 / 30, eta=20)
        algorithm = pymoo.NSGA2(pop_size=100, crossover=crossover, mutation=mutation)
        front = minimize(get_problem(f"zdt{problem}"), algorithm, ("n_gen", 250), seed=seed).F
        theirs.append(area(np.asarray(front)))
    print(
        f"ZDT{problem}: median {statistics.median(ours):.5f} {ours}, pymoo's {statistics.median(theirs):.5f} {theirs}"
    )
    assert statistics.median(ours) == pytest.approx(statistics.median(theirs), rel=0.01)


def one_pair(children_of: int, x: tuple[float, float], **settings) -> Tensor:
    """All children of a population where every pair of parents is x[0] with x[1], one variable each."""
    generator = torch.Generator().manual_seed(3)
    initial = torch.tensor(x, dtype=torch.float64).repeat_interleave(children_of // 2)[:, None]
    nsga2 = NSGA2(initial, torch.zeros(1), torch.ones(1), generator=generator, **settings)
    return advance(nsga2, lambda individuals: torch.zeros(len(individuals), 2), 1).ask()[:, 0]


def assert_same_distribution(a: np.ndarray, b: np.ndarray) -> None:
    _, p = cast(tuple[float, float], ks_2samp(a, b))
    assert p > 0.01


def test_crossover_is_distributed_as_pymoos() -> None:
    a, b, n = 0.05, 0.4, 20_000
    # Equal objectives: pairs are drawn from the population at random, so half of them mate a with b.
    children = one_pair(2 * n, (a, b), crossover_probability=1.0, mutation_probability=0.0)
    children = children[(children != a) & (children != b)].numpy()
    assert len(children) == pytest.approx(n / 2, rel=0.05)  # half the pairs are mixed, half of their variables cross
    parents = np.array([[[a]] * n, [[b]] * n])
    of_pymoo = cross_sbx(
        parents,
        np.zeros(1),
        np.ones(1),
        np.full((n, 1), 20.0),
        np.full((n, 1), 1.0),
        np.full((n, 1), 0.5),
        random_state=np.random.default_rng(0),
    ).ravel()
    assert_same_distribution(children, of_pymoo)
    assert children.min() >= 0


@pytest.mark.parametrize("x", [0.0, 0.02, 0.5, 1.0])
def test_mutation_is_distributed_as_pymoos(x: float) -> None:
    n = 10_000
    children = one_pair(n, (x, x), mutation_probability=0.5).numpy()
    moved = children[children != x]
    assert len(moved) == pytest.approx(n / (4 if x in (0.0, 1.0) else 2), rel=0.05)  # at a bound half the steps are 0
    arguments = (np.full((n, 1), x), np.zeros(1), np.ones(1), np.full(n, 20.0), np.ones(n), False)
    of_pymoo = mut_pm(*arguments, random_state=np.random.default_rng(0)).ravel()
    assert_same_distribution(moved, of_pymoo[of_pymoo != x])


@pytest.mark.parametrize(
    ("probability", "expected"), [(0.0, 0.0), (0.5, 0.25), (1.0, 0.5)], ids=["never", "half", "always"]
)
def test_crossover_probability_is_of_a_pair_and_half_of_its_variables_cross(probability: float, expected: float):
    pairs = []
    for seed in range(5):
        nsga2 = search(400, 50, seed, crossover_probability=probability, mutation_probability=0.0)
        advance(nsga2, lambda x: x[:, :2] * 0, 1)
        crossed = (~torch.isin(nsga2.ask(), nsga2.population)).view(2, 200, 50)
        assert torch.equal(crossed[0], crossed[1])
        pairs.append(crossed[0])
    crossed = torch.cat(pairs).double()
    assert float(crossed.mean()) == pytest.approx(expected, abs=0.03)
    assert float(crossed.amax(dim=1).mean()) == pytest.approx(probability, abs=0.06)  # standard error 0.016


def test_first_ask_is_the_initial_population_and_asking_twice_changes_nothing() -> None:
    nsga2 = search()
    initial = nsga2.population.clone()
    assert torch.equal(nsga2.ask(), initial)
    assert nsga2.generation == 0
    advance(nsga2, zdt(1), 1)
    assert nsga2.generation == 1
    offspring = nsga2.ask()
    assert torch.equal(nsga2.ask(), offspring)
    assert offspring.shape == initial.shape
    assert offspring.dtype == torch.float64


@pytest.mark.parametrize("M", [1, 2, 3])
def test_survivors_are_the_best_of_parents_and_offspring(M: int) -> None:
    def objectives(x: Tensor) -> Tensor:
        return -torch.stack([((x - 0.2 * k) ** 2).sum(dim=1) for k in range(1, M + 1)], dim=1)

    nsga2 = advance(search(30, 4, mutation_probability=1.0), objectives, 1)  # no clones, so no ties
    for _ in range(15):
        offspring = nsga2.ask()
        everyone = torch.cat([nsga2.population, offspring])
        F = torch.cat([nsga2.objectives, objectives(offspring)])
        nsga2.tell(objectives(offspring))
        rank = ranks(F)
        distance = crowding(F, rank)
        best = sorted(range(len(F)), key=lambda i: (int(rank[i]), -float(distance[i])))[:30]
        chosen = [(everyone == individual).all(dim=1).nonzero()[0, 0] for individual in nsga2.population]
        assert sorted(float(distance[i]) for i in chosen) == pytest.approx(sorted(float(distance[i]) for i in best))
        assert [int(rank[i]) for i in chosen] == [int(rank[i]) for i in best]
        assert torch.equal(nsga2.objectives, objectives(nsga2.population))


def test_hypervolume_of_the_population_stays_where_the_front_fits() -> None:
    nsga2 = advance(search(40, 6), zdt(1), 1)
    for _ in range(30):
        before = nsga2.objectives
        advance(nsga2, zdt(1), 1)
        best = before.max(dim=0).values
        assert (nsga2.objectives.max(dim=0).values >= best).all()  # the ends of the front are never lost
        if int(nondominated(nsga2.objectives).sum()) < 40:  # nothing was cut, so no survivor is dominated by the past
            both = torch.cat([before, nsga2.objectives])
            assert nondominated(both)[40:].sum() == nondominated(nsga2.objectives).sum()


def test_same_seed_same_result_and_another_seed_another() -> None:
    first, again, other = (advance(search(seed=s), zdt(3), 20) for s in (1, 1, 2))
    assert torch.equal(first.population, again.population)
    assert torch.equal(first.objectives, again.objectives)
    assert not torch.equal(first.population, other.population)


@pytest.mark.parametrize("after", [0, 1, 2, 7])
@pytest.mark.parametrize("asked", [False, True])
def test_resumed_equals_uninterrupted(tmp_path, after: int, asked: bool) -> None:
    whole = advance(search(seed=5), zdt(2), 12)
    half = advance(search(seed=5), zdt(2), after)
    if asked:
        half.ask()
    torch.save(half.state_dict(), tmp_path / "state.pt")
    advance(half, zdt(2), 3)  # what goes on after the save must not reach into it
    resumed = search(seed=99)
    resumed.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert resumed.generation == after
    advance(resumed, zdt(2), 12 - after)
    assert torch.equal(resumed.population, whole.population)
    assert torch.equal(resumed.objectives, whole.objectives)
    assert torch.equal(resumed.ask(), whole.ask())
    assert resumed.generation == whole.generation == 12


@given(
    N=st.integers(2, 12).map(lambda half: 2 * half),
    D=st.integers(1, 6),
    low=st.floats(-1e6, 1e6),
    width=st.sampled_from([0.0, 1e-12, 1e-3, 1.0, 1e9]),
    eta=st.sampled_from([0.0, 0.5, 3.3, 20.0]),
    probability=st.sampled_from([0.0, 0.3, 1.0]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_offspring_stay_in_the_box(N, D, low, width, eta, probability, seed) -> None:
    options = {"crossover_eta": eta, "mutation_eta": eta, "mutation_probability": probability}
    nsga2 = search(N, D, seed, low, low + width, **options)
    for _ in range(4):
        x = nsga2.ask()
        assert ((x >= nsga2.lower) & (x <= nsga2.upper)).all()  # false for NaN
        nsga2.tell(torch.stack([x[:, 0], -x[:, -1]], dim=1))


def test_failed_individuals_die_first() -> None:
    def objectives(x: Tensor) -> Tensor:
        F = zdt(1)(x)
        F[x[:, 1] > 0.5, 1] = math.nan
        return F

    nsga2 = advance(search(40), objectives, 1)
    healthy = int((~nsga2.objectives.isnan().any(dim=1)).sum())
    assert 0 < healthy < 40
    assert not nsga2.objectives[:healthy].isnan().any()  # sorted: failures last
    advance(nsga2, objectives, 10)
    assert not nsga2.objectives.isnan().any()
    assert not torch.isnan(advance(search(), lambda x: x[:, :2] * math.nan, 5).population).any()


@pytest.mark.parametrize("M", [1, 2, 3])
def test_constant_objectives(M: int) -> None:
    flat = advance(search(12), lambda x: torch.ones(len(x), M), 5)
    assert len(flat.population.unique(dim=0)) > 4  # ties broken at random: no individual takes over
    half = advance(search(20, 5), lambda x: torch.stack([-(x**2).sum(dim=1), 0 * x[:, 0]], dim=1), 60)
    assert float(half.objectives[:, 0].max()) > -1e-3  # the other objective is still optimized


def test_ties_in_the_tournament_favour_nobody() -> None:
    counts = torch.zeros(8)
    for seed in range(400):
        generator = torch.Generator().manual_seed(seed)
        initial = torch.arange(8.0, dtype=torch.float64)[:, None] / 8
        options = {"crossover_probability": 0.0, "mutation_probability": 0.0}
        nsga2 = NSGA2(initial, torch.zeros(1), torch.ones(1), generator=generator, **options)
        children = advance(nsga2, lambda x: torch.zeros(len(x), 2), 1).ask()
        counts += (children * 8).long().flatten().bincount(minlength=8)
    assert (counts / 400 - 1).abs().max() < 0.15  # each index has one child on average; standard error 0.035


def test_better_parents_win_the_tournament() -> None:
    nsga2 = advance(search(10, 2, crossover_probability=0.0, mutation_probability=0.0), lambda x: x[:, :1], 1)
    best, worst = nsga2.population[0], nsga2.population[-1]
    children = nsga2.ask()
    assert (children == best).all(dim=1).sum() == 2  # it enters twice and never loses
    assert not (children == worst).all(dim=1).any()


def test_objectives_with_a_graph_leave_none_behind() -> None:
    nsga2 = search()
    weight = torch.ones(1, dtype=torch.float64, requires_grad=True)
    advance(nsga2, lambda x: zdt(1)(x) * weight, 3)
    assert not nsga2.objectives.requires_grad
    assert not nsga2.ask().requires_grad


@pytest.mark.parametrize("N", [0, 2, 7])
def test_odd_and_too_small_populations_are_refused(N: int) -> None:
    with pytest.raises(UserError, match=rf"^nsga2: population={N}: [^\n]+$"):
        search(N)


@pytest.mark.parametrize(
    "wrong",
    [
        {"crossover_probability": 1.1},
        {"mutation_probability": -0.1},
        {"mutation_probability": math.nan},
        {"crossover_eta": -1.0},
        {"mutation_eta": math.inf},
        {"high": math.inf},
        {"low": 2.0},
    ],
)
def test_settings_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=r"^(NSGA-II|nsga2): [^\n]+$"):
        search(**wrong)


def test_calls_that_do_not_fit_are_refused() -> None:
    nsga2 = search(20)
    with pytest.raises(UserError, match="before ask"):
        nsga2.tell(torch.zeros(20, 2))
    nsga2.ask()
    for shape in [(19, 2), (20,), (20, 0)]:
        with pytest.raises(UserError, match="do not fit"):
            nsga2.tell(torch.zeros(shape))
    nsga2.tell(torch.zeros(20, 2))
    nsga2.ask()
    with pytest.raises(UserError, match="do not fit"):
        nsga2.tell(torch.zeros(20, 3))
    with pytest.raises(UserError, match="saved population"):
        search(22).load_state_dict(nsga2.state_dict())
    with pytest.raises(UserError, match="not inside the box"):
        NSGA2(torch.full((4, 1), math.nan), torch.zeros(1), torch.ones(1), generator=torch.Generator())


@pytest.mark.parametrize("eta", [1.0, 5.0, 20.0])
@pytest.mark.parametrize("choice", [0.01, 0.1, 0.2, 0.3, 0.45, 0.6])
def test_crossover_is_the_closed_form_of_deb_and_agrawal(choice: float, eta: float) -> None:
    """For a variable that crosses: u is `choice` without its first two binary digits."""
    lower, upper, first, second = -1.0, 3.0, 0.7, 1.9
    parents = np.array([[first], [second]])
    _crossover(parents, np.array([lower]), np.array([upper]), eta, np.array([choice]))
    if choice >= 0.5:
        assert parents.ravel().tolist() == [first, second]
        return
    u = (4.0 * choice) % 1.0

    def spread(room: float) -> float:
        beta = 1.0 + 2.0 * room / (second - first)
        alpha = 2.0 - beta ** -(eta + 1.0)
        return (u * alpha if u <= 1.0 / alpha else 1.0 / (2.0 - u * alpha)) ** (1.0 / (eta + 1.0))

    middle, half = (first + second) / 2, (second - first) / 2
    children = [middle - spread(first - lower) * half, middle + spread(upper - second) * half]
    assert parents.ravel().tolist() == pytest.approx(children if choice < 0.25 else children[::-1], rel=1e-12)


@pytest.mark.parametrize("eta", [1.0, 20.0])
@pytest.mark.parametrize("u", [0.001, 0.2, 0.5, 0.7, 0.999])
def test_mutation_is_the_closed_form_of_deb_and_goyal(u: float, eta: float) -> None:
    lower, upper, x, probability = -1.0, 3.0, 0.2, 0.4
    mutated, kept = np.array([x]), np.array([x])
    _mutate(mutated, np.array([lower]), np.array([upper]), eta, probability, np.array([u * probability]))
    _mutate(kept, np.array([lower]), np.array([upper]), eta, probability, np.array([0.4 + 0.6 * u]))
    below, above = (x - lower) / (upper - lower), (upper - x) / (upper - lower)
    if u <= 0.5:
        delta = (2 * u + (1 - 2 * u) * (1 - below) ** (eta + 1)) ** (1 / (eta + 1)) - 1
    else:
        delta = 1 - (2 * (1 - u) + 2 * (u - 0.5) * (1 - above) ** (eta + 1)) ** (1 / (eta + 1))
    assert mutated[0] == pytest.approx(x + delta * (upper - lower), rel=1e-9, abs=1e-12)
    assert kept[0] == x
