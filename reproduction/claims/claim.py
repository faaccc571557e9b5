"""A claim of the paper, the cases that it is measured on, and the verdict that one rule derives from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from reproduction.markdown import prose
from reproduction.study import Study

HOLDS, IN_PART, FAILS, UNTESTED = "holds", "holds in part", "does not hold here", "cannot be tested"
PLURAL = {HOLDS: "hold", IN_PART: "hold in part", FAILS: "do not hold here", UNTESTED: "cannot be tested"}
MOST, FEW = 0.9, 1 / 3  # shares of the places: from MOST on a claim holds, below FEW it does not


class Case(NamedTuple):
    """One value: its place (a panel or a label), its seed (None for all together), and whether it is as claimed.

    `counts` is False for values that are only listed for comparison.
    """

    where: str
    seed: int | None
    value: float
    fulfilled: bool
    counts: bool = True


class Finding(NamedTuple):
    """The result for a claim: cases, verdict, the reason in one sentence, and how many of all places meet it."""

    cases: tuple[Case, ...]
    verdict: str
    why: str
    good: int
    places: int


@dataclasses.dataclass(frozen=True)
class Claim:
    """One testable statement of the paper.

    Attributes:
        key: a short name, unique, for the command line and the tables.
        section: of the paper.
        statement: what is claimed, paraphrased.
        quantity: what is measured, with its definition.
        criterion: which values count as fulfilled.
        methods: the runs that it is measured on.
        measure: study -> cases; none if all results that it needs are missing.
        because: explanations by the verdict that they explain.
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
        """Measure the claim."""
        cases = tuple(self.measure(study))
        places = votes(cases)
        if not places:
            return Finding(cases, UNTESTED, f"There are no runs of {', '.join(self.methods)} to measure it on.", 0, 0)
        good = sum(places.values())
        share = good / len(places)
        verdict = HOLDS if share >= MOST else IN_PART if share >= FEW else FAILS
        missed = [where for where, fulfilled in places.items() if not fulfilled]
        but = f" (not {listed(missed)})" if good and missed else ""
        why = f"Met in {good} of {len(places)} places{but}"
        reason = self.because.get(verdict)
        return Finding(cases, verdict, f"{why}: {prose(reason)}" if reason else f"{why}.", good, len(places))


def votes(cases: Iterable[Case]) -> dict[str, bool]:
    """Whether most seeds of each place meet the criterion: every place has one vote, whatever its number of seeds."""
    seeds: dict[str, list[bool]] = {}
    for case in cases:
        if case.counts:
            seeds.setdefault(case.where, []).append(case.fulfilled)
    return {where: sum(met) > len(met) / 2 for where, met in seeds.items()}


def listed(places: list[str]) -> str:
    """Up to six places, and the number of the others."""
    return "; ".join(places[:6]) + (f"; and {len(places) - 6} more" if len(places) > 6 else "")


def claim(
    key: str,
    section: str,
    statement: str,
    quantity: str,
    criterion: str,
    methods: tuple[str, ...],
    because: Mapping[str, str] | None = None,
) -> Callable[[Callable[[Study], Iterable[Case]]], Claim]:
    """Make a claim of the function that measures it; `statement` and `quantity` serve as that function's docstring."""

    def decorate(measure: Callable[[Study], Iterable[Case]]) -> Claim:
        """The claim measured by a function."""
        return Claim(key, section, statement, prose(quantity), criterion, methods, measure, because or {})

    return decorate
