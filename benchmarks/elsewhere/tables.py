"""The tables of docs/elsewhere.md, from the lines of docs/elsewhere.csv."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import rankdata

from benchmarks.choosing import markdown
from rbfevo.arrays import Array
from rbfevo.recorded.moves import RULES

Entry = dict[str, Any]

KNOWN = {"R": "R", "P_raw": "P raw", "P_smooth": "P smoothed", "P16_raw": "P_16 raw", "P16_smooth": "P_16 smoothed"}
SEARCHED = ("OLS", "P raw", "P knee", "P best", "P_16")  # beginnings of the names of setups that look at g
SAMPLES = 200  # of the bootstrap
COLUMNS = {
    "Lloyd": ("Lloyd 0", "Lloyd 1", "Lloyd 2"),
    "Lloyd on surface": ("Lloyd 0 on surface", "Lloyd 1 on surface"),
    "grid": ("grid",),
    "random": ("random 0", "random 1", "random 2"),
    "OLS": ("OLS",),
    "P raw, knee": ("P raw knee",),
    "P raw, best": ("P raw best",),
    "P, knee": ("P knee",),
    "P, best": ("P best",),
    "P_16 raw, knee": ("P_16 raw knee",),
    "P_16 raw, best": ("P_16 raw best",),
    "P_16, knee": ("P_16 knee",),
    "P_16, best": ("P_16 best",),
}


def spearman(a: Array, b: Array) -> float:
    """Spearman's rank correlation of two samples, without pairs with NaN; NaN of fewer than three, or of a constant."""
    sound = np.isfinite(a) & np.isfinite(b)
    a, b = a[sound], b[sound]
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def numbers(entries: Sequence[Entry], key: str) -> Array:
    """One column; NaN where there is no number."""
    return np.array([float(entry[key] or "nan") for entry in entries])


