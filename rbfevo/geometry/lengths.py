"""Numbers and percentages as they are typed, and lengths given as either: model units, or of the box's diagonal."""

from __future__ import annotations

import math

from rbfevo.errors import UserError


def number_or_percentage(value: float | str) -> tuple[float, bool]:
    """A number, and whether it is a percentage, such as "30%" (30, True); NaN for anything else."""
    text = str(value).strip()
    number, percent = (text[:-1], True) if text.endswith("%") else (text, False)
    try:
        return float(number), percent
    except ValueError:
        return math.nan, percent


def length(key: str, value: float | str, diagonal: float | None) -> float:
    """A length in model units: a positive number, or a percentage of the box's diagonal, such as "30%".

    Raises:
        UserError: naming `key`, for anything else.
    """
    found, percent = number_or_percentage(value)
    if not (math.isfinite(found) and found > 0) or isinstance(value, bool) or (percent and diagonal is None):
        raise UserError(
            f"{key}={value}: give a positive number in model units, or a percentage of the box's diagonal such as 30%"
        )
    return found / 100.0 * diagonal if percent and diagonal is not None else found
