"""How many centers: scores over the number of centers, and the number from which another one hardly pays.

The rule is that of `rbfevo.advise`: the smallest number with 95 % of the largest gain, the square root of the potential
that was searched. It is applied to the medians over the seeds of the best potential of each number.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from rbfevo.files import csv_text
from rbfevo.recorded.sweep.comparison import name_of, rivals_of
from rbfevo.recorded.sweep.sequences import NestedSequence, labels_of
from rbfevo.recorded.sweep.tables import Group
from rbfevo.scoring.fronts import ENOUGH, enough_of

BEST = "best_improvement_potential"
SHOWN = (BEST, "knee_improvement_potential", "knee_regularity")
SHARE = f"{ENOUGH:.0%}".replace("%", " %")


class Curve(NamedTuple):
    """Groups that differ in the number of centers alone, by that number; of one mesh and gradient.

    Attributes:
        label: what tells it from the other curves of its mesh; enough: the smallest of its numbers with enough gain,
            None where there is but one number, or no gain.
    """

    mesh: str
    label: str
    groups: tuple[Group, ...]
    enough: int | None

    @property
    def centers(self) -> list[int]:
        """The numbers of centers, rising."""
        return [int(group.settings["centers"]) for group in self.groups]

    @property
    def gains(self) -> list[float]:
        """The square roots of the medians of the best potential."""
        return [math.sqrt(max(group.spreads[BEST].median, 0.0)) for group in self.groups]


def curves(groups: Sequence[Group]) -> list[Curve]:
    """The curves of all meshes on which some settings were tried with several numbers of centers.

    On such a mesh settings with one number alone are curves of one point. Random setups are left out unless there is
    nothing else, and groups without scores in any case.
    """
    found: list[Curve] = []
    for mesh in dict.fromkeys(group.settings["mesh"] for group in groups):
        here = [group for group in groups if group.settings["mesh"] == mesh]
        keys = [key for key in here[0].varying if key != "centers" and len({g.settings[key] for g in here}) > 1]
        gathered: dict[tuple[object, ...], list[Group]] = {}
        for group in rivals_of(here):
            if math.isfinite(group.spreads[BEST].median):
                alike = (*(group.settings[key] for key in keys), group.series)
                gathered.setdefault(alike, []).append(group)
        if any(members[1:] for members in gathered.values()):
            found += [_curve(mesh, keys, members, here) for members in gathered.values()]
    return found


def _curve(mesh: str, keys: Sequence[str], members: Sequence[Group], here: Sequence[Group]) -> Curve:
    ordered = tuple(sorted(members, key=lambda group: group.settings["centers"]))
    label = name_of(ordered[0], keys, here)
    curve = Curve(mesh, str(ordered[0].settings["method"]) if label == "all runs" else label, ordered, None)
    return curve._replace(enough=enough_of(curve.centers, curve.gains)) if ordered[1:] else curve


def table_of_curves(found: Sequence[Curve]) -> bytes:
    """curves.csv: a line for each curve and number of centers, with medians and quartiles over the seeds."""
    settings = found[0].groups[0].settings
    names = ["curve", *settings, "series", "runs", "seeds"]
    names += [f"{key}_{what}" for key in SHOWN for what in ("median", "q1", "q3")]
    rows = []
    for curve in found:
        for group, number, gain in zip(curve.groups, curve.centers, curve.gains, strict=True):
            numbers = [value for key in SHOWN for value in group.spreads[key]]
            share = gain / max(curve.gains) if max(curve.gains) > 0.0 else math.nan
            settled = [curve.label, *group.settings.values(), group.series, len(group.runs), group.seeds]
            rows.append([*settled, *numbers, share, int(number == curve.enough)])
    return csv_text([*names, "share_of_largest_gain", "enough"], rows)


def advice(found: Sequence[Curve], nested: Sequence[NestedSequence]) -> dict[str, list[str]]:
    """For each mesh with curves, plain sentences: where another center stops paying, on each curve and sequence."""
    sentences: dict[str, list[str]] = {}
    for curve in found:
        sentences.setdefault(curve.mesh, []).extend(_sentence(curve))
    labels = labels_of(nested)
    for sequence, label in zip(nested, labels, strict=True):
        most = max((max(curve.centers) for curve in found if curve.mesh == sequence.mesh), default=0)
        sentences.setdefault(sequence.mesh, []).append(_of_sequence(sequence, label, most))
    return sentences


def _sentence(curve: Curve) -> Iterator[str]:
    """Where another center stops paying on a curve, and what the steps before and after bring."""
    if curve.enough is None:
        return
    numbers, gains, potential = curve.centers, curve.gains, curve.groups[0].potential
    at, most, largest = numbers.index(curve.enough), numbers[gains.index(max(gains))], max(gains)
    gain, many = f"the largest gain (the square root of {potential})", _centers(curve.enough)
    if curve.enough == most:
        parts = [f"{many} {'has' if most == 1 else 'have'} {gain}"]
    else:
        parts = [f"{many} reach{'es' * (curve.enough == 1)} {SHARE} of {gain}, that of {most}"]
    if at:
        fewer = numbers[at - 1]
        parts.append(f"{fewer} {'has' if fewer == 1 else 'have'} {math.floor(100.0 * gains[at - 1] / largest)} %")
    elif curve.enough > 1:
        parts.append("no smaller number was tried, and fewer may do")
    if at + 1 == len(numbers):
        parts.append("no larger number was tried, and more may gain more")
    yield f"{curve.label}: {'; '.join([*parts, _steps(curve, [i for i in (at - 1, at) if 0 <= i < len(numbers) - 1])])}"


def _centers(number: int) -> str:
    return f"{number} center{'s' * (number != 1)}"


def _steps(curve: Curve, places: Sequence[int]) -> str:
    """What the steps from some numbers of centers to the next ones bring, beside the scatter of the seeds."""
    parts = []
    for i in places:
        one, other = curve.groups[i : i + 2]
        change = other.spreads[BEST].median - one.spreads[BEST].median
        verb = "grows" if change >= 0.0 else "falls"
        what = f"centers {one.potential} {verb}" if not parts else f"it {verb}"
        scatter = ""
        if min(one.seeds, other.seeds) < 2:
            scatter = " (1 seed)"
        elif _overlap(one.values[BEST], other.values[BEST], change >= 0.0):
            scatter = " (within the scatter of the seeds)"
        parts.append(f"from {curve.centers[i]} to {curve.centers[i + 1]} {what} by {abs(change):.2g}{scatter}")
    return ", ".join(parts)


def _overlap(one: Sequence[float], other: Sequence[float], grows: bool) -> bool:
    """Whether the runs of two groups overlap: not each of those said to be larger is."""
    lower, upper = (one, other) if grows else (other, one)
    return max(filter(math.isfinite, lower)) >= min(filter(math.isfinite, upper))


def _of_sequence(sequence: NestedSequence, label: str, most: int) -> str:
    """Where another center stops paying in a nested sequence: beside the most that were tried, and beside all."""
    gains = [math.sqrt(max(value, 0.0)) for value in sequence.potential]
    numbers = list(range(1, len(gains) + 1))
    ends = dict.fromkeys(end for end in (most, len(gains)) if 1 <= end <= len(gains))
    enough = {end: enough_of(numbers[:end], gains[:end]) for end in ends}
    known = [(number, end) for end, number in enough.items() if number is not None]
    if not known:
        return f"{label}: no center gains anything"
    (number, end), *others = known
    text = f"{label}: {_centers(number)} reach{'es' * (number == 1)} {SHARE} of its gain with {end}"
    text += "".join(f", {other} of that with {last}" for other, last in others)
    return f"{text}; {sequence.note}" if sequence.note else text
