"""`python -m benchmarks.bench_bounded`: passes and times of bounded potential (p = 16) beside P, on the same designs.

One thread, 25 centers. Every round times P (a value) and P_16: of a population without predecessor and *warm*, from the
optimum of setups whose centers were moved by a share of the box; a value and with its gradient. Times are the thread's
processor times, since others may use the machine; ratios are medians over the rounds of what was timed one after the
other. `error` is the largest difference of a value from the converged one.
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
from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import triharmonic, wendland
from rbfevo.scoring.symmetric import evaluator_of
from rbfevo.scoring.threads import coarse

SETUPS, CENTERS, NORM = 24, 25, 16.0
MOVED = (0.001, 0.005)  # of the box


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Milliseconds a setup, and what `work` returns."""
    begin = time.thread_time()
    found = work()
    return (time.thread_time() - begin) / SETUPS * 1e3, found


def case(
    evaluate: Evaluator, bounded: BoundedPotential, centers: Tensor, starts: list[Tensor | None], rounds: int
) -> tuple[float, list[float], list[list[float]], list[list[float]]]:
    """P's milliseconds, and for each start passes and times over P's, of a value and with a gradient, and errors."""
    exact = bounded.values(centers, gap=0.0)
    plain, ratios = [], []
    passes: list[list[float]] = []
    errors: list[float] = []
    for _ in range(rounds):
        milliseconds, _ = timed(lambda: evaluate(centers))
        plain.append(milliseconds)
        passes, errors, row = [], [], []
        for start in starts:
            value, found = timed(lambda start=start: bounded.optima(centers, start))
            both, tight = timed(lambda start=start: bounded.optima(centers, start, gradients=True))
            passes.append([float(one.passes.double().mean()) for one in (found, tight)] + [float(found.passes.max())])
            errors.append(float((found.values - exact).abs().max()))
            row.append((value / milliseconds, both / milliseconds))
        ratios.append(row)
    medians = [[statistics.median(row[i][j] for row in ratios) for j in (0, 1)] for i in range(len(starts))]
    return statistics.median(plain), errors, passes, medians


def main() -> None:
    """Print one line per design, kernel and start."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    print("| case | P [ms] | start | passes: value (most), gradient | over P: value, with gradient | error |")
    print("|---|---|---|---|---|---|")
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
                starts = [None, *(bounded.optima(centers - moved * side * noise).near for moved in MOVED)]
                evaluate(centers)
                milliseconds, errors, passes, ratios = case(evaluate, bounded, centers, starts, rounds)
                labels = ["none", *(f"{100 * moved:g} % off" for moved in MOVED)]
                for label, error, (value, slope, most), (cheap, dear) in zip(
                    labels, errors, passes, ratios, strict=True
                ):
                    print(
                        f"| {name}, {kernel.name} | {milliseconds:.2f} | {label} "
                        f"| {value:.1f} ({most:.0f}), {slope:.1f} | {cheap:.0f}, {dear:.0f} | {error:.0e} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
