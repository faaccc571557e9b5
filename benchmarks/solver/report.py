"""The tables of docs/solver.md, from the lines of docs/solver.csv, and what was aimed at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.choosing import markdown
from benchmarks.elsewhere.tables import KNOWN, spearman

Entry = dict[str, Any]
NEW = ("diffuser", "elastic")  # cases on which the criterion was not chosen
CHOSEN = ("duct", "body")
SHARE = 0.9  # of the best reduction that anyone reached


class Descent(NamedTuple):
    """One descent: J of the design that was there, and the best J after 1, 2, ... more adjoint solutions.

    Attributes:
        setup: `advised`, `Lloyd 0`, `FFD 4x2x2` or the shape of a grid; size: `few` or `many`.
        radius: model units, 0 of FFD.
        worst: the largest non-orthogonality, degrees, and skewness of the volume meshes that were solved.
    """

    case: str
    setup: str
    size: str
    centers: int
    radius: float
    rule: str
    first: float
    best: tuple[float, ...]
    worst: tuple[float, float]

    @property
    def family(self) -> str:
        """`advised`, `Lloyd`, `FFD` or `grid`."""
        first = self.setup.partition(" ")[0]
        return first if first in ("advised", "Lloyd", "FFD") else "grid"

    def reduction(self, after: int = 10) -> float:
        """By how many percent the best J lies below the first one after some adjoint solutions."""
        return 100.0 * (1.0 - self.best[min(after, len(self.best)) - 1] / self.first) if self.best else 0.0

    def solutions_to(self, objective: float) -> float:
        """Adjoint solutions, that of the first design not counted, until J is at most this; inf if it never is."""
        return next((float(i) for i, J in enumerate((self.first, *self.best)) if objective >= J), math.inf)


def descents(lines: Sequence[Entry]) -> list[Descent]:
    """The descents of all lines of docs/solver.csv, in the order of the file."""
    found: dict[tuple[str, ...], list[Entry]] = {}
    for line in lines:
        key = tuple(line[name] for name in ("case", "setup", "size", "centers", "radius", "rule"))
        found.setdefault(key, []).append(line)
    made = []
    for (case, name, size, centers, radius, rule), own in found.items():
        own = sorted(own, key=lambda line: int(line["solution"]))
        worst = [max(float(line[key]) for line in own) for key in ("non_orthogonality", "skewness")]
        first, *best = (float(line["best"]) for line in own)
        made.append(
            Descent(case, name, size, int(centers), float(radius), rule, first, tuple(best), (worst[0], worst[1]))
        )
    return made


def of(found: Sequence[Descent], **wanted: Any) -> list[Descent]:
    """Those with the given attributes."""
    return [one for one in found if all(getattr(one, key) == value for key, value in wanted.items())]


def largest(found: Sequence[Descent]) -> Descent | None:
    """The one with the largest reduction, the first of equals; None of none."""
    return max(found, key=Descent.reduction, default=None)


def table(found: Sequence[Descent], case: str) -> str:
    """A line for each setup and rule of a case."""
    own = of(found, case=case)
    aim = min(one.best[-1] for one in own if one.best)
    rows = []
    for one in own:
        target = one.first - SHARE * (one.first - aim)
        needed = one.solutions_to(target)
        shown = "more than 10" if math.isinf(needed) else f"{needed:.0f}"
        after = [f"{one.reduction(n):.2f}" for n in (1, 3, 10)]
        quality = [f"{one.worst[0]:.1f}", f"{one.worst[1]:.2f}"]
        rows.append(
            [one.setup, str(one.centers), f"{one.radius:g}" if one.radius else "", one.rule, *after, shown, *quality]
        )
    head = ("setup", "centers", "radius", "rule", "after 1", "after 3", "after 10 [%]", "solutions to 90 %")
    return markdown((*head, "worst non-orthogonality", "worst skewness"), rows)


class Verdict(NamedTuple):
    """Something that was aimed at on a case, whether it was reached (None: not measured), and the numbers."""

    case: str
    aim: str
    reached: bool | None
    numbers: str


def verdicts(found: Sequence[Descent], case: str) -> list[Verdict]:
    """What was aimed at on one case, from the descents that are there."""
    own = of(found, case=case, rule="max-norm")
    few, many = of(own, size="few"), of(own, size="many")
    made = []
    advised = largest([one for one in few if one.family == "advised" and one.radius == _recommended(own)])
    for family in ("Lloyd", "grid"):
        other, aim = largest([one for one in few if one.family == family]), f"few: above the best of {family}"
        if advised is None or other is None:
            made.append(Verdict(case, aim, None, ""))
            continue
        numbers = f"{advised.reduction():.2f} % against {other.reduction():.2f} % ({other.setup}, r {other.radius:g})"
        made.append(Verdict(case, aim, advised.reduction() > other.reduction(), numbers))
    best, lloyd = largest(many), largest([one for one in few if one.family == "Lloyd"])
    aim = "few: half of the gap from the best Lloyd to the best of 16"
    if advised is None or best is None or lloyd is None:
        made.append(Verdict(case, aim, None, ""))
    else:
        gap = best.reduction() - lloyd.reduction()
        numbers = f"{lloyd.reduction():.2f}, {advised.reduction():.2f}, {best.reduction():.2f} %"
        if gap > 0:
            closed = (advised.reduction() - lloyd.reduction()) / gap
            made.append(Verdict(case, aim, closed >= 0.5, f"{numbers}: {100 * closed:.0f} % of it"))
        else:  # Lloyd's few are ahead of all 16
            reached = advised.reduction() >= best.reduction()
            made.append(Verdict(case, aim, reached, f"{numbers}: there is no gap"))
    ratios = []
    for slow in of(found, case=case, rule="steepest"):
        fast = [one for one in own if one[1:5] == slow[1:5]]
        if fast and slow.best:
            needed = slow.solutions_to(slow.best[-1])
            ratios.append((slow, fast[0].solutions_to(slow.best[-1]), needed))
    aim = "max-norm: at most two thirds of the solutions of steepest descent to its J"
    listed = ", ".join(f"{slow.setup} with {slow.centers}: {_number(a)} against {b:.0f}" for slow, a, b in ratios)
    made.append(Verdict(case, aim, all(a <= 2 * b / 3 for _, a, b in ratios) if ratios else None, listed))
    return made


def _number(solutions: float) -> str:
    return "never" if math.isinf(solutions) else f"{solutions:.0f}"


def _recommended(found: Sequence[Descent]) -> float:
    """The larger of the two radii, which is the recommended one."""
    return max((one.radius for one in found), default=math.nan)


def correlations(found: Sequence[Descent], known: Sequence[Entry], after: Sequence[int] = (1, 4, 10)) -> str:
    """Spearman's correlation of each number known beforehand with the reduction, a line for each case."""
    rows = []
    keys = {(e["case"], e["setup"], e["size"], float(e["radius"])): e for e in known}
    for case in dict.fromkeys(one.case for one in found):
        own = [
            (one, keys.get((one.case, one.setup, one.size, one.radius)))
            for one in of(found, case=case, rule="max-norm")
        ]
        pairs = [(one, entry) for one, entry in own if entry is not None]
        if len(pairs) < 3:
            continue
        for n in after:
            reductions = np.array([one.reduction(n) for one, _ in pairs])
            values = [spearman(np.array([float(e[key]) for _, e in pairs]), reductions) for key in KNOWN]
            rows.append([case, str(len(pairs)), str(n), *(f"{value:.2f}" for value in values)])
    return markdown(("case", "setups", "after", *KNOWN.values()), rows)


