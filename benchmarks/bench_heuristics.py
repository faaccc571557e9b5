"""Complete runs of the heuristics Lloyd and OLS, compared with the minute that the paper reports for each."""

from __future__ import annotations

import time
from collections.abc import Iterator

import torch

from benchmarks.bench_cases import CENTERS, Case, cases, kernel, scenario
from benchmarks.bench_rows import Row, at_most
from benchmarks.measure import in_child, interleaved, median, peak_memory, timed
from rbfevo.methods.candidates import grid_candidates
from rbfevo.methods.lloyd import lloyd
from rbfevo.methods.ols import Selection, ols
from rbfevo.scoring.gram import kernel_columns
from rbfevo.scoring.threads import coarse

PAPER = 60.0  # seconds


def lloyd_row(case: Case, rounds: int, m: int = CENTERS) -> Row:
    """Ten starts of k-means; every round has its own seed."""
    s, generator = case.scenario, torch.Generator().manual_seed(0)
    (seconds,) = interleaved(
        (timed(lambda: lloyd(s.vertices, m, generator=generator, weights=s.weights)),), rounds, pause=0.0
    )
    return Row(
        "heuristics",
        f"Lloyd, {s.name}",
        median(seconds),
        "s",
        PAPER,
        "the paper",
        median(seconds) / PAPER,
        note=f"{m} centers, n = {len(s.vertices):,}",
        **at_most(1, median(seconds), " s"),
    )


def select(case: Case, m: int = CENTERS, per_axis: int = 30) -> Selection:
    """The centers that OLS selects, called as in `rbfevo.methods`."""
    s = case.scenario
    candidates = grid_candidates(s.lower, s.upper, per_axis)
    return ols(kernel_columns(s.vertices, case.kernel), candidates, s.gradient, m, weights=s.weights)


def ols_row(case: Case, rounds: int, m: int = CENTERS, per_axis: int = 30) -> Row:
    """OLS on the plane, timed in this process."""
    (seconds,) = interleaved((timed(lambda: select(case, m, per_axis)),), rounds, pause=0.0)
    return _ols_row(case, median(seconds), 1.0, m, per_axis)


def _ols_row(case: Case, seconds: float, limit: float, m: int, per_axis: int) -> Row:
    n, d = case.scenario.vertices.shape
    return Row(
        "heuristics",
        f"OLS, {case.name}",
        seconds,
        "s",
        PAPER,
        "the paper",
        seconds / PAPER,
        note=f"{m} of {per_axis**d:,}, n = {n:,}",
        **at_most(limit, seconds, " s"),
    )


def ols_alone(support: float | None) -> tuple[float, float]:
    """Seconds of OLS on the face and peak memory in MB; to be called in a child process."""
    case = Case(scenario("face"), kernel(support, 3))
    with coarse():
        kernel_columns(case.scenario.vertices, case.kernel)(case.scenario.vertices[:2])  # compiles the kernel
        start = time.perf_counter()
        select(case)
        return time.perf_counter() - start, peak_memory()


def ols_face_rows(case: Case) -> Iterator[Row]:
    """OLS with 27,000 candidates, in a child process so that its peak memory can be measured."""
    seconds, peak = in_child(ols_alone, support=case.kernel.support)
    yield _ols_row(case, seconds, 10.0, CENTERS, 30)
    yield Row(
        "heuristics",
        f"OLS, {case.name}: peak memory",
        peak,
        "MB",
        note="of the whole process, libraries included",
        **at_most(2000, peak, " MB"),
    )


def heuristics(quick: bool) -> Iterator[Row]:
    """Lloyd and OLS."""
    planes, faces = cases("plane"), cases("face")
    for case in (planes[0], faces[0]):
        yield lloyd_row(case, 1 if quick else 9)
    for case in planes[1:]:
        yield ols_row(case, 1 if quick else 9)
    for case in faces[1:]:
        yield from ols_face_rows(case)
