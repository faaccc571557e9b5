"""Several objectives of a run: what a step follows, what it is predicted to change, and what must not get worse."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.record import OF_EACH, Record

NOTHING = 1e-10  # of the sum of what the vertices change, each by its size: rounding
LEFT = 1e-6  # of the gain without objectives to keep: a smaller one is none


class Change(NamedTuple):
    """The predicted change of an objective to first order, in its unit; None where the size of it is not known.

    Attributes:
        direction: `minimize` or `maximize`; gain: in its direction, positive where it gets better, in another unit;
            0 where that is rounding.
    """

    name: str
    direction: str
    value: float | None
    gain: float

    @property
    def verdict(self) -> str:
        """What it means."""
        return "better" if self.gain > 0.0 else "worse" if self.gain < 0.0 else "unchanged"


def aimed(record: Record, name: str | None) -> Record:
    """The run with the gradient that a step follows: that of one objective, or the weighted sum of all.

    The sum is of the gradients of unit norm, each times its share, and is scaled to unit norm itself.

    Raises:
        UserError: for an objective that there is not, or a sum of 0.
    """
    if name is not None:
        return record.alone(index_of(record, name, "--objective"))
    if record.gradients is None:
        return record
    summed = np.einsum("j,jnc->nc", record.shares, record.gradients)
    norm = float(np.sqrt((record.weights[:, None] * summed**2).sum()))
    if not norm > NOTHING:
        raise UserError(f"the sensitivities of {', '.join(record.objectives)} cancel each other: choose --objective")
    free = dict.fromkeys(("gradients", "gradient_raw", *OF_EACH))
    return dataclasses.replace(record, gradient=summed / norm, **free)


def index_of(record: Record, name: str, option: str) -> int:
    """The number of an objective.

    Raises:
        UserError: if there is none of this name, with those that there are.
    """
    if record.gradients is None:
        raise UserError(f"{option} {name}: this run has one objective; several are those of scenario.sensitivity=[A,B]")
    if name not in record.objectives:
        raise UserError(f"{option} {name}: there is no such objective; choose one of {', '.join(record.objectives)}")
    return record.objectives.index(name)


def uphill(record: Record) -> Array:
    """[n, k] what a displacement of each vertex gains of the only objective of a record, but for its unit.

    By the sensitivity before smoothing.
    """
    raw = record.gradient if record.gradient_raw is None else record.gradient_raw
    return record.weights[:, None] * raw


def gain_of(field: Array, displacement: Array) -> float:
    """field.displacement [n, k], and 0 where that is rounding."""
    value = float((field * displacement).sum())
    return value if abs(value) > NOTHING * float(np.abs(field * displacement).sum()) else 0.0


def changes(record: Record, displacement: Array) -> tuple[Change, ...]:
    """What a displacement [n, k] is predicted to change of each of several objectives; none where there is only one."""
    if record.gradients is None:
        return ()
    found = []
    for name, alone in zip(record.objectives, record.each(), strict=True):
        gain = gain_of(uphill(alone), displacement)
        norm, direction = alone.summary["gradient_norm"], alone.summary["objective"]
        value = None if norm is None else (-1.0 if direction == "minimize" else 1.0) * float(norm) * gain
        found.append(Change(name, str(direction), value, gain))
    return tuple(found)


class Candidate(NamedTuple):
    """Weights [m, k] of a step, its displacement [n, k], and what it gains, comparable between candidates."""

    weights: Array
    displacement: Array
    gain: float


def best_keeping(solve: Callable[[Sequence[int]], Candidate], fields: Sequence[Array]) -> Candidate:
    """The best step under which no one of some objectives gets worse, by branch and bound.

    A step that loses in some of them is not the best one; in the best one at least one of these neither gains nor
    loses, since what is maximized is concave and the steps that lose in none are convex.

    Args:
        solve: numbers of objectives -> the best step under which these neither gain nor lose; the more, the less it
            gains.
        fields: [n, k] what a displacement gains of each.

    Returns:
        A gain of 0 if no step gains anything.
    """
    first = solve(())
    best = Candidate(0.0 * first.weights, 0.0 * first.displacement, 0.0)
    waiting: list[tuple[tuple[int, ...], Candidate]] = [((), first)]
    seen: set[tuple[int, ...]] = {()}
    while waiting:
        still, found = waiting.pop()
        if found.gain <= max(best.gain, LEFT * first.gain):
            continue
        lost = [i for i, field in enumerate(fields) if i not in still and gain_of(field, found.displacement) < 0.0]
        if not lost:
            best = found
            continue
        for more in lost:
            other = tuple(sorted((*still, more)))
            if other not in seen:
                seen.add(other)
                waiting.append((other, solve(other)))
    return best
