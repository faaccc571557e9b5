"""Claims about time (paper, sections 5 to 8)."""

from __future__ import annotations

from collections.abc import Iterator

from reproduction.claims.claim import Case, Claim, claim
from reproduction.study import Study, panels_of

FRONT, PREFERENCE = 2_500_000, 100_000  # the paper's evaluations
HOUR = 3600.0


def seconds(study: Study, method: str) -> Iterator[tuple[str, int, float, int]]:
    """Panel, seed, search seconds and evaluations of a method's runs."""
    for panel in panels_of():
        for seed in study.seeds(panel, method):
            summary = study.summary(panel, method, seed)
            if summary is not None and (method != "ols" or seed == study.budget.seeds[0]):
                yield panel.name, seed, float(summary["seconds"]), int(summary["evaluations"])


@claim(
    "heuristics-minute",
    "7",
    "Each heuristic takes about a minute.",
    "seconds of Lloyd and of OLS, pictures and the scores by definition apart",
    "<= 60",
    ("lloyd", "ols"),
    {"holds": "both take seconds here."},
)
def heuristics_minute(study: Study) -> Iterator[Case]:
    for method in ("lloyd", "ols"):
        for where, seed, took, _ in seconds(study, method):
            yield Case(f"{where} {method}", seed, took, took <= 60)


@claim(
    "front-days",
    "5.2",
    "The whole front takes up to two days.",
    f"hours of processor for {FRONT:,} evaluations of NSGA-II, scaled from the evaluations that were made",
    ">= 24",
    ("nsga2",),
    {"does not hold here": "an evaluation takes a thousandth of a second here, 70 thousandths in the paper."},
)
def front_days(study: Study) -> Iterator[Case]:
    for panel in panels_of():
        for seed in study.seeds(panel, "nsga2"):
            took = study.front_seconds(panel, seed)
            if took is not None:
                hours = took * FRONT / study.budget.evaluations / HOUR
                yield Case(panel.name, seed, hours, hours >= 24)


@claim(
    "preference-hours",
    "6",
    "One preference takes about two hours.",
    f"hours for {PREFERENCE:,} evaluations of CMA-ES, scaled from the evaluations that were made",
    ">= 1",
    ("cmaes",),
    {"does not hold here": "an evaluation takes a thousandth of a second here, 70 thousandths in the paper."},
)
def preference_hours(study: Study) -> Iterator[Case]:
    for where, seed, took, evaluations in seconds(study, "cmaes"):
        hours = took * PREFERENCE / evaluations / HOUR
        yield Case(where, seed, hours, hours >= 1)


@claim(
    "order-of-times",
    "8",
    "A heuristic is far faster than a search for one preference, and that is far faster than a front.",
    "the lesser of two ratios: time of one preference over the slower heuristic, and time of a front over one "
    "preference, "
    "at the paper's evaluations (the paper: 120 and 24)",
    ">= 5",
    ("lloyd", "ols", "cmaes", "nsga2"),
)
def order_of_times(study: Study) -> Iterator[Case]:
    taken = {
        method: {(where, seed): (t, n) for where, seed, t, n in seconds(study, method)}
        for method in ("lloyd", "cmaes", "ols")
    }
    for panel in panels_of():
        for seed in study.seeds(panel, "nsga2", "cmaes", "lloyd", "ols"):
            front = study.front_seconds(panel, seed)
            slower = max(taken["lloyd"][panel.name, seed][0], taken["ols"][panel.name, study.budget.seeds[0]][0])
            took, evaluations = taken["cmaes"][panel.name, seed]
            preference = took * PREFERENCE / evaluations
            if front is not None:
                ratio = min(preference / slower, front * FRONT / study.budget.evaluations / preference)
                yield Case(panel.name, seed, ratio, ratio >= 5)


CLAIMS: tuple[Claim, ...] = (heuristics_minute, front_days, preference_hours, order_of_times)
