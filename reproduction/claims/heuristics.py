"""Claims about Lloyd sampling and orthogonal least squares (paper, section 7)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.panels import Panel
from reproduction import measures
from reproduction.claims.centers import ADAPTED, best_setup, best_setups, percentile
from reproduction.claims.claim import Case, Claim, claim
from reproduction.study import SEARCHES, Study, panels_of


def lloyd_to_front(study: Study, panels: tuple[Panel, ...]) -> Iterator[tuple[Panel, int, float]]:
    """R of Lloyd's setup over the best R on NSGA-II's front among setups of at least Lloyd's P."""
    for panel, seed, (lloyd, front) in study.each(panels, "lloyd", "nsga2"):
        rival = measures.best_given(front.objectives, lloyd.objectives[0], gained=0)
        yield panel, seed, float(lloyd.regularity[0] / rival) if rival > 0 else np.inf


TO_FRONT = "R of Lloyd's setup over the best R on NSGA-II's front among the setups with at least Lloyd's P"


@claim(
    "lloyd-near-front",
    "7",
    "Lloyd's setup is close to the front for the local Wendland kernels, indirect manipulation.",
    f"{TO_FRONT}; the other kernels stand beside it and do not count",
    ">= 0.9",
    ("lloyd", "nsga2"),
)
def lloyd_near_front(study: Study) -> Iterator[Case]:
    for panel, seed, value in lloyd_to_front(study, panels_of(manipulation="indirect")):
        yield Case(panel.name, seed, value, value >= 0.9, counts=panel in panels_of(kernel="local"))


@claim(
    "lloyd-direct",
    "7",
    "Lloyd's setup has good regularity for direct manipulation too.",
    "R of Lloyd's setup over the best R of NSGA-II's front",
    ">= 0.8",
    ("lloyd", "nsga2"),
)
def lloyd_direct(study: Study) -> Iterator[Case]:
    for panel, seed, (lloyd, front) in study.each(panels_of(manipulation="direct"), "lloyd", "nsga2"):
        value = float(lloyd.regularity[0] / front.regularity.max())
        yield Case(panel.name, seed, value, value >= 0.8)


@claim(
    "lloyd-beats-random",
    "7",
    "Lloyd's setup is more regular than every random one.",
    "R of Lloyd's setup over the best R of the panel's random setups of the same seed",
    "> 1",
    ("lloyd", "random"),
)
def lloyd_beats_random(study: Study) -> Iterator[Case]:
    for panel, seed, (lloyd, random) in study.each(panels_of(), "lloyd", "random"):
        value = float(lloyd.regularity[0] / random.regularity.max())
        yield Case(panel.name, seed, value, value > 1)


@claim(
    "lloyd-beats-optimizers",
    "7",
    "On the sphere, with the triharmonic kernel and direct manipulation, Lloyd's setup is more regular than what both "
    "optimizers find.",
    "R of Lloyd's setup over the best R of NSGA-II's front and of CMA-ES's setups",
    "> 1",
    ("lloyd", "nsga2", "cmaes", "cmaes-full"),
    {
        "holds in part": """it is ahead of both while CMA-ES is short of generations, and no longer when it has the
        paper's."""
    },
)
def lloyd_beats_optimizers(study: Study) -> Iterator[Case]:
    panels = panels_of("face", "triharmonic", "direct")
    for series, suffix in (("cmaes", ""), ("cmaes-full", ", CMA-ES with 1,000 generations")):
        for panel, seed, (lloyd, front, preferred) in study.each(panels, "lloyd", "nsga2", series):
            value = float(lloyd.regularity[0] / max(front.regularity.max(), preferred.regularity.max()))
            yield Case(f"{panel.name}{suffix}", seed, value, value > 1)


@claim(
    "separation-bound",
    "7",
    "For indirect manipulation regularity goes with the separation distance, which bounds the least singular value.",
    "Spearman's correlation of the separation distance and R over the panel's random setups",
    ">= 0.5",
    ("random",),
)
def separation_bound(study: Study) -> Iterator[Case]:
    for panel, seed, (random,) in study.each(panels_of(manipulation="indirect"), "random"):
        distance = np.array([measures.separation(centers) for centers in random.centers])
        value = measures.spearman(distance, random.regularity)
        yield Case(panel.name, seed, value, value >= 0.5)


@claim(
    "lloyd-separation",
    "7",
    "Lloyd sampling has a good separation distance.",
    "Lloyd's separation distance over the largest of the random setups of the same seed",
    "> 1",
    ("lloyd", "random"),
)
def lloyd_separation(study: Study) -> Iterator[Case]:
    for panel, seed, (lloyd, random) in study.each(
        panels_of(kernel="local", manipulation="indirect"), "lloyd", "random"
    ):
        largest = max(measures.separation(centers) for centers in random.centers)
        value = measures.separation(lloyd.centers[0]) / largest
        yield Case(panel.scenario, seed, value, value > 1)


@claim(
    "lloyd-robust",
    "7",
    "Lloyd sampling is robust to local optima.",
    "the lowest R of Lloyd's setups over all seeds, over the highest",
    ">= 0.8",
    ("lloyd",),
)
def lloyd_robust(study: Study) -> Iterator[Case]:
    for panel in panels_of():
        found = [float(study.held(panel, "lloyd", seed).regularity[0]) for seed in study.seeds(panel, "lloyd")]
        if len(found) > 1:
            yield Case(panel.name, None, min(found) / max(found), min(found) / max(found) >= 0.8)


