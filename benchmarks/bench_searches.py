"""The overhead of the searches without scoring: NSGA-II compared with pymoo's, CMA-ES with that of `cma`."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.bench_rows import Row, at_most
from benchmarks.measure import fastest, interleaved, median, one_blas_thread
from rbfevo.methods.cmaes.algorithm import CMAES
from rbfevo.methods.nsga2 import NSGA2


def zdt1(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Zitzler, Deb and Thiele's first problem, a minimization: x [N, D] in [0, 1] -> [N, 2]."""
    g = 1.0 + 9.0 * x[:, 1:].mean(1)
    return np.stack((x[:, 0], g * (1.0 - np.sqrt(x[:, 0] / g))), 1)


class OurNSGA2:
    """rbfevo's NSGA-II; every call is one generation and returns the seconds of ask and tell alone."""

    def __init__(self, population: int, variables: int) -> None:
        generator = torch.Generator().manual_seed(0)
        initial = torch.rand(population, variables, generator=generator, dtype=torch.float64)
        zeros = torch.zeros(variables, dtype=torch.float64)
        self.algorithm = NSGA2(initial, zeros, zeros + 1.0, generator=generator)
        self()

    def __call__(self) -> float:
        start = time.perf_counter()
        x = self.algorithm.ask()
        asked = time.perf_counter()
        objectives = torch.from_numpy(-zdt1(x.numpy()))
        scored = time.perf_counter()
        self.algorithm.tell(objectives)
        return time.perf_counter() - scored + asked - start


class PymooNSGA2:
    """pymoo's NSGA-II with the same operators; like rbfevo's it keeps duplicates, which saves a distance matrix."""

    def __init__(self, population: int, variables: int) -> None:
        # Imported here because the child processes of other groups do not need it.
        from pymoo.algorithms.moo import nsga2 as pymoo
        from pymoo.core.problem import Problem
        from pymoo.core.termination import NoTermination
        from pymoo.operators.crossover.sbx import SBX
        from pymoo.operators.mutation.pm import PM

        self.algorithm: Any = pymoo.NSGA2(
            pop_size=population,
            crossover=SBX(prob=0.9, prob_var=0.5, eta=20),
            mutation=PM(prob=1.0, prob_var=1.0 / variables, eta=20),
            eliminate_duplicates=False,
        )
        problem = Problem(n_var=variables, n_obj=2, xl=0.0, xu=1.0)
        self.algorithm.setup(problem, termination=NoTermination(), seed=0, verbose=False)
        self()

    def __call__(self) -> float:
        start = time.perf_counter()
        individuals = self.algorithm.ask()
        asked = time.perf_counter()
        x = individuals.get("X")
        individuals.set("F", zdt1(x), "G", np.zeros((len(x), 0)), "H", np.zeros((len(x), 0)))
        for individual in individuals:
            individual.evaluated = {"F", "G", "H"}
        scored = time.perf_counter()
        self.algorithm.tell(infills=individuals)
        return time.perf_counter() - scored + asked - start


def nsga2_row(rounds: int, population: int = 100, variables: int = 50) -> Row:
    """NSGA-II's overhead per generation; the rounds are consecutive generations of both."""
    tasks = OurNSGA2(population, variables), PymooNSGA2(population, variables)
    ours, theirs = interleaved(tasks, rounds, pause=0.0)  # neither leaves spinning threads
    ratio, milliseconds = median(ours / theirs), 1e3 * median(ours)
    return Row(
        group="nsga2",
        name=f"own work, {population} of {variables} variables",
        value=milliseconds,
        unit="ms",
        peer=1e3 * median(theirs),
        against="pymoo's NSGA2",
        ratio=ratio,
        target="<= 2 ms and <= 0.5",
        met=milliseconds <= 2.0 and ratio <= 0.5,
        note="a generation on ZDT1; stretch 0.2",
    )


PREFERENCES = 11
STRETCH = 8  # generations per call: only every second or fourth decomposes C, so single ones are not comparable


class OurCMAES:
    """rbfevo's CMA-ES, all preferences as one batch; every call is STRETCH generations and returns seconds for one."""

    def __init__(self, variables: int) -> None:
        zeros = torch.zeros(variables, dtype=torch.float64)
        generators = [torch.Generator().manual_seed(b) for b in range(PREFERENCES)]
        mean = zeros.expand(PREFERENCES, -1) + 0.5
        self.search = CMAES(mean, 0.05, zeros, zeros + 1.0, generators=generators, parents=25, offspring=100)
        self.optima = torch.linspace(0.2, 0.8, PREFERENCES, dtype=torch.float64)[:, None, None]

    def _fitness(self, x: Tensor) -> Tensor:
        return -(x - self.optima).square().sum(-1)

    def __call__(self) -> float:
        seconds = 0.0
        for _ in range(STRETCH):
            start = time.perf_counter()
            x = self.search.ask()
            seconds += time.perf_counter() - start
            fitness = self._fitness(x)
            start = time.perf_counter()
            self.search.tell(fitness)
            seconds += time.perf_counter() - start
        return seconds / STRETCH


class ElevenCmas:
    """Eleven bounded strategies of `cma`, one after the other; returns seconds as `OurCMAES` does."""

    def __init__(self, variables: int) -> None:
        import cma  # imported here for the same reason as pymoo

        options = {"popsize": 100, "CMA_mu": 25, "bounds": [0, 1], "verbose": -9}
        self.searches = [
            cma.CMAEvolutionStrategy(variables * [0.5], 0.05, {**options, "seed": b + 1}) for b in range(PREFERENCES)
        ]
        self.optima = np.linspace(0.2, 0.8, PREFERENCES)

    def __call__(self) -> float:
        seconds = 0.0
        for search, optimum in zip(self.searches, self.optima, strict=True):
            for _ in range(STRETCH):
                start = time.perf_counter()
                points = search.ask()
                seconds += time.perf_counter() - start
                costs = [math.fsum((point - optimum) ** 2) for point in points]
                start = time.perf_counter()
                search.tell(points, costs)
                seconds += time.perf_counter() - start
        return seconds / STRETCH


def cmaes_row(variables: int, rounds: int) -> Row:
    """CMA-ES's overhead in a generation of all preferences."""
    peers = ElevenCmas(variables), one_blas_thread(ElevenCmas(variables))
    seconds = interleaved((OurCMAES(variables), *peers), rounds)
    threads = fastest(seconds[1:])
    ours, theirs = seconds[0], seconds[1 + threads]
    ratio = median(ours / theirs)
    return Row(
        group="cmaes",
        name=f"own work, {PREFERENCES} x (25,100), {variables} variables",
        value=1e3 * median(ours),
        unit="ms",
        peer=1e3 * median(theirs),
        against=f"{PREFERENCES} runs of cma" + ("", ", one thread")[threads],
        ratio=ratio,
        note="a generation on spheres in a box",
        **at_most(0.2, ratio),
    )


def nsga2(quick: bool) -> Iterator[Row]:
    """NSGA-II's overhead."""
    yield nsga2_row(100 if quick else 400)


def cmaes(quick: bool) -> Iterator[Row]:
    """CMA-ES's overhead."""
    for variables in (50, 75):
        yield cmaes_row(variables, 3 if quick else 15)
