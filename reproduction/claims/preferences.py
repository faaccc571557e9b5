"""Claims about one preference at a time (paper, section 6)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.panels import Panel
from reproduction import measures
from reproduction.claims.claim import Case, Claim, claim
from reproduction.runs import GENERATIONS
from reproduction.study import Array, Study, panels_of

NEAR = 0.05  # of the range of f on the front


def is_exception(panel: Panel) -> bool:
    """Whether the paper excepts the panel: triharmonic kernel on the sphere."""
    return panel.scenario == "face" and panel.kernel == "triharmonic"


def full(study: Study) -> str:
    """The series of CMA-ES with the paper's generations."""
    return "cmaes" if study.budget.generations >= GENERATIONS else "cmaes-full"


def gains(study: Study, series: str, rival: str = "nsga2") -> Iterator[tuple[Panel, int, Array]]:
    """The f of eq. 9 that CMA-ES reaches for each preference, less the best f on the rival's front, over the range of f
    on that front."""
    for panel, seed, (found, front) in study.each(panels_of(), series, rival):
        preference = found.preference
        reached = preference * found.regularity + (1 - preference) * found.improvement_potential
        best = measures.preferred(front.front.objectives, preference)
        worst = -measures.preferred(-front.front.objectives, preference)
        yield panel, seed, (reached - best) / (best - worst)


@claim(
    "uneven",
    "6",
    "Equal steps of the preference do not give equal steps on the front.",
    "the largest distance between the setups of neighbouring preferences (CMA-ES), over the mean distance, in "
    "units of the "
    "extent of NSGA-II's front in R and in P",
    ">= 2",
    ("cmaes", "nsga2"),
)
def uneven(study: Study) -> Iterator[Case]:
    for panel, seed, (preferred, front) in study.each(panels_of(), "cmaes", "nsga2"):
        order = preferred.preference.argsort()
        points = measures.scaled(preferred.objectives[order], front.front.objectives)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        value = float(steps.max() / steps.mean())
        yield Case(panel.name, seed, value, value >= 2)


WORST = """the worst preference: f of CMA-ES's setup less the best f on NSGA-II's front, over the range of f on that
    front, f = preference R + (1 - preference) P"""
THREE = ", preferences 0, 0.5 and 1, five panels (all of both on the budget `paper`)"
BEYOND = "the share of the preferences with a better f than any setup on NSGA-II's front"


@claim(
    "reaches",
    "6",
    "One preference at a time reaches the front (all panels but triharmonic on the sphere).",
    f"{WORST}; CMA-ES with the paper's 1,000 generations{THREE}",
    f">= -{NEAR}",
    ("cmaes-full", "nsga2"),
)
def reaches(study: Study) -> Iterator[Case]:
    yield from shortfalls(study, full(study), exception=False)


@claim(
    "reaches-on-budget",
    "6",
    "One preference at a time reaches the front with the generations of this budget (ours, not the paper's).",
    WORST,
    f">= -{NEAR}",
    ("cmaes", "nsga2"),
    {"does not hold here": "so few generations do not suffice."},
)
def reaches_on_budget(study: Study) -> Iterator[Case]:
    yield from shortfalls(study, "cmaes", exception=False)


def shortfalls(study: Study, series: str, exception: bool) -> Iterator[Case]:
    """The worst preference of each panel; on the paper's exception the claim is that it falls short."""
    for panel, seed, gain in gains(study, series):
        if is_exception(panel) == exception:
            worst = float(gain.min())
            yield Case(panel.name, seed, worst, worst < -NEAR if exception else worst >= -NEAR)


@claim(
    "passes",
    "6",
    "One preference at a time even gets slightly beyond the front (all panels but triharmonic on the sphere).",
    f"{BEYOND}; CMA-ES with the paper's 1,000 generations{THREE}",
    "> 0.5",
    ("cmaes-full", "nsga2"),
)
def passes(study: Study) -> Iterator[Case]:
    yield from beyond(study, full(study))


@claim(
    "passes-on-budget",
    "6",
    "One preference at a time gets beyond the front with the generations of this budget (ours, not the paper's).",
    BEYOND,
    "> 0.5",
    ("cmaes", "nsga2"),
    {"does not hold here": "so few generations do not suffice."},
)
def passes_on_budget(study: Study) -> Iterator[Case]:
    yield from beyond(study, "cmaes")


def beyond(study: Study, series: str) -> Iterator[Case]:
    """The share of preferences that get beyond the front, the paper's exception left out."""
    for panel, seed, gain in gains(study, series):
        if not is_exception(panel):
            share = float((gain > 0).mean())
            yield Case(panel.name, seed, share, share > 0.5)


@claim(
    "stuck",
    "6",
    "On the sphere with the triharmonic kernel one preference at a time does not reach the front.",
    f"{WORST}; CMA-ES with the paper's 1,000 generations{THREE}",
    f"< -{NEAR}",
    ("cmaes-full", "nsga2"),
    {
        "does not hold here": """with that many generations it gets beyond NSGA-II's front; with a tenth of them it
        stays behind, which looks like figure 6 of the paper."""
    },
)
def stuck(study: Study) -> Iterator[Case]:
    yield from shortfalls(study, full(study), exception=True)


@claim(
    "local-optima",
    "6",
    "A search for one preference can be caught in a local optimum.",
    """the worst preference: f of CMA-ES's setup, with the paper's 1,000 generations, less the best f on the front of
    the gradient search with the same seed, over the range of f on that front; a local optimum and too few
    generations are not distinguished""",
    f"< -{NEAR}",
    ("cmaes-full", "gradient"),
)
def local_optima(study: Study) -> Iterator[Case]:
    for panel, seed, gain in gains(study, full(study), "gradient"):
        yield Case(panel.name, seed, float(gain.min()), float(gain.min()) < -NEAR)


CLAIMS: tuple[Claim, ...] = (
    uneven,
    reaches,
    reaches_on_budget,
    passes,
    passes_on_budget,
    stuck,
    local_optima,
)
