"""`python -m benchmarks.bench_bounded`: passes and times of bounded potential (p = 16) beside P, on the same designs.

One thread, 25 centers. Every round times P (a value), P_16 cold (a value), and P_16 with its gradient, cold and warm:
from the optimum of setups whose centers were moved by 0.5 % of the box. Ratios are medians over the rounds of what was
timed one after the other.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rbfevo.scenarios import face, plane
from rbfevo.scoring.bounded import BoundedPotential, Optima
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import triharmonic, wendland
from rbfevo.scoring.symmetric import evaluator_of
from rbfevo.scoring.threads import coarse

SETUPS, CENTERS, MOVED, NORM = 24, 25, 0.005, 16.0


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Milliseconds a setup, and what `work` returns."""
    begin = time.perf_counter()
    found = work()
    return (time.perf_counter() - begin) / SETUPS * 1e3, found


def case(
    evaluate: Evaluator, bounded: BoundedPotential, moved: Tensor, near: Tensor, rounds: int
) -> tuple[list[float], list[float]]:
    """Passes (value cold and warm, gradient cold and warm), and P's milliseconds with the three ratios."""
    ratios: list[tuple[float, ...]] = []
    found: list[Optima] = []
    for _ in range(rounds):
        plain, _ = timed(lambda: evaluate(moved))
        value, cold = timed(lambda: bounded.optima(moved))
        slope, tight = timed(lambda: bounded.optima(moved, gradients=True))
        again, warm = timed(lambda: bounded.optima(moved, near, gradients=True))
        ratios.append((plain, value / plain, slope / plain, again / plain))
        found = [cold, bounded.optima(moved, near), tight, warm]
    passes = [float(one.passes.double().mean()) for one in found]
    return passes, [statistics.median(column) for column in zip(*ratios, strict=True)]


def main() -> None:
    """Print one line per design and kernel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    print("| case | passes: value cold, warm; gradient cold, warm | P [ms] | over P: value, with gradient, warm |")
    print("|---|---|---|---|")
    designs = (("plane 22,500", plane()), ("plane 1,800", plane((30, 60))), ("face 10,242", face()))
    with coarse():
        for name, scenario in designs:
            d = scenario.vertices.shape[1]
            for kernel in (wendland(d, scenario.support), triharmonic(d)):
                evaluate = evaluator_of(scenario, kernel, "indirect")
                bounded = BoundedPotential(scenario.vertices, scenario.gradient, kernel, NORM, scenario.weights)
                generator = torch.Generator().manual_seed(0)
                centers = scenario.sample(SETUPS, CENTERS, generator)
                side = scenario.search_box[1] - scenario.search_box[0]
                noise = torch.randn(centers.shape, generator=generator, dtype=centers.dtype)
                near = bounded.optima(centers).weights
                moved = centers + MOVED * side * noise
                evaluate(moved)
                passes, median = case(evaluate, bounded, moved, near, rounds)
                print(
                    f"| {name}, {kernel.name} | {passes[0]:.1f}, {passes[1]:.1f}; {passes[2]:.1f}, {passes[3]:.1f} "
                    f"| {median[0]:.2f} | {median[1]:.0f}, {median[2]:.0f}, {median[3]:.0f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
