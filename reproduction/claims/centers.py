"""Claims about where the best centers sit (paper, section 5 and figures 4 and 5)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.panels import Panel
from reproduction import measures
from reproduction.claims.claim import Case, Claim, claim
from reproduction.study import SEARCHES, Array, Setups, Study, panels_of


def best_setup(study: Study, panel: Panel, seed: int, criterion: str) -> tuple[Array, str] | None:
    """Centers [m, d] of the best setup of all searches by `regularity` or `improvement_potential`, and the search."""
    found: list[tuple[float, Array, str]] = []
    for method in SEARCHES:
        setups = study.setups(panel, method, seed)
        if setups is not None:
            row = setups.most_regular if criterion == "regularity" else setups.most_improvable
            found.append((float(getattr(setups, criterion)[row]), setups.centers[row], method))
    if not found:
        return None
    _, centers, method = max(found, key=lambda entry: entry[0])
    return centers, method


def best_setups(study: Study, panels: tuple[Panel, ...], criterion: str) -> Iterator[tuple[Panel, int, Array]]:
    """Panel, seed and centers of the best setup of all searches."""
    for panel in panels:
        for seed in study.budget.seeds:
            found = best_setup(study, panel, seed, criterion)
            if found is not None:
                yield panel, seed, found[0]


def spacing(study: Study, manipulation: str) -> Iterator[tuple[Panel, int, float]]:
    """The separation distance of the most regular centers over that of Lloyd's, which are uniform."""
    for panel, seed, centers in best_setups(study, panels_of(manipulation=manipulation), "regularity"):
        lloyd = study.setups(panel, "lloyd", seed)
        if lloyd is not None:
            yield panel, seed, measures.separation(centers) / measures.separation(lloyd.centers[0])


SPACING = (
    "the separation distance of the most regular centers that any search found (NSGA-II, CMA-ES, gradient), "
    "over that of "
    "Lloyd's uniform ones (the random setups' lies at 0.1 to 0.2)"
)


@claim(
    "regular-indirect-uniform",
    "5.1",
    "Centers of optimal regularity are uniform for indirect manipulation.",
    SPACING,
    ">= 0.8",
    (*SEARCHES, "lloyd"),
    {
        "holds in part": """the triharmonic kernel on the plane spaces them about evenly too, but over its middle alone,
        and so closer together."""
    },
)
def regular_indirect(study: Study) -> Iterator[Case]:
    for panel, seed, value in spacing(study, "indirect"):
        yield Case(panel.name, seed, value, value >= 0.8)


@claim(
    "regular-direct-not-uniform",
    "5.1",
    "Centers of optimal regularity are not uniform for direct manipulation.",
    SPACING,
    "< 0.8",
    (*SEARCHES, "lloyd"),
    {
        "holds in part": """supports of local kernels hardly overlap, so that both manipulations are nearly the same,
        and so are their best centers once the search is good enough to find them."""
    },
)
def regular_direct(study: Study) -> Iterator[Case]:
    for panel, seed, value in spacing(study, "direct"):
        yield Case(panel.name, seed, value, value < 0.8)


def adaptation(study: Study, panel: Panel, centers: Array) -> float:
    """`measures.adaptation` of setups [*pop, m, d] on a panel's scenario."""
    scenario = study.scenario(panel.scenario)
    error = scenario.gradient.norm(dim=1).numpy()
    return measures.adaptation(centers, scenario.vertices.numpy(), error)  # pyright: ignore[reportReturnType]


def percentile(study: Study, panel: Panel, centers: Array, random: Setups) -> float:
    """The share of random setups whose centers are less adapted to the target than `centers` [m, d]."""
    return float(np.mean(adaptation(study, panel, random.centers) < adaptation(study, panel, centers)))


def percentiles(study: Study, panels: tuple[Panel, ...]) -> Iterator[tuple[Panel, int, float]]:
    """Panel, seed, and `percentile` of the setup of best P that any search found."""
    for panel, seed, centers in best_setups(study, panels, "improvement_potential"):
        random = study.setups(panel, "random", seed)
        if random is not None:
            yield panel, seed, percentile(study, panel, centers, random)


ADAPTED = (
    "the share of the panel's random setups that are less adapted to the target, adaptation being the mean "
    "over the centers "
    "of the initial local error (the row norms of g) at the vertex closest to each"
)


@claim(
    "potential-wendland-adapted",
    "5.1",
    "Centers of best improvement potential are denser where the height field moves, for Wendland kernels.",
    f"{ADAPTED}; setups of best P that any search found, plane",
    ">= 0.95",
    (*SEARCHES, "random"),
)
def potential_wendland(study: Study) -> Iterator[Case]:
    for panel, seed, value in percentiles(study, panels_of("plane", "wendland")):
        yield Case(panel.name, seed, value, value >= 0.95)


@claim(
    "potential-triharmonic-elsewhere",
    "5.1",
    "Centers of best improvement potential are not placed there for the triharmonic kernel.",
    f"{ADAPTED}; setups of best P that any search found, plane",
    "<= 0.5, no more than the median random setup",
    (*SEARCHES, "random"),
    {
        "does not hold here": """they are far less adapted than those for the Wendland kernels, and many sit where
        nothing has to move; but most random setups are less adapted still."""
    },
)
def potential_triharmonic(study: Study) -> Iterator[Case]:
    for panel, seed, value in percentiles(study, panels_of("plane", "triharmonic")):
        yield Case(panel.name, seed, value, value <= 0.5)


@claim(
    "potential-sphere",
    "5.2",
    "On the sphere, too, centers of best improvement potential are adapted to the target for Wendland kernels, and not "
    "for the triharmonic one.",
    f"{ADAPTED}; setups of best P that any search found, sphere",
    ">= 0.95 for Wendland, <= 0.5 for triharmonic",
    (*SEARCHES, "random"),
)
def potential_sphere(study: Study) -> Iterator[Case]:
    for panel, seed, value in percentiles(study, panels_of("face")):
        yield Case(panel.name, seed, value, value >= 0.95 if panel.kernel == "wendland" else value <= 0.5)


CLAIMS: tuple[Claim, ...] = (
    regular_indirect,
    regular_direct,
    potential_wendland,
    potential_triharmonic,
    potential_sphere,
)
