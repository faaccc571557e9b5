"""Evaluates the fits: how R, P and the manipulations relate to generations and final error of the optimizations."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap, rankdata

from rbfevo.fit import MANIPULATIONS, STRATEGIES
from rbfevo.runs.storage import csv_text, write_whole
from reproduction import fits
from reproduction.study import KINDS, SCENARIOS, Study

Array = NDArray[Any]
RESAMPLES = 2000
ALL = "all kernels"
ERRORS = ("error", "optimum")


class Fitted(NamedTuple):
    """The fits of q setups of one scenario under one manipulation and strategy; medians over the seeds.

    Attributes:
        kind, setup: the kernel and the number of each setup, [q] each.
        R, P: of the setup under this manipulation, on the fitted mesh.
        generations: until convergence; fits that did not converge count as the cap.
        reached: the share of seeds that converged.
        error, optimum: the final and the least possible error, relative to that of the start.
    """

    kind: Array
    setup: Array
    R: Array
    P: Array
    generations: Array
    reached: Array
    error: Array
    optimum: Array

    def of(self, kind: str) -> Fitted:
        """The fits of one kernel, or of all."""
        return self if kind == ALL else Fitted(*(column[self.kind == kind] for column in self))


class Rank(NamedTuple):
    """Spearman's rank correlation, the ends of its 95 % confidence interval (bootstrap), and the number of setups."""

    value: float
    low: float
    high: float
    setups: int

    def __str__(self) -> str:
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})" if np.isfinite(self.value) else "-"


@functools.cache
def fitted(study: Study, scenario: str, manipulation: str, strategy: str) -> Fitted:
    """The fits of one scenario, manipulation and strategy, without setups that could not be fitted."""
    runs: dict[tuple[str, int], list[dict[str, str]]] = {}
    for row in fits.tables(study):
        if (row["scenario"], row["manipulation"], row["strategy"]) == (scenario, manipulation, strategy):
            runs.setdefault((row["kernel"], int(row["setup"])), []).append(row)
    lines = []
    for (kind, setup), rows in runs.items():
        if any(row["stop"].startswith("not fitted") for row in rows):
            continue
        numbers = {name: np.array([float(row[name]) for row in rows]) for name in fits.COLUMNS[7:10]}
        relative = (np.median([float(row[name]) / float(row["start_error"]) for row in rows]) for name in ERRORS)
        reached = np.mean([row["stop"] == "reached" for row in rows])
        medians = (np.median(numbers[name]) for name in ("regularity", "improvement_potential", "generations"))
        lines.append((kind, setup, *medians, reached, *relative))
    columns = list(zip(*lines, strict=True)) if lines else [()] * 8
    return Fitted(np.array(columns[0], dtype=np.str_), *(np.array(column, dtype=float) for column in columns[1:]))  # pyright: ignore


