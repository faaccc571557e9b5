"""Scoring: compared with a NumPy loop and with the floor, with gradients, and on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from benchmarks.bench_cases import CENTERS, MANIPULATIONS, Case, cases
from benchmarks.bench_floor import BLOCKS, Floor
from benchmarks.bench_numpy import numpy_scores
from benchmarks.bench_rows import Row, at_least, at_most
from benchmarks.measure import fastest, interleaved, median, one_blas_thread, timed
from rbfevo.methods.nsga2 import NSGA2
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.gradients import differentiable_scores
from rbfevo.scoring.kernels import ThinPlate


class Search:
    """NSGA-II on one case from a random population; every call is one generation, as in `rbfevo.methods`."""

    def __init__(self, case: Case, evaluator: Evaluator, population: int = 100, m: int = CENTERS) -> None:
        s = case.scenario
        centers = case.population(population, m)
        self.evaluator, self.m = evaluator, m
        generator = torch.Generator().manual_seed(1)
        self.algorithm = NSGA2(centers.flatten(1), s.lower.repeat(m), s.upper.repeat(m), generator=generator)
        self()

    def __call__(self) -> None:
        centers = self.algorithm.ask().unflatten(1, (self.m, -1))
        self.algorithm.tell(self.evaluator(centers).objectives)

    @property
    def setups(self) -> Tensor:
        """The population [p, m, d]."""
        return self.algorithm.population.unflatten(1, (self.m, -1))


def scoring_row(case: Case, manipulation: str, rounds: int, population: int = 100, m: int = CENTERS) -> Row:
    """A generation of NSGA-II compared with the NumPy loop over a few of its individuals."""
    search = Search(case, case.evaluator(manipulation), population, m)
    X, g = case.scenario.vertices.numpy(), case.scenario.gradient.numpy()
    few = 3

    def loop() -> object:
        """Score a few individuals with NumPy."""
        return numpy_scores(X, g, search.setups[:few].numpy(), case.kernel.support, manipulation)

    # NumPy's default number of threads or one thread, whichever is faster here.
    seconds = interleaved((timed(search), timed(loop), one_blas_thread(timed(loop))), rounds)
    threads = fastest(seconds[1:])
    ours, theirs = seconds[0] / population, seconds[1 + threads] / few
    ratio = median(theirs / ours)
    on_plane = case.scenario.name == "plane"  # targets apply to the plane only
    target = at_least(20 if isinstance(case.kernel, ThinPlate) else 40, ratio) if on_plane else {}
    return Row(
        group="scoring",
        name=f"{case.name}, {manipulation}",
        value=1.0 / median(ours),
        unit="setups/s",
        peer=1.0 / median(theirs),
        against="NumPy loop" + ("", ", one thread")[threads],
        ratio=ratio,
        note=f"n = {len(X):,}, m = {m}, {search.evaluator.backend}; a generation of {population}",
        **target,
    )


def floor_rows(case: Case, rounds: int, population: int = 100, m: int = CENTERS) -> Iterator[Row]:
    """The evaluator alone, both manipulations, compared with the floor at the fastest of three block sizes."""
    (n, k), centers = case.scenario.gradient.shape, case.population(population, m)
    evaluators = [case.evaluator(manipulation) for manipulation in MANIPULATIONS]
    floors = [Floor(n, m, k, case.kernel, block) for block in BLOCKS]
    tasks = [timed(_scoring(evaluator, centers)) for evaluator in evaluators]
    tasks += [timed(_floor(floor, population)) for floor in floors]
    seconds = interleaved(tasks, rounds) / population
    best = fastest(seconds[2:])
    for evaluator, ours in zip(evaluators, seconds[:2], strict=True):
        ratio = median(ours / seconds[2 + best])
        again = evaluator.further_passes / evaluator.evaluations
        yield Row(
            group="floor",
            name=f"{case.name}, {evaluator.deformation.manipulation}",
            value=1e3 * median(ours),
            unit="ms a setup",
            peer=1e3 * median(seconds[2 + best]),
            against=f"floor, B = {BLOCKS[best]}",
            ratio=ratio,
            note=f"{again:.0%} need further passes",
            **at_most(1.6, ratio),
        )


def gradient_row(case: Case, manipulation: str, rounds: int, population: int = 48, m: int = CENTERS) -> Row:
    """Values and gradients of R + P compared with the evaluator's scores."""
    evaluator, centers = case.evaluator(manipulation), case.population(population, m)

    def with_gradient() -> None:
        """Score the setups and backpropagate R + P."""
        variable = centers.clone().requires_grad_()
        regularity, potential = differentiable_scores(evaluator, variable)
        (regularity + potential).sum().backward()

    both, forward = interleaved((timed(with_gradient), timed(_scoring(evaluator, centers))), rounds) / population
    ratio = median(both / forward)
    return Row(
        group="gradient",
        name=f"{case.name}, {manipulation}",
        value=1e3 * median(both),
        unit="ms a setup",
        peer=1e3 * median(forward),
        against="evaluator",
        ratio=ratio,
        note="value and gradient to value",
        **at_most(4, ratio),
    )


def _scoring(evaluator: Evaluator, centers: Tensor) -> Callable[[], object]:
    return lambda: evaluator(centers)


def _floor(floor: Floor, setups: int) -> Callable[[], object]:
    return lambda: floor(setups)


def _places(quick: bool) -> tuple[str, ...]:
    return ("plane",) if quick else ("plane", "face")


def scoring(quick: bool) -> Iterator[Row]:
    """Setups per second in a search, compared with a NumPy loop."""
    for place in _places(quick):
        for case in cases(place):
            for manipulation in MANIPULATIONS:
                yield scoring_row(case, manipulation, 5 if quick else 21)


def floor(quick: bool) -> Iterator[Row]:
    """The evaluator compared with its floor."""
    for place in _places(quick):
        for case in cases(place):
            yield from floor_rows(case, 7 if quick else 25)


def gradient(quick: bool) -> Iterator[Row]:
    """Value and gradient compared with the value alone."""
    for place in _places(quick):
        for case in cases(place):
            for manipulation in MANIPULATIONS:
                yield gradient_row(case, manipulation, 3 if quick else 15)


def cuda(quick: bool) -> Iterator[Row]:
    """Setups per second on a GPU, if there is one."""
    if not torch.cuda.is_available():
        yield Row("cuda", "setups a second on a GPU", None, "setups/s", note="not measured: no CUDA device")
        return
    device, population = torch.device("cuda"), 500 if quick else 2000
    for case in (*cases("face"), *cases("plane")):
        for manipulation in MANIPULATIONS:
            moved = case._replace(scenario=case.scenario.to(device))
            evaluator, centers = moved.evaluator(manipulation), case.population(population).to(device)

            def work(evaluator: Evaluator = evaluator, centers: Tensor = centers) -> None:
                """Score the setups and wait for the GPU."""
                evaluator(centers)
                torch.cuda.synchronize()

            (seconds,) = interleaved((timed(work),), 3 if quick else 9)
            yield Row(
                group="cuda",
                name=f"{case.name}, {manipulation}",
                value=population / median(seconds),
                unit="setups/s",
                against=torch.cuda.get_device_name(device),
                note=f"n = {len(case.scenario.vertices):,}, {population} setups at once",
            )