def series(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    """The lines of each case and reach, without setups that are the same as another of their group."""
    found: dict[str, list[Entry]] = {}
    seen = set()
    for entry in entries:
        same = tuple(entry[key] for key in ("case", "reach", "centers", "radius", "R", "P_raw", "P16_raw"))
        if same not in seen:
            seen.add(same)
            name = entry["case"] + ("" if entry["reach"] == "r/4" else f", {entry['reach']}")
            found.setdefault(name, []).append(entry)
    return found


def groups(entries: Sequence[Entry]) -> list[list[Entry]]:
    """The lines of each number of centers and radius."""
    found: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries:
        found.setdefault((entry["centers"], entry["radius"]), []).append(entry)
    return list(found.values())


def overall(entries: Sequence[Entry], known: str, result: str) -> float:
    """The correlation over all setups."""
    return spearman(numbers(entries, known), numbers(entries, result))


def within(entries: Sequence[Entry], known: str, result: str) -> float:
    """The mean of the correlations among setups with the same number of centers and the same radius."""
    found = [overall(group, known, result) for group in groups(entries)]
    return float(np.mean([value for value in found if np.isfinite(value)] or [np.nan]))


def blind(entries: Sequence[Entry], known: str, result: str) -> float:
    """`within` among the setups that do not look at the wanted displacement."""
    return within([entry for entry in entries if not entry["setup"].startswith(SEARCHED)], known, result)


def interval(entries: Sequence[Entry], result: str, generator: np.random.Generator) -> tuple[float, float]:
    """The 5 and 95 % points of how much better P_16 smoothed correlates than P smoothed, within, by bootstrap."""
    parts, found = groups(entries), []
    for _ in range(SAMPLES):
        drawn = [group[i] for group in parts for i in generator.integers(len(group), size=len(group))]
        found.append(within(drawn, "P16_smooth", result) - within(drawn, "P_smooth", result))
    low, high = np.nanpercentile(found, [5, 95])
    return float(low), float(high)


def correlations(entries: Sequence[Entry], kind: Callable[[Sequence[Entry], str, str], float], after: int) -> str:
    """A line for each case and rule: the correlation of each known number with the reduction."""
    rows = []
    for rule in RULES:
        for name, own in series(entries).items():
            values = [kind(own, known, f"{rule}_after_{after}") for known in KNOWN]
            rows.append([rule, name, *_bold_largest(values)])
    return markdown(("rule", "case", *KNOWN.values()), rows)


def _bold_largest(values: Sequence[float]) -> list[str]:
    top = max((value for value in values if np.isfinite(value)), default=np.nan)
    return [f"**{value:.2f}**" if f"{value:.2f}" == f"{top:.2f}" else f"{value:.2f}" for value in values]


def iterations(entries: Sequence[Entry]) -> str:
    """For max-norm steps the correlations within after 1, 4 and 10 iterations, and how sure the difference is."""
    rows, generator = [], np.random.default_rng(0)
    for name, own in series(entries).items():
        cells = [
            " / ".join(f"{within(own, known, f'max-norm_after_{after}'):.2f}" for after in (1, 4, 10))
            for known in KNOWN
        ]
        low, high = interval(own, "max-norm_after_4", generator)
        rows.append([name, *cells, f"{low:+.2f} to {high:+.2f}"])
    return markdown(("case", *KNOWN.values(), "P_16 minus P, smoothed, after 4: 5 to 95 %"), rows)


def steps(entries: Sequence[Entry]) -> str:
    """The real over the predicted first gain, and how the rules compare."""
    rows = []
    for name, own in series(entries).items():
        ratios = []
        for rule in RULES:
            low, middle, high = np.nanpercentile(numbers(own, f"{rule}_ratio"), [5, 50, 95])
            ratios.append(f"{middle:.2f} ({low:.2f} to {high:.2f})")
        best, natural, steepest = (numbers(own, f"{rule}_after_4") for rule in RULES)
        sound = np.isfinite(best) & np.isfinite(natural) & np.isfinite(steepest)
        ahead = [f"{(best > other)[sound].sum()} of {sound.sum()}" for other in (steepest, natural)]
        rows.append([name, str(len(own)), *ratios, *ahead])
    head = [f"real / predicted, {rule}" for rule in RULES]
    return markdown(("case", "setups", *head, "max-norm ahead of steepest after 4", "of natural"), rows)


def families(entries: Sequence[Entry], result: str) -> str:
    """For each case and number of centers the median reduction of each family at its better radius."""
    rows = []
    for name, own in series(entries).items():
        for count in dict.fromkeys(entry["centers"] for entry in own):
            cells = []
            for setups in COLUMNS.values():
                middles = []
                for radius in dict.fromkeys(entry["radius"] for entry in own):
                    chosen = [e for e in own if (e["centers"], e["radius"]) == (count, radius) and e["setup"] in setups]
                    if chosen and np.isfinite(numbers(chosen, result)).any():
                        middles.append(float(np.nanmedian(numbers(chosen, result))))
                cells.append(max(middles, default=np.nan))
            if np.isfinite(cells).any():
                top = np.nanmax(cells)
                shown = ["" if np.isnan(cell) else f"{cell:.3g}" for cell in cells]
                shown = [f"**{cell}**" if cell == f"{top:.3g}" else cell for cell in shown]
                rows.append([name, count, *shown])
    return markdown(("case", "centers", *COLUMNS), rows)


def margins(entries: Sequence[Entry]) -> str:
    """By how much the best setup of searches for P_16 gains more by max-norm steps than that of searches for P.

    One number for each number of centers and radius, in per cent; and in how many fronts the best potential is ahead of
    the knee, by max-norm and by steepest steps.
    """
    rows = []
    for name, own in series(entries).items():
        cells = []
        for after in (4, 10):
            key, found = f"max-norm_after_{after}", []
            for group in groups(own):
                bounded, mean = (
                    max((float(entry[key]) for entry in group if entry["setup"].startswith(names)), default=np.nan)
                    for names in (("P_16",), ("P raw", "P knee", "P best"))
                )
                found.append(f"{100.0 * (bounded / mean - 1.0):+.0f}")
            cells.append(" / ".join(found))
        for rule in ("max-norm", "steepest"):
            pairs = []
            for group in groups(own):
                gains = {entry["setup"]: float(entry[f"{rule}_after_10"]) for entry in group}
                pairs += [(gains[f"{of} best"], gains[f"{of} knee"]) for of in ("P", "P_16") if f"{of} best" in gains]
            cells.append(f"{sum(best > knee for best, knee in pairs)} of {len(pairs)}")
        rows.append([name, *cells])
    head = ("after 4 [%]", "after 10 [%]", "best ahead of knee, max-norm", "best ahead of knee, steepest")
    return markdown(("case", *head), rows)


def exact(entries: Sequence[Entry]) -> str:
    """The correlations with the reduction by the least-squares solution, over all and within."""
    rows = []
    for name, own in series(entries).items():
        if np.isfinite(numbers(own, "least_squares")).any():
            rows.append([name, "all", *_bold_largest([overall(own, known, "least_squares") for known in KNOWN])])
            rows.append([name, "within", *_bold_largest([within(own, known, "least_squares") for known in KNOWN])])
    return markdown(("case", "setups", *KNOWN.values()), rows)


def tables(entries: Sequence[Entry]) -> dict[str, str]:
    """All tables by name."""
    near = [entry for entry in entries if entry["reach"] == "r/4"]
    fits = [entry for entry in entries if entry["least_squares"]]
    return {
        "all": correlations(entries, overall, 4),
        "within": correlations(entries, within, 4),
        "blind": correlations(entries, blind, 4),
        "iterations": iterations(entries),
        "fits": correlations(fits, within, 10),
        "exact": exact(near),
        "exact families": families(near, "least_squares"),
        "steps": steps(entries),
        "margins": margins([entry for entry in entries if entry["setup"].startswith(SEARCHED)]),
        "families": families(entries, "max-norm_after_4"),
        "families after 10": families(entries, "max-norm_after_10"),
    }


def fill(text: str, entries: Sequence[Entry]) -> str:
    """A page with the tables between their markers; a table without markers is left out."""
    for name, table in tables(entries).items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, found, following = text.partition(begin)
        if found:
            text = f"{before}{begin}\n{table}\n{end}{following.partition(end)[2]}"
    return text