def rank(one: Array, other: Array, given: Array | None = None) -> Rank:
    """Spearman's correlation of two scores [q]; the partial correlation if a third score is `given`.

    NaN if one of the two does not vary, or if there are fewer than five setups.
    """
    if len(one) < 5 or still(one) or still(other):
        return Rank(np.nan, np.nan, np.nan, len(one))
    samples = [one, other] if given is None else [one, other, given]
    interval = bootstrap(
        samples, _spearman, paired=True, n_resamples=RESAMPLES, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    value = float(_spearman(one, other, given))
    return Rank(value, float(interval.low), float(interval.high), len(one))


def still(scores: Array) -> bool:
    """Whether scores [q] differ only by rounding, as R does if U is orthogonalized."""
    return bool(np.ptp(scores) <= 1e-9 * np.abs(scores).max())


def _spearman(one: Array, other: Array, given: Array | None = None, axis: int = -1) -> Array:
    """Spearman's correlation of many resamples at once; 0 if one side does not vary."""
    ranks = [rankdata(scores, axis=axis) for scores in (one, other)]
    ranks = [rank - rank.mean(axis=axis, keepdims=True) for rank in ranks]
    if given is not None:
        third = rankdata(given, axis=axis)
        third = third - third.mean(axis=axis, keepdims=True)
        square = (third**2).sum(axis=axis, keepdims=True)
        ranks = [
            rank - third * (rank * third).sum(axis=axis, keepdims=True) / np.where(square > 0, square, 1.0)
            for rank in ranks
        ]
    a, b = ranks
    spread = np.sqrt((a**2).sum(axis=axis) * (b**2).sum(axis=axis))
    return (a * b).sum(axis=axis) / np.where(spread > 1e-9, spread, 1.0)


def pairs(study: Study, scenario: str, one: str, other: str, strategy: str) -> tuple[Fitted, Fitted]:
    """The same setups under two manipulations."""
    a, b = fitted(study, scenario, one, strategy), fitted(study, scenario, other, strategy)
    keys = [list(zip(side.kind.tolist(), side.setup.tolist(), strict=True)) for side in (a, b)]
    common = [key for key in keys[0] if key in set(keys[1])]
    rows = [np.array([side.index(key) for key in common], dtype=int) for side in keys]
    return Fitted(*(column[rows[0]] for column in a)), Fitted(*(column[rows[1]] for column in b))


class Correlations(NamedTuple):
    """Rank correlations over the fits of one scenario, kernel (or all), strategy and manipulation.

    Attributes:
        speed: of R with the generations.
        given: the same, given the least error: a smaller one takes longer to reach, and R and P are in conflict.
        converged: as `given`, over the converged fits only.
        reach: of P with the final error, over the converged fits only; final: over all fits.
        original: of R under indirect manipulation with the generations under this one, given the least error.
        generations: their median; reached: the share of fits that converged.
    """

    scenario: str
    kind: str
    strategy: str
    manipulation: str
    speed: Rank
    given: Rank
    converged: Rank
    reach: Rank
    final: Rank
    original: Rank
    generations: float
    reached: float


class Change(NamedTuple):
    """Generations under one manipulation over those under another: the median ratio, the shares of setups that need
    fewer and more of them, and the number of setups."""

    scenario: str
    kind: str
    strategy: str
    one: str
    other: str
    ratio: float
    fewer: float
    more: float
    setups: int


@functools.cache
def correlations(study: Study) -> tuple[Correlations, ...]:
    """The rank correlations by scenario, strategy, manipulation and kernel; empty if there are no fits."""
    lines = []
    for scenario, strategy, manipulation in itertools.product(SCENARIOS, STRATEGIES, MANIPULATIONS):
        raw, found = pairs(study, scenario, "indirect", manipulation, strategy)
        for kind in (*KINDS, ALL):
            rows, before = found.of(kind), raw.of(kind)
            if len(rows.R) > 0:
                done = rows.reached == 1
                ranks = (
                    rank(rows.R, rows.generations),
                    rank(rows.R, rows.generations, rows.optimum),
                    rank(rows.R[done], rows.generations[done], rows.optimum[done]),
                    rank(rows.P[done], rows.error[done]),
                    rank(rows.P, rows.error),
                    rank(before.R, rows.generations, rows.optimum),
                )
                medians = float(np.median(rows.generations)), float(rows.reached.mean())
                lines.append(Correlations(scenario, kind, strategy, manipulation, *ranks, *medians))
    return tuple(lines)


def changes(study: Study) -> Iterator[Change]:
    """Direct over indirect, and orthogonalized over indirect and over direct, by scenario, strategy and kernel."""
    compared = (("direct", "indirect"), ("orthogonalized", "indirect"), ("orthogonalized", "direct"))
    for scenario, strategy, (one, other) in itertools.product(SCENARIOS, STRATEGIES, compared):
        found = pairs(study, scenario, one, other, strategy)
        for kind in (*KINDS, ALL):
            a, b = (side.of(kind).generations for side in found)
            if len(a):
                ratio = float(np.median(a / np.maximum(b, 1)))
                shares = float((a < b).mean()), float((a > b).mean())
                yield Change(scenario, kind, strategy, one, other, ratio, *shares, len(a))


def write_tables(study: Study) -> None:
    """Write fits.csv: all fits in one table."""
    rows = [[row[name] for name in fits.COLUMNS] for row in fits.tables(study)]
    if rows:
        write_whole(study.out / "fits.csv", csv_text(fits.COLUMNS, rows))
