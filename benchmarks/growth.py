"""`python -m benchmarks.growth`: how search time, score time and memory grow with centers m and vertices n.

Each point is measured in a process of its own, on one thread, so that its parts add up: the Gram passes over the
vertices, the backward passes, the m x m matrices, and what is left to the search itself. From m = 200 on a search has a
tenth of its generations, and its seconds are scaled up by what is missing. Exponents are slopes between neighbours.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

from benchmarks.bench_cases import Case, kernel, scenario
from benchmarks.measure import in_child, peak_memory
from benchmarks.panels import PANELS
from rbfevo.methods import GradientSearch
from rbfevo.runs import storage
from rbfevo.runs.run import Run
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.gram import GramAccumulator
from rbfevo.scoring.threads import coarse

DIRECTORY = Path(__file__).parents[1] / "docs"
CENTERS = (5, 10, 25, 50, 100, 200, 400)
VERTICES = (10_000, 100_000, 1_000_000, 10_000_000)
PANEL = "face-wendland-0.5-direct"
TENTH = 200  # centers from which on a search has a tenth of its generations
SETUPS = 8  # scored for a point of the score time, with 25 centers
KERNELS = {"Wendland 0.25": 0.25, "r^2 log r": None}


class Point(NamedTuple):
    """One point of a curve.

    Attributes:
        curve: its name; size: m or n; seconds: of a whole search, or of one setup's score.
        gram, backward, matrices, other: seconds of the parts; megabytes: peak memory of the process.
        share: of the generations that were carried out.
    """

    curve: str
    size: int
    seconds: float
    gram: float
    backward: float
    matrices: float
    other: float
    megabytes: float
    share: float


class Clock:
    """Seconds spent within functions, nested calls of the others taken off."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner = [0.0]

    def watch(self, owner: type, method: str, name: str) -> None:
        """From now on count the seconds of a method under a name."""
        plain: Callable[..., Any] = getattr(owner, method)

        def timed(*arguments: Any, **more: Any) -> Any:
            self._inner.append(0.0)
            begin = time.perf_counter()
            try:
                return plain(*arguments, **more)
            finally:
                spent = time.perf_counter() - begin
                self.seconds[name] = self.seconds.get(name, 0.0) + spent - self._inner.pop()
                self._inner[-1] += spent

        setattr(owner, method, timed)


def watched() -> Clock:
    """A clock of the parts of a search; in this process every later call counts."""
    clock = Clock()
    clock.watch(GramAccumulator, "__call__", "gram")
    clock.watch(GramAccumulator, "backward", "backward")
    clock.watch(Spectrum, "__init__", "matrices")
    clock.watch(Spectrum, "backward", "matrices")
    return clock


def searched(centers: int, generations: int, polish: int) -> dict[str, float]:
    """Seconds of a search and its parts, and peak memory; to be called in a child process."""
    (panel,) = [panel for panel in PANELS if panel.name == PANEL]
    budget = (f"method.generations={generations}", f"method.polish={polish}")
    with coarse():
        run = Run(panel.settings("method=gradient", f"centers={centers}", *budget))
        (search,) = run.stages
        problem = run.problem()
        problem.spectrum(problem.initial.centers[:2])  # compiled, or read from the cache, before the clock starts
        clock, begin = watched(), time.perf_counter()
        search.start(problem)
        started = time.perf_counter() - begin
        for _ in range(search.steps):
            search.step()
        seconds = time.perf_counter() - begin
    return {**clock.seconds, "seconds": seconds, "start": started, "megabytes": peak_memory()}


def scored(vertices: int, support: float | None) -> dict[str, float]:
    """Seconds of one setup's score and of its Gram pass, and peak memory; to be called in a child process."""
    side = round(math.sqrt(vertices))
    case = Case(scenario("plane", (side, side)), kernel(support, 2))
    with coarse():
        evaluator, setups = case.evaluator("indirect"), case.population(SETUPS)
        evaluator(setups[:1])
        clock, begin = watched(), time.perf_counter()
        evaluator(setups)
        seconds = time.perf_counter() - begin
    return {
        "seconds": seconds / SETUPS,
        "gram": clock.seconds["gram"] / SETUPS,
        "size": float(side * side),
        "megabytes": peak_memory(),
    }


