"""The kinds of setups that a run holds, and how each looks: the colours and marks of the paper."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.figures import style
from rbfevo.recorded.record import Record

HEURISTICS = ("random", "lloyd", "ols", "blend", "given")


class Series(NamedTuple):
    """How the setups of one kind are drawn."""

    label: str
    color: str
    marker: str
    size: float
    order: int
    filled: bool = True
    edge: float = 0.4  # points


def kinds(record: Record) -> dict[tuple[str, bool], list[int]]:
    """Rows with scores by (method, has a preference)."""
    found: dict[tuple[str, bool], list[int]] = {}
    for row in np.flatnonzero(record.scored):
        key = (str(record.method[row]), bool(np.isfinite(record.preference[row])))
        found.setdefault(key, []).append(int(row))
    return found


def series(record: Record, method: str, preferred: bool) -> Series:
    """Colours and marks of the paper; another front keeps the colour and changes the mark."""
    if method == "blend":
        return Series("blend of OLS and Lloyd", style.ORANGE, "^", 44, 5)
    if preferred:
        return Series(f"preferences ({method})", style.MAGENTA, "^", 52, 5)
    if method in ("nsga2", "gradient"):
        second = method == "gradient" and "nsga2" in record.method
        return Series(f"front ({method})", style.BLUE, "o", 24, 4, filled=not second)
    if method == "random":
        searched = bool((record.method != "random").any())
        return Series("initial population" if searched else "random setups", style.GREEN, "o", 20, 3)
    if method == "cmaes":
        return Series("preferences (cmaes)", style.MAGENTA, "^", 52, 5)
    if method == "lloyd":
        return Series("Lloyd", style.ORANGE, "o", 84, 6)
    if method == "ols":
        return Series("OLS", style.ORANGE, "D", 66, 6)
    if method == "given":
        return Series("placed by hand", style.RED, "s", 60, 6)
    return Series(method, style.GREY, "s", 30, 5)
