"""Memory that scoring many setups adds, and whether a large mesh costs more time per vertex."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from benchmarks.bench_cases import MANIPULATIONS, Case, kernel, scenario
from benchmarks.bench_rows import Row, at_most
from benchmarks.measure import in_child, interleaved, median, peak_memory, timed
from rbfevo.scoring.threads import coarse

SUPPORTS = (0.5, None)  # Wendland's kernel and r^2 log r, on the plane


def peaks(support: float | None, manipulation: str, setups: int, resolution: list[int]) -> tuple[float, float]:
    """Peak memory in MB after scoring a few setups of the plane and after `setups`; to be called in a child process."""
    case = Case(scenario("plane", (resolution[0], resolution[1])), kernel(support, 2))
    with coarse():
        evaluator, centers = case.evaluator(manipulation), case.population(setups)
        evaluator(centers[:8])
        before = peak_memory()
        evaluator(centers)
        return before, peak_memory()


def memory_row(
    support: float | None, manipulation: str, setups: int = 1000, resolution: tuple[int, int] = (150, 150)
) -> Row:
    """How much scoring raises the peak memory of a process."""
    before, after = in_child(
        peaks, support=support, manipulation=manipulation, setups=setups, resolution=list(resolution)
    )
    name = "r^2 log r" if support is None else f"Wendland {support:g}"
    raised = after - before
    return Row(
        group="memory",
        name=f"plane, {name}, {manipulation}: {setups:,} setups",
        value=raised,
        unit="MB",
        note=f"rise of the peak, {after:.0f} MB in all",
        **at_most(200, raised, " MB"),
    )


def size_row(support: float | None, rounds: int, large: tuple[int, int] = (1000, 1000), setups: int = 16) -> Row:
    """Time per setup and vertex on a large plane over that on the default one, indirect manipulation."""
    tasks, counts = [], []
    for resolution, count in ((large, setups), ((150, 150), 6 * setups)):
        case = Case(scenario("plane", resolution), kernel(support, 2))
        tasks.append(timed(_scoring(case, count)))
        counts.append(count * len(case.scenario.vertices))
    big, small = (seconds / count for seconds, count in zip(interleaved(tasks, rounds), counts, strict=True))
    ratio = median(big / small)
    return Row(
        group="memory",
        name=f"plane, {'r^2 log r' if support is None else f'Wendland {support:g}'}: n = {large[0] * large[1]:,}",
        value=1e9 * median(big),
        unit="ns",
        peer=1e9 * median(small),
        against="n = 22,500",
        ratio=ratio,
        note="a setup and vertex",
        **at_most(1.15, ratio),
    )


def _scoring(case: Case, count: int) -> Callable[[], object]:
    evaluator, centers = case.evaluator("indirect"), case.population(count)
    return lambda: evaluator(centers)


def memory(quick: bool) -> Iterator[Row]:
    """Peak memory of 1,000 setups, and time per vertex on a million vertices."""
    for support in SUPPORTS:
        for manipulation in MANIPULATIONS:
            yield memory_row(support, manipulation)
    for support in SUPPORTS:
        yield size_row(support, 3 if quick else 15)