def ols_to_front(study: Study, panels: tuple[Panel, ...]) -> Iterator[Case]:
    """The P that OLS lacks to NSGA-II's front, among setups of at least OLS's R (negative: OLS is beyond the front)."""
    for panel, seed, (ols, front) in study.each(panels, "ols", "nsga2"):
        lost = measures.best_given(front.objectives, ols.objectives[0], gained=1) - float(ols.improvement_potential[0])
        yield Case(panel.name, seed, float(lost), lost <= 0.01)


BEHIND = (
    "the best P on NSGA-II's front among the setups with at least the R of OLS's, less the P of OLS's (-inf where no "
    "setup of the front has that R)"
)


@claim(
    "ols-near-front",
    "7",
    "OLS's setup is on or near the front for the Wendland kernels.",
    BEHIND,
    "<= 0.01",
    ("ols", "nsga2"),
)
def ols_near_front(study: Study) -> Iterator[Case]:
    yield from ols_to_front(study, panels_of(kernel="wendland", manipulation="indirect"))


@claim(
    "ols-near-front-triharmonic",
    "8",
    "OLS's setup is on or near the front in all tests: the triharmonic kernel.",
    BEHIND,
    "<= 0.01",
    ("ols", "nsga2"),
)
def ols_near_front_triharmonic(study: Study) -> Iterator[Case]:
    yield from ols_to_front(study, panels_of(kernel="triharmonic", manipulation="indirect"))


@claim(
    "ols-direct",
    "7",
    "OLS's centers, chosen for indirect manipulation, carry over to direct manipulation.",
    f"P is the same; measured is where they stand under direct manipulation: {BEHIND}",
    "<= 0.01",
    ("ols", "nsga2"),
)
def ols_direct(study: Study) -> Iterator[Case]:
    yield from ols_to_front(study, panels_of(manipulation="direct"))


@claim(
    "ols-like-best-potential",
    "7",
    "For the Wendland kernels OLS's setups on the plane are similar to those of best improvement potential.",
    "the mean distance between OLS's centers and those of best P that any search found, paired so that it is "
    "least, over "
    "the median of the same distance for the random setups in place of OLS's",
    "<= 0.5",
    ("ols", *SEARCHES, "random"),
)
def ols_like_best(study: Study) -> Iterator[Case]:
    for panel in panels_of("plane", "wendland"):
        for seed in study.seeds(panel, "ols", "random"):
            best = best_setup(study, panel, seed, "improvement_potential")
            if best is not None:
                ols, random = study.held(panel, "ols", 0), study.held(panel, "random", seed)
                usual = np.median([measures.matched_distance(centers, best[0]) for centers in random.centers])
                value = measures.matched_distance(ols.centers[0], best[0]) / float(usual)
                yield Case(panel.name, seed, value, value <= 0.5)


@claim(
    "ols-adapted",
    "7",
    "For the Wendland kernels OLS places centers where the local error is high.",
    f"{ADAPTED}; OLS's setup",
    ">= 0.95",
    ("ols", "random"),
)
def ols_adapted(study: Study) -> Iterator[Case]:
    for panel, seed, (ols, random) in study.each(
        panels_of(kernel="wendland", manipulation="indirect"), "ols", "random"
    ):
        value = percentile(study, panel, ols.centers[0], random)
        yield Case(panel.name, seed, value, value >= 0.95)


@claim(
    "ols-unintuitive",
    "7",
    "For the triharmonic kernel OLS places centers unintuitively: not where the local error is high.",
    f"{ADAPTED}; OLS's setup",
    "<= 0.5, no more than the median random setup",
    ("ols", "random"),
    {
        "does not hold here": """they are less adapted than those for the Wendland kernels, and part of them sits beside
        the bump, where nothing has to move; but nearly all random setups are less adapted still."""
    },
)
def ols_unintuitive(study: Study) -> Iterator[Case]:
    panels = panels_of(kernel="triharmonic", manipulation="indirect")
    for panel, seed, (ols, random) in study.each(panels, "ols", "random"):
        value = percentile(study, panel, ols.centers[0], random)
        yield Case(panel.name, seed, value, value <= 0.5)


@claim(
    "uniform-like-lloyd",
    "7",
    "Lloyd's setups are similar to those of best regularity, indirect manipulation.",
    "the mean distance between Lloyd's centers and the most regular ones that any search found, paired so that it is "
    "least, over the median of the same distance for the random setups in place of Lloyd's",
    "<= 0.5",
    ("lloyd", *SEARCHES, "random"),
    {
        "does not hold here": """the most regular centers are evenly spaced as well (see the claim on the separation
        distance), but fill another region: the plane's rim too, its middle alone, or space off the sphere."""
    },
)
def uniform_like_lloyd(study: Study) -> Iterator[Case]:
    for panel, seed, centers in best_setups(study, panels_of(manipulation="indirect"), "regularity"):
        lloyd, random = study.setups(panel, "lloyd", seed), study.setups(panel, "random", seed)
        if lloyd is not None and random is not None:
            usual = np.median([measures.matched_distance(drawn, centers) for drawn in random.centers])
            value = measures.matched_distance(lloyd.centers[0], centers) / float(usual)
            yield Case(panel.name, seed, value, value <= 0.5)


CLAIMS: tuple[Claim, ...] = (
    lloyd_near_front,
    lloyd_direct,
    lloyd_beats_random,
    lloyd_beats_optimizers,
    separation_bound,
    lloyd_separation,
    lloyd_robust,
    uniform_like_lloyd,
    ols_near_front,
    ols_near_front_triharmonic,
    ols_direct,
    ols_like_best,
    ols_adapted,
    ols_unintuitive,
)
