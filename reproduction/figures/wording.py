"""Captions of the figures, and the names of panels, methods and setups; does not import matplotlib."""

from __future__ import annotations

import math
from collections.abc import Iterable

from benchmarks.panels import PANELS, Panel
from rbfevo.scoring.deformation import MANIPULATIONS
from reproduction.figures import exhibits
from reproduction.figures.exhibits import Exhibit
from reproduction.markdown import prose
from reproduction.study import KINDS, SEARCHES, Study, panels_of

FIGURES = (
    "figure1",
    "figure2",
    "figure3",
    "figure4",
    "figure4-face",
    "figure5",
    "figure5-face",
    "figure6",
    "figure7",
    "figure7-face",
    "fits",
)
METHODS = {
    "random": "initial population",
    "nsga2": "NSGA-II",
    "gradient": "gradient search",
    "cmaes": "CMA-ES",
    "cmaes-full": "CMA-ES of 1,000 generations",
    "lloyd": "Lloyd",
    "ols": "OLS",
}
SCENARIOS = {"plane": "the plane", "face": "the sphere that is to become a face"}


def captions(study: Study) -> dict[str, str]:
    """The caption of every figure by file name: content, missing series, seeds, budget, and the command."""
    texts = {
        "figure1": _deformation(study),
        "figure2": "The paper's figure 2 made again: a uniform setup of 5 × 5 centers on the initial plane (left), and "
        "the test function that the plane is to fit, that of Giannelli et al. 2012 (right).",
        "figure3": _fronts(study, 3, "plane"),
        "figure6": _fronts(study, 6, "face"),
        "fits": _fits(study),
    }
    for scenario, ending in (("plane", ""), ("face", "-face")):
        texts[f"figure4{ending}"] = _regular(study, scenario)
        texts[f"figure5{ending}"] = _improvable(study, scenario)
        texts[f"figure7{ending}"] = _greedy(study, f"figure7{ending}", scenario)
    made = f"Made by scripts/reproduce --budget {study.budget.name}."
    return {f"{figure}.png": f"{texts[figure]} {made}" for figure in FIGURES}


def kernel(panel: Panel) -> str:
    """The name of a panel's kernel, such as `Wendland, s = 0.25`."""
    if panel.support is not None:
        return f"Wendland, s = {panel.support:g}"
    return f"triharmonic, {'r² log r' if panel.scenario == 'plane' else 'r³'}"


def number(value: float) -> str:
    """Four decimals, or a power of ten for nonzero values below 0.01."""
    if value == 0 or value >= 0.01:
        return f"{value:.4f}"
    exponent = math.floor(math.log10(value))
    raised = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{value / 10.0**exponent:.2f}·10{raised}"


def origin(exhibit: Exhibit) -> str:
    """The search that found a setup, such as `CMA-ES, λ = 0.9, seed 2`."""
    preferred = "" if math.isnan(exhibit.preference) else f", λ = {exhibit.preference:g}"
    return f"{METHODS[exhibit.method]}{preferred}, seed {exhibit.seed}"


def seeds(numbers: Iterable[int]) -> str:
    """Seeds as text, such as `seed 0` or `seeds 0, 1, 2`."""
    listed = sorted(set(numbers))
    return f"seed{'s' * (len(listed) != 1)} {', '.join(map(str, listed))}"


def expected(study: Study, scenario: str, method: str) -> list[Panel]:
    """The panels of a scenario on which the budget runs a method, in the order of the figures."""
    panels = [panels_of(scenario, kind, manipulation)[0] for manipulation in MANIPULATIONS for kind in KINDS]
    return [panel for panel in panels if method != "cmaes-full" or panel.name in study.budget.full]


def missing(study: Study, scenario: str, methods: Iterable[str], seed: int) -> str:
    """A sentence on the series that are missing on panels of a scenario; empty if none is."""
    lacks = []
    for method in methods:
        panels = expected(study, scenario, method)
        without = [panel for panel in panels if study.setups(panel, method, 0 if method == "ols" else seed) is None]
        if panels and len(without) == len(panels):
            lacks.append(METHODS[method])
        elif without:
            places = ", ".join(f"{kernel(panel).replace(', ', ' ')} {panel.manipulation}" for panel in without)
            lacks.append(f"{METHODS[method]} ({places})")
    return f" Not there: {'; '.join(lacks)}." if lacks else ""


def _spent(study: Study, scenario: str) -> str:
    """A sentence on the evaluations of the searches; those of the gradient search are taken from its runs."""
    summaries = [study.summary(panel, "gradient", seed) for panel in panels_of(scenario) for seed in study.budget.seeds]
    counts = [summary["evaluations"] for summary in summaries if summary is not None]
    gradient = ""
    if counts:
        some = f"{min(counts):,} to {max(counts):,}" if min(counts) < max(counts) else f"{counts[0]:,}"
        gradient = f", gradient search {some} (most of them with a gradient)"
    return f" Budget {study.budget.name}: {study.budget.description}{gradient}."


