"""Which settings of a sweep are best for a mesh, in plain sentences.

Runs are compared on the same mesh and gradient only, by the hypervolume of what they found (reference point (0, 0),
R and P both maximized), the best R, the best P and the knee.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbfevo.recorded.sweep.members import typed
from rbfevo.recorded.sweep.tables import ALL, FIRST, PLAIN, QUANTITIES, Group, origins_of

Value = tuple[Any, ...]  # of one or more settings that are compared together
ENOUGH = 5  # seeds: by chance alone all of five lead all of five others in 1 of 252 cases
LEVEL = 1e-9  # two medians closer than this, relatively, are tied


def best(groups: Sequence[Group]) -> list[str]:
    """Plain sentences, mesh by mesh: which group leads, and which value of each setting, all else being the same.

    A run that holds several searches (`panel`) takes part with each of them, any other one with all of its setups.
    Random setups lead nothing unless there is nothing else.
    """
    sentences: list[str] = []
    meshes = list(dict.fromkeys(group.settings["mesh"] for group in groups))
    for mesh in meshes:
        here = [group for group in groups if group.settings["mesh"] == mesh]
        keys = [key for key in here[0].varying if len({group.settings[key] for group in here}) > 1]
        searched = "" if here[0].potential == PLAIN else f"{here[0].potential}, "
        name = f"{here[0].settings['scenario']}, {here[0].vertices} vertices, {searched}mesh {mesh}: "
        start = name if meshes[1:] else ""
        sentences += [start + sentence for sentence in (*_leaders(here, keys), *_comparisons(here, keys))]
    return sentences


def description(settings: dict[str, Any], keys: Iterable[str]) -> str:
    """Settings as text, such as `wendland, support 0.25, direct, method.generations=6`; null is left out."""
    parts = []
    for key in keys:
        value = settings[key]
        if value is None:
            continue
        shown = _shown(settings, key)
        if key == "centers":
            parts.append(f"{shown} centers")
        elif key in ("scenario", "kernel", "manipulation", "method"):
            parts.append(shown)
        else:
            parts.append(f"{key} {shown}" if key in FIRST else f"{key}={shown}")
    return ", ".join(parts)


def _shown(settings: dict[str, Any], key: str) -> str:
    """The value of one setting; a radius that was given as a percentage with that."""
    value, given = settings[key], settings.get("kernel.support")
    shown = f"{value:.4g}" if isinstance(value, float) else typed(value)
    return f"{shown} ({given})" if key == "support" and isinstance(given, str) else shown


def distinguishing(group: Group, keys: Sequence[str], groups: Sequence[Group]) -> list[str]:
    """Those of the keys that describe a group, since they do not follow from the others."""

    def is_free(key: str) -> bool:
        origins = [origin for origin in origins_of(key) if origin in keys]
        alike = [g for g in groups if all(g.settings[origin] == group.settings[origin] for origin in origins)]
        return not origins or len({g.settings[key] for g in alike}) > 1

    return [key for key in keys if is_free(key)]


def _is_random(group: Group) -> bool:
    return group.series == "random" or (group.series == ALL and group.settings["method"] == "random")


def rivals_of(groups: Sequence[Group]) -> list[Group]:
    """The groups that are compared: each search of a run with several, else all rows; random ones if nothing else."""
    searches: dict[tuple[Any, ...], int] = {}
    for group in groups:
        settings = tuple(group.settings.values())
        searches[settings] = searches.get(settings, 0) + (group.series not in (ALL, "random"))
    rivals = [
        group
        for group in groups
        if (
            group.series not in (ALL, "random") if searches[tuple(group.settings.values())] > 1 else group.series == ALL
        )
    ]
    return [group for group in rivals if not _is_random(group)] or rivals


def name_of(group: Group, keys: Sequence[str], groups: Sequence[Group]) -> str:
    """A group among `groups` on the same mesh, by those of the `keys` that tell it from the others, and its series."""
    series = "" if group.series == ALL else group.series
    settings = description(group.settings, distinguishing(group, keys, groups))
    return ", ".join(filter(None, (settings, series))) or "all runs"


def _leaders(groups: Sequence[Group], keys: Sequence[str]) -> Iterator[str]:
    """The group with the best median of each score."""
    rivals = rivals_of(groups)
    for key in QUANTITIES[:3]:
        order = [group for group in rivals if math.isfinite(group.spreads[key].median)]
        order.sort(key=lambda group: -group.spreads[key].median)
        if order:
            first, *others = order
            what = key.removeprefix("best_").replace("improvement_potential", first.potential)
            if others:
                leader = f"best {what}: {name_of(first, keys, groups)}: {_median(first, key)}"
                yield f"{leader}; {_lead(key, order, [name_of(group, keys, groups) for group in others])}"
            else:
                yield f"{'' if what == 'hypervolume' else 'best '}{what}: {_median(first, key)}"


def _median(group: Group, key: str) -> str:
    """The median of a quantity, with its quartiles if there are several seeds."""
    median, lower, upper = group.spreads[key]
    if group.seeds == 1:
        return f"{median:.4g} (1 seed)"
    return f"median {median:.4g} (quartiles {lower:.4g} to {upper:.4g}, {group.seeds} seeds)"


def _lead(key: str, order: Sequence[Group], names: Sequence[str]) -> str:
    """How clear the lead of the first one in `key` is over the others, which have these names."""
    first, second = order[:2]
    medians = [group.spreads[key].median for group in order]
    tied = [name for name, median in zip(names, medians[1:], strict=True) if _ratio(medians[0], median) == 1]
    if tied:
        return f"tied with it: {'; '.join(tied)}"
    ahead = f"next {names[0]} with {medians[1]:.4g}"
    others = {name for name, value in first.settings.items() if value != second.settings[name]}
    if key == "best_improvement_potential" and others == {"manipulation"} and first.series == second.series:
        return f"{ahead}, by chance: P does not depend on the manipulation"
    fewest = min(first.seeds, second.seeds)
    if fewest < ENOUGH:
        return f"{ahead}; {fewest} seed{'s' * (fewest != 1)} cannot prove the lead, {ENOUGH} or more could"
    if min(first.values[key]) > max(second.values[key]):
        return f"{ahead}; the lead is clear: each of its runs is ahead of each of theirs"
    return f"{ahead}; the lead is not clear: their runs overlap"


def _comparisons(groups: Sequence[Group], keys: Sequence[str]) -> Iterator[str]:
    """For each setting that varies, the value with the best median hypervolume while all others are the same."""
    whole = [group for group in groups if group.series == ALL]
    searched = [group for group in whole if not _is_random(group)] or whole
    for key in keys:
        if key in ("scenario", "mesh") or (key == "support" and "kernel" in keys):
            continue  # part of the sentence about the kernel
        along = [other for other in keys if other != key and key in origins_of(other)]
        # Random setups are a baseline for methods; they tell little about kernels and the like.
        yield from _compared(whole if key == "method" else searched, [key, *along], keys)
    parts = [group for group in rivals_of(groups) if group.series != ALL]
    if len({group.series for group in parts}) > 1:
        yield from _compared(parts, [], keys)


def _compared(groups: Sequence[Group], mine: Sequence[str], keys: Sequence[str]) -> Iterator[str]:
    """The sentence about the settings `mine`, the series if there are none: pairs that differ in nothing else."""
    table: dict[Value, dict[tuple[Any, ...], float]] = {}
    names: dict[Value, str] = {}
    fronts: set[Value] = set()  # values with more than one setup a run
    chance: set[Value] = set()
    for group in groups:
        value = tuple(group.settings[key] for key in mine) or (group.series,)
        others = (*(group.settings[key] for key in keys if key not in mine), group.series if mine else "")
        median = group.spreads["hypervolume"].median
        if math.isfinite(median):
            shown = distinguishing(group, mine, groups)
            if shown[1:]:
                names[value] = description(group.settings, shown)
            else:
                names[value] = _shown(group.settings, mine[0]) if mine else group.series
            table.setdefault(value, {})[others] = median
            fronts |= {value} if group.setups > 1 else set()
            chance |= {value} if _is_random(group) else set()
    title = " and ".join(mine) or "series"
    duels = {value: _duels(table, value) for value in table}
    leading = [value for value in table if duels[value] and value not in chance] or [v for v in table if duels[v]]
    if leading:
        winner = max(leading, key=lambda value: _merit(duels[value]))
        clauses = (_clause(duel, names[duel.other]) for duel in sorted(duels[winner], key=lambda duel: duel.factor))
        single = ", ".join(names[value] for value in table if fronts and value not in fronts)
        note = f" ({single}: only one setup per run, which by itself has little hypervolume)" if single else ""
        yield f"{title}, by median hypervolume: {names[winner]} {'; '.join(clauses)}{note}{_edge(winner, mine, table)}"
    elif len(table) > 1 and not any(origin in keys for key in mine for origin in origins_of(key)):
        yield f"{title}: no two groups differ in this alone, so its effect cannot be separated from that of others"


def _edge(winner: Value, mine: Sequence[str], table: dict[Value, Any]) -> str:
    """What to try next where the best radius is the smallest or the largest one that was tried."""
    if "support" not in mine:
        return ""
    place = list(mine).index("support")
    radii = sorted({value[place] for value in table if value[place] is not None})
    if len(radii) < 2 or winner[place] not in (radii[0], radii[-1]):
        return ""
    size = "smallest" if winner[place] == radii[0] else "largest"
    further = "smaller" if size == "smallest" else "larger"
    return f"; that is the {size} radius tried: try a {further} one too"


class _Duel(NamedTuple):
    """One value against another: in how many of the pairs it is ahead and behind, and the median of the ratios."""

    other: Value
    ahead: int
    behind: int
    pairs: int
    factor: float

    @property
    def verdict(self) -> int:
        """1 if it wins most pairs and by the median, -1 if it loses so, else 0."""
        half = self.pairs / 2
        return int(self.ahead > half and self.factor > 1) - int(self.behind > half and self.factor < 1)


def _duels(table: dict[Value, dict[tuple[Any, ...], float]], value: Value) -> list[_Duel]:
    duels = []
    for other in table:
        ratios = [_ratio(mine, table[other][key]) for key, mine in table[value].items() if key in table[other]]
        if other != value and ratios:
            ahead, behind = sum(ratio > 1 for ratio in ratios), sum(ratio < 1 for ratio in ratios)
            duels.append(_Duel(other, ahead, behind, len(ratios), float(np.median(ratios))))
    return duels


def _ratio(a: float, b: float) -> float:
    """a / b of two medians, exactly 1 where they are tied."""
    if math.isclose(a, b, rel_tol=LEVEL, abs_tol=1e-300):
        return 1.0
    return a / b if b > 0 else math.inf


def _merit(duels: Sequence[_Duel]) -> tuple[float, float, float]:
    """What the best value has most of: values that it beats, then pairs in which it is ahead, then its lead there."""
    share = sum(duel.ahead for duel in duels) / sum(duel.pairs for duel in duels)
    return sum(duel.verdict for duel in duels), share, min(duel.factor for duel in duels)


def _clause(duel: _Duel, other: str) -> str:
    """How the best value compares with another one."""
    won = duel.ahead if duel.verdict >= 0 else duel.behind
    count = "in the only pair" if duel.pairs == 1 else f"in {won} of {duel.pairs} pairs"
    ratio = duel.factor if duel.verdict >= 0 or duel.factor == 0 else 1 / duel.factor
    size = f"{ratio:.3g}" if ratio < 1000 else f"{ratio:,.0f}"
    factor = f"{'a' if duel.pairs == 1 else 'a median'} factor of {size}"
    if duel.verdict == 0:
        return f"is not clearly ahead of {other} (ahead {count}, {factor})" if won else f"is tied with {other}"
    verb = "beats" if duel.verdict > 0 else "loses to"
    return f"{verb} {other} {count}, " + (f"by {factor}" if 0 < duel.factor < math.inf else "where one value is 0")