def search_point(centers: int) -> Point:
    """The search time of so many centers."""
    share = 0.1 if centers >= TENTH else 1.0
    whole = GradientSearch()
    generations, polish = round(whole.generations * share), max(1, round(whole.polish * share))
    found = in_child(searched, centers=centers, generations=generations, polish=polish)
    factor = whole.steps / (generations + polish)
    gram, backward, matrices = (factor * found.get(name, 0.0) for name in ("gram", "backward", "matrices"))
    seconds = factor * (found["seconds"] - found["start"]) + found["start"]
    other = seconds - gram - backward - matrices
    curve = f"search, {PANEL}"
    return Point(curve, centers, seconds, gram, backward, matrices, other, found["megabytes"], share)


def score_point(name: str, vertices: int) -> Point:
    """The score time of so many vertices."""
    found = in_child(scored, vertices=vertices, support=KERNELS[name])
    seconds, gram = found["seconds"], found["gram"]
    return Point(f"score, plane, {name}", int(found["size"]), seconds, gram, 0.0, 0.0, seconds - gram,
                 found["megabytes"], 1.0)  # fmt: skip


def exponents(points: list[Point]) -> list[float]:
    """Slopes of log seconds over log size between neighbours; NaN for the first point."""
    found = [math.nan]
    for before, after in itertools.pairwise(points):
        found.append(math.log(after.seconds / before.seconds) / math.log(after.size / before.size))
    return found


def show(points: list[Point]) -> None:
    """Print one curve: seconds, exponent, shares of the parts, memory."""
    for point, exponent in zip(points, exponents(points), strict=True):
        shares = " ".join(
            f"{name} {100 * getattr(point, name) / point.seconds:3.0f} %"
            for name in ("gram", "backward", "matrices", "other")
        )
        note = "" if point.share == 1.0 else f"  ({point.share:g} of the generations)"
        print(f"{point.curve:34} {point.size:10,} {point.seconds:10.4g} s  ^{exponent:5.2f}  {shares}"
              f"  {point.megabytes:6.0f} MB{note}", flush=True)  # fmt: skip


def draw(curves: list[list[Point]], path: Path) -> None:
    """Both kinds of curves: search time over m with its parts, and score time over n."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for points in curves:
        sizes = [point.size for point in points]
        if not points[0].curve.startswith("search"):
            right.loglog(sizes, [point.seconds for point in points], "o-", label=points[0].curve)
            continue
        left.loglog(sizes, [point.seconds for point in points], "ko-", label="search")
        for name in ("gram", "backward", "matrices", "other"):
            left.loglog(sizes, [max(getattr(point, name), 1e-3) for point in points], ".-", label=name)
    for axes, label in ((left, "centers m"), (right, "vertices n")):
        axes.set_xlabel(label)
        axes.set_ylabel("seconds, one thread")
        axes.grid(visible=True, which="both", alpha=0.2)
        if axes.has_data():
            axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> int:
    """Measure, print, and write the table and the picture."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.growth", description=__doc__)
    parser.add_argument("--centers", nargs="*", type=int, default=CENTERS, help="default: 5 to 400")
    parser.add_argument("--vertices", nargs="*", type=int, default=VERTICES, help="default: 1e4 to 1e7")
    parser.add_argument(
        "--output", type=Path, default=DIRECTORY / "growth.csv", help="CSV file; default: docs/growth.csv"
    )
    parser.add_argument("--picture", type=Path, help="PNG file; default: none")
    arguments = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"  # of the child processes
    torch.set_num_threads(1)
    curves = [[search_point(centers) for centers in arguments.centers]]
    curves += [[score_point(name, vertices) for vertices in arguments.vertices] for name in KERNELS]
    curves = [points for points in curves if points]
    for points in curves:
        show(points)
    storage.write_whole(arguments.output, storage.csv_text(Point._fields, [one for points in curves for one in points]))
    if arguments.picture is not None:
        draw(curves, arguments.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