def strategies(lines: Sequence[Entry]) -> Verdict:
    """Whether an evolution strategy on the few parameters needs half of the evaluations of the one on 16 to its J.

    To the median over the seeds of the best J with 16 centers; evaluations are medians, too.
    """
    aim, ends = "evolution strategy: at most half of the evaluations of 16 centers to their J", {}
    runs: dict[str, list[list[float]]] = {"few": [], "many": []}
    for size, own in runs.items():
        for seed in sorted({line["seed"] for line in lines if line["size"] == size}):
            own.append([float(line["best"]) for line in lines if (line["size"], line["seed"]) == (size, seed)])
        if not own:
            return Verdict("elastic", aim, None, "")
        ends[size] = float(np.median([one[-1] for one in own]))
    needed = {
        size: float(
            np.median([next((i + 1.0 for i, J in enumerate(one) if ends["many"] >= J), math.inf) for one in own])
        )
        for size, own in runs.items()
    }
    numbers = ", ".join(f"{size}: J {ends[size]:.5g} after {len(own[0])}, {needed[size]:g} to {ends['many']:.5g}"
                        for size, own in runs.items())  # fmt: skip
    return Verdict("elastic", aim, needed["few"] <= needed["many"] / 2, numbers)


def write(found: Sequence[Descent], known: Sequence[Entry], evolved: Sequence[Entry], page: Path) -> None:
    """Write the tables into docs/solver.md, each between its two markers."""
    text = page.read_text(encoding="utf-8")
    cases = list(dict.fromkeys(one.case for one in found))
    judged = [*(verdict for case in cases for verdict in verdicts(found, case)), strategies(evolved)]
    marks = {True: "reached", False: "**missed**", None: "not measured"}
    rows = [[v.case + (" (chosen on)" if v.case in CHOSEN else ""), v.aim, marks[v.reached], v.numbers] for v in judged]
    tables = {"aims": markdown(("case", "aim", "", "reduction after 10, or solutions"), rows)}
    tables |= {f"descents of {case}": table(found, case) for case in cases}
    tables["correlations"] = correlations(found, known)
    for name, content in tables.items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, there, following = text.partition(begin)
        if not there:
            raise SystemExit(f"{page} has no marker {begin}")
        text = f"{before}{begin}\n{content}\n{end}{following.partition(end)[2]}"
    page.write_text(text, encoding="utf-8")
