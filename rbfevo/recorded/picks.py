"""One setup of a run, by name: the knee, the best in one score or for a preference, or simply a row."""

from __future__ import annotations

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.record import Record, knee
from rbfevo.scoring.fronts import preferred

PICKS = (
    *("knee", "best-regularity", "best-improvement-potential"),
    *("potential:SHARE", "index:ROW", "preference:LAMBDA"),
)


def pick(record: Record, choice: str) -> int:
    """The row of `setups.npz` that `choice` names, among the rows with finite scores and centers.

    Args:
        record: the run.
        choice: `knee`; `best-regularity` or `best-improvement-potential`, ties broken by the other score; where bounded
            potential was searched it stands for improvement potential in all of these; `potential:0.95`, the best
            regularity among the rows with at least 0.95 of the best improvement potential;
            `index:12`, that row; `preference:0.3`, the row maximizing 0.3 R + 0.7 P (paper, eq. 9), the lowest of
            equals.

    Raises:
        UserError: if there is no such pick or no such row, naming the valid ones.
    """
    kind, colon, value = choice.strip().partition(":")
    usable = record.usable
    R, P = record.regularity, record.potential
    if usable.size == 0:
        raise UserError("no setup has finite centers and scores")
    if kind == "index" and colon:
        return _row(record, value)
    if kind == "potential" and colon:
        share = _share(value, "potential", "to 1, a share of the best improvement potential")
        return best(usable[P[usable] >= share * P[usable].max()], R, P)
    if kind == "preference" and colon:
        preference = _share(value, "preference", "(improvement potential) to 1 (regularity)")
        return int(usable[np.argmax(preferred(preference, np.column_stack([R, P])[usable]))])
    if not colon and kind == "best-regularity":
        return best(usable, R, P)
    if not colon and kind == "best-improvement-potential":
        return best(usable, P, R)
    if not colon and kind == "knee":
        found = knee(record)
        if found is None or found not in usable:
            raise UserError("pick=knee: this run has no front (no usable setup is nondominated); choose another pick")
        return found
    raise UserError(f"pick={choice}: there is no such pick; choose one of {', '.join(PICKS)}")


def best(rows: Array, first: Array, second: Array) -> int:
    """The one of `rows` that is largest in `first` [p], of those the largest in `second` [p]."""
    return int(rows[np.lexsort((-second[rows], -first[rows]))[0]])


def _row(record: Record, value: str) -> int:
    count = len(record.regularity)
    if not value.isdecimal() or int(value) >= count:
        raise UserError(f"pick=index:{value}: there is no such row; choose one from 0 to {count - 1}")
    if int(value) not in record.usable:
        raise UserError(f"pick=index:{value}: this row has no finite centers and scores; choose another row")
    return int(value)


def _share(value: str, kind: str, ends: str) -> float:
    """A number in [0, 1]; `ends` completes the sentence that refuses others."""
    try:
        share = float(value)
    except ValueError:
        share = -1.0
    if not 0.0 <= share <= 1.0:
        raise UserError(f"pick={kind}:{value}: give a number from 0 {ends}")
    return share
