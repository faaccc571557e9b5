"""One setup of a run, by name: the knee, the best in one score or for a preference, or simply a row."""

from __future__ import annotations

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.record import Record, knee
from rbfevo.scoring.fronts import preferred

PICKS = ("knee", "best-regularity", "best-improvement-potential", "index:ROW", "preference:LAMBDA")


def pick(record: Record, choice: str) -> int:
    """The row of `setups.npz` that `choice` names, among the rows with finite scores and centers.

    Args:
        record: the run.
        choice: `knee`; `best-regularity` or `best-improvement-potential`, ties broken by the other score; where bounded
            potential was searched it stands for improvement potential in all of these;
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
    if kind == "preference" and colon:
        preference = _preference(value)
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


def _preference(value: str) -> float:
    try:
        preference = float(value)
    except ValueError:
        preference = -1.0
    if not 0.0 <= preference <= 1.0:
        raise UserError(f"pick=preference:{value}: give a number from 0 (improvement potential) to 1 (regularity)")
    return preference
