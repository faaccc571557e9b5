"""A claim of the paper, the cases that it is measured on, and the verdict that follows from them by one rule."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from reproduction.markdown import prose
from reproduction.study import Study

HOLDS, IN_PART, FAILS, UNTESTED = "holds", "holds in part", "does not hold here", "cannot be tested"
PLURAL = {HOLDS: "hold", IN_PART: "hold in part", FAILS: "do not hold here", UNTESTED: "cannot be tested"}
MOST, FEW = 0.9, 1 / 3  # shares of the cases: from MOST on a claim holds, below FEW it does not


class Case(NamedTuple):
    """One value: where (a panel, or words), with which seed (None for all together), and whether it is as claimed."""

    where: str
    seed: int | None
    value: float
    fulfilled: bool


class Finding(NamedTuple):
    """What came out for a claim: its cases, the verdict, and why in one sentence."""

    cases: tuple[Case, ...]
    verdict: str
    why: str


@dataclasses.dataclass(frozen=True)
class Claim:
    """One testable statement of the paper.

    Attributes:
        key: a short name, unique, for the command line and the tables.
        section: of the paper.
        statement: what is claimed, in our words.
        quantity: what is measured, with its definition.
        criterion: which values count as fulfilled.
        methods: the runs that it is measured on.
        measure: study -> cases; none if nothing that it needs is there.
        because: for a verdict that was seen, why it is so.
    """

    key: str
    section: str
    statement: str
    quantity: str
    criterion: str
    methods: tuple[str, ...]
    measure: Callable[[Study], Iterable[Case]]
    because: Mapping[str, str]

    def find(self, study: Study) -> Finding:
        """Measure it."""
        cases = tuple(self.measure(study))
        if not cases:
            return Finding((), UNTESTED, f"There are no runs of {', '.join(self.methods)} to measure it on.")
        good = sum(case.fulfilled for case in cases)
        share = good / len(cases)
        verdict = HOLDS if share >= MOST else IN_PART if share >= FEW else FAILS
        why = f"Fulfilled in {good} of {len(cases)} cases{missed(cases) if good else ''}"
        reason = self.because.get(verdict)
        return Finding(cases, verdict, f"{why}: {prose(reason)}" if reason else f"{why}.")


def missed(cases: tuple[Case, ...]) -> str:
    """Where a claim is not fulfilled, in words; empty if it is everywhere."""
    places = list(dict.fromkeys(case.where for case in cases if not case.fulfilled))
    if not places:
        return ""
    shown = ", ".join(places[:6]) + (f" and {len(places) - 6} more" if len(places) > 6 else "")
    return f" (not on {shown})"


def claim(
    key: str,
    section: str,
    statement: str,
    quantity: str,
    criterion: str,
    methods: tuple[str, ...],
    because: Mapping[str, str] | None = None,
) -> Callable[[Callable[[Study], Iterable[Case]]], Claim]:
    """Make a claim of the function that measures it."""

    def made(measure: Callable[[Study], Iterable[Case]]) -> Claim:
        return Claim(key, section, statement, prose(quantity), criterion, methods, measure, because or {})

    return made
