"""`python -m benchmarks.beside CHECKOUT`: compares the setups per second of this tree and another checkout.

The two are timed alternately, each round in a separate process with one thread per core: the scores of 200 setups, and
the value and gradient of 72, for each kernel on the plane and the face. Ratios are medians over the rounds and above 1
where this tree is faster. One ratio is of wall-clock time, the other of processor time, which other programs on the
machine disturb less.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
CODE = """
import json, time, torch
from rbfevo.scoring.kernels import triharmonic, wendland
from rbfevo.scoring.symmetric import evaluator_of
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scenarios import face, plane
from rbfevo.scoring.threads import coarse

found = {}
with coarse():
    for name, scenario in (("plane", plane()), ("face", face())):
        d = scenario.vertices.shape[1]
        centers = scenario.sample(200, 25, torch.Generator().manual_seed(0))
        for kernel in (wendland(d, scenario.support), triharmonic(d)):
            for manipulation in ("indirect", "direct"):
                evaluate = evaluator_of(scenario, kernel, manipulation)
                evaluate(centers[:4])
                begin, spent = time.perf_counter(), time.process_time()
                evaluate(centers)
                middle, half = time.perf_counter(), time.process_time()
                spectrum = Spectrum(evaluate, centers[:72])
                spectrum.backward(torch.ones(72, 25, dtype=torch.float64), torch.ones(72, dtype=torch.float64))
                end, whole = time.perf_counter(), time.process_time()
                case = f"{name}, {kernel.name}, {manipulation}"
                found[f"{case}: scores"] = 200 / (middle - begin), 200 / (half - spent)
                found[f"{case}: with gradient"] = 72 / (end - middle), 72 / (whole - half)
print(json.dumps(found))
"""


def timed(tree: Path) -> dict[str, tuple[float, float]]:
    """Setups per second of each case, in wall-clock and in processor time, measured in one process in `tree`."""
    settings = os.environ | {"OMP_NUM_THREADS": str(os.cpu_count()), "PYTHONPATH": str(tree)}
    done = subprocess.run([sys.executable, "-c", CODE], cwd=tree, env=settings, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{tree}: {done.stderr[-500:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Print the rates of both checkouts and their ratios, one line per case."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.beside", description=(__doc__ or "").partition("\n\n")[2]
    )
    parser.add_argument("checkout", type=Path, help="another checkout of this repository")
    parser.add_argument("--rounds", type=int, default=7, help="default: 7")
    arguments = parser.parse_args()
    other = arguments.checkout.resolve()
    for checkout in (ROOT, other):
        timed(checkout)  # compiles the kernels
    rounds = [
        (timed(ROOT), timed(other)) if i % 2 else (timed(other), timed(ROOT))[::-1] for i in range(arguments.rounds)
    ]
    print(f"{'setups a second':44} {'here':>8} {'there':>8} {'ratio':>8} {'processors':>11}")
    for case in rounds[0][0]:
        rates = [[[each[side][case][by] for each in rounds] for side in (0, 1)] for by in (0, 1)]
        clock, spent = (statistics.median(a / b for a, b in zip(*sides, strict=True)) for sides in rates)
        here, there = map(statistics.median, rates[0])
        print(f"{case:44} {here:8.0f} {there:8.0f} {clock:8.3f} {spent:11.3f}")


if __name__ == "__main__":
    main()
