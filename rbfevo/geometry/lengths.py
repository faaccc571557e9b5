"""Lengths that are given in model units, or as a percentage of the box's diagonal."""

from __future__ import annotations

import math

from rbfevo.errors import UserError


def length(key: str, value: float | str, diagonal: float | None) -> float:
    """A length in model units: a positive number, or a percentage of the box's diagonal, such as "30%".

    Raises:
        UserError: naming `key`, for anything else.
    """
    text = str(value).strip()
    number, percent = (text[:-1], True) if text.endswith("%") else (text, False)
    try:
        found = float(number)
    except ValueError:
        found = math.nan
    if not (math.isfinite(found) and found > 0) or isinstance(value, bool) or (percent and diagonal is None):
        raise UserError(
            f"{key}={value}: it must be a positive number, in model units, or a percentage of the box's diagonal, "
            "such as 30%"
        )
    return found / 100.0 * diagonal if percent and diagonal is not None else found