def _fronts(study: Study, figure: int, scenario: str) -> str:
    seed = study.budget.seeds[0]
    return (
        f"The paper's figure {figure} made again on {SCENARIOS[scenario]}, {seeds([seed])}: indirect above, "
        "direct below. CMA-ES maximizes λR + (1 - λ)P. The gradient search is not in the paper; its line bounds what "
        "its front dominates. Green triangles on the lower edge: setups of the initial population below it. "
        "Hypervolumes have the reference point (0, 0)."
        f"{missing(study, scenario, METHODS, seed)}{_spent(study, scenario)}"
    )


def _searches(study: Study, scenario: str) -> str:
    """The searches on a scenario to choose from with their seeds, the missing ones, and their evaluations."""
    available, lacks = [], []
    for method in SEARCHES:
        panels = expected(study, scenario, method)
        if not panels:
            continue
        there = {
            seed: sum(study.setups(panel, method, seed) is not None for panel in panels) for seed in study.budget.seeds
        }
        held = [seed for seed, count in there.items() if count]
        partly = "" if all(there[seed] == len(PANELS) // 2 for seed in held) else ", not on every panel"
        (available if held else lacks).append(f"{METHODS[method]} ({seeds(held)}{partly})" if held else METHODS[method])
    found = f" Chosen from {', '.join(available)}." if available else " There is nothing to choose from."
    return found + (f" Not there: {', '.join(lacks)}." if lacks else "") + _spent(study, scenario)


def _regular(study: Study, scenario: str) -> str:
    return (
        f"The paper's figure 4 made again on {SCENARIOS[scenario]}: the centers of best regularity that any search has "
        f"found, indirect manipulation above, direct below.{_marks(scenario)}{_searches(study, scenario)}"
    )


def _improvable(study: Study, scenario: str) -> str:
    return (
        f"The paper's figure 5 made again on {SCENARIOS[scenario]}: the centers of best improvement potential that any "
        "search has found (P does not depend on the manipulation, R does), over the initial local error, the row norms "
        f"of g, yellow where it is large, and over what each setup leaves of it.{_marks(scenario)}"
        f"{_searches(study, scenario)}"
    )


def _greedy(study: Study, figure: str, scenario: str) -> str:
    there = [exhibit for row in exhibits.of_figure(study, figure) for exhibit in row]
    lacks = " Not there: OLS." if not any(there) else " Not there: OLS on some panels." if not all(there) else ""
    grid = "30 × 30" if scenario == "plane" else "30 × 30 × 30"
    return (
        f"The paper's figure 7 made again on {SCENARIOS[scenario]}: the centers of orthogonal least squares (OLS), "
        f"chosen greedily from {grid} candidates, nothing at random (seed 0), over the initial local error, "
        f"the row norms of g, yellow where it is large, and over what each setup leaves of it.{_marks(scenario)}{lacks}"
    )


def _marks(scenario: str) -> str:
    legend = " Dots: centers in front of the surface; rings: inside or behind; far ones are smaller."
    return legend if scenario == "face" else ""


def _fits(study: Study) -> str:
    budget = study.budget
    return prose(f"""Not in the paper: generations that a later optimization takes until its error is within 5 % of the
        least one, over the regularity of its setup. Filled marks: isotropic evolution strategy, open ones: CMA-ES.
        Orthogonalized setups have R = 1 and stand at the R that they have under indirect manipulation. Triangles: given
        up with at least one seed, after {budget.fit_generations[0]:,} generations on the plane and
        {budget.fit_generations[1]:,} on the sphere. Setups of seed 0; medians over {budget.fit_seeds[0]} seed(s) of the
        strategy on the plane, {budget.fit_seeds[1]} on the sphere.""")


def _deformation(study: Study) -> str:
    ((exhibit,),) = exhibits.of_figure(study, "figure1")
    head = "The paper's figure 1 made again: the sphere X with the RBF centers, "
    end = "the target T, the front of an average MRI head (fsaverage, no real person)."
    if exhibit is None:
        return f"{head}and {end} Not there: any setup to deform the sphere."
    return (
        f"{head}the shape X' = X + U P that these centers give it, closest points and least squares in turn, and {end} "
        f"Grey vertices have no counterpart on the target and are to stay.{_marks('face')} {kernel(exhibit.panel)}; "
        f"the centers are {'the knee of the front' if exhibit.criterion == 'knee' else 'those'} of {origin(exhibit)}, "
        f"{exhibit.panel.manipulation} manipulation."
    )
