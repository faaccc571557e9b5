"""What a run prints while it works: a rate over the last steps, and no estimate before there is one worth printing."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from rbfevo.methods.method import HistoryLine
from rbfevo.runs.progress import Rate, Reporter
from rbfevo.scoring import compilation


def record(method: str = "nsga2") -> HistoryLine:
    return HistoryLine(method, float("nan"), 1, 100, 1.0, 0.5, 0.4, 0.3, 0)


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_the_rate_is_that_of_the_last_steps() -> None:
    rate = Rate()
    assert rate() is None
    rate.mark(0.0, 5_000, "nsga2")  # what was there before
    assert rate() is None
    rate.mark(0.5, 5_100, "nsga2")
    assert rate() is None  # too short to tell
    rate.mark(2.0, 5_400, "nsga2")
    assert rate() == pytest.approx(200.0)
    for second in range(3, 60):  # it becomes slower, and the rate follows
        rate.mark(float(second), 5_400 + 10 * (second - 2), "nsga2")
    assert rate() == pytest.approx(10.0)
    rate.mark(60.0, 6_000, "cmaes")  # another method has another rate
    assert rate() is None


def test_a_compiler_and_an_earlier_part_of_a_run_do_not_count() -> None:
    clock, out = Clock(), io.StringIO()
    reporter = Reporter(10_000, quiet=False, console=Console(file=out, soft_wrap=True), clock=clock)
    clock.now += 100.0  # numba compiles within the first step
    reporter.update(4_000, 1, 50, [record()])
    clock.now += 4.0
    reporter.update(4_400, 2, 50, [record()])
    first, second = out.getvalue().splitlines()
    assert "evaluations/s" not in first
    assert first.startswith("nsga2 1/50: hypervolume 0.5000")
    assert second == "nsga2 2/50: 100 evaluations/s, hypervolume 0.5000, 56 s left"


def test_lines_come_now_and_then() -> None:
    clock, out = Clock(), io.StringIO()
    reporter = Reporter(10**6, quiet=False, console=Console(file=out, soft_wrap=True), clock=clock)
    for step in range(1, 41):
        clock.now += 1.0
        reporter.update(100 * step, step, 100, [record()])
    assert len(out.getvalue().splitlines()) == 4  # after 2 s, and then every 10 s


def test_a_compilation_is_announced_once() -> None:
    heard: list[str] = []
    compilation.begins()  # nobody listens
    with compilation.heard(heard.append):
        compilation.begins()
        compilation.begins()
    compilation.begins()
    assert heard == [compilation.WORDS]
