"""Claims about the three scores themselves (paper, section 4), on random setups and on fronts."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
import torch

from benchmarks.panels import Panel
from rbfevo.methods.method import random_stream
from rbfevo.runs.config import build
from rbfevo.scoring.deformation import MANIPULATIONS, RBFDeformation
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import Wendland
from reproduction.claims.claim import Case, Claim, claim
from reproduction.study import SCENARIOS, Array, Setups, Study, kernel_of, panels_of


def by_manipulation(study: Study, *methods: str) -> Iterator[tuple[str, int, str, Setups, Setups]]:
    """Scenario and kernel, seed, method, and its setups for indirect and for direct manipulation."""
    for panel in panels_of(manipulation="indirect"):
        other = panel._replace(manipulation="direct")
        for method in methods:
            for seed in set(study.seeds(panel, method)) & set(study.seeds(other, method)):
                where = f"{panel.scenario}-{kernel_of(panel)}"
                yield where, seed, method, study.held(panel, method, seed), study.held(other, method, seed)


def from_matrices(study: Study, panel: Panel, centers: Array) -> tuple[Array, Array]:
    """V and P [2, p] of setups [p, m, d], computed by NumPy from U = Phi and from U = Phi Psi^-1.

    rbfevo's own scores compute V and P from Phi for both manipulations, so they cannot disagree.
    """
    scenario = study.scenario(panel.scenario)
    kernel = build(panel.settings("method=lloyd").kernel, scenario.vertices.shape[1], scenario.support)
    g, V, P = scenario.gradient.numpy(), [], []
    for manipulation in MANIPULATIONS:
        deformation = RBFDeformation(scenario.vertices, kernel, manipulation)
        for setup in centers:
            left, sigma, _ = np.linalg.svd(deformation(torch.from_numpy(setup)).numpy(), full_matrices=False)
            kept = left[:, sigma > max(left.shape) * np.finfo(float).eps * sigma[0]]
            V.append(kept.shape[1] / len(g))
            P.append(float(np.square(kept.T @ g).sum()))
    return np.reshape(V, (2, -1)), np.reshape(P, (2, -1))


@functools.cache
def difference(study: Study) -> list[tuple[str, int, float, float]]:
    """Scenario and kernel, seed, and the largest differences of V and of P between the two manipulations."""
    found = []
    for panel, seed, (random, lloyd) in study.each(panels_of(manipulation="indirect"), "random", "lloyd"):
        V, P = from_matrices(study, panel, np.concatenate([lloyd.centers, random.centers[:9]]))
        where = f"{panel.scenario}-{kernel_of(panel)}"
        found.append((where, seed, float(np.abs(V[0] - V[1]).max()), float(np.abs(P[0] - P[1]).max())))
    return found


@claim(
    "variability-manipulation",
    "4",
    "Variability does not depend on the manipulation.",
    "the largest |V(indirect) - V(direct)| over Lloyd's setup and nine random ones, by NumPy's SVD of either matrix U",
    "0",
    ("random", "lloyd"),
)
def variability_manipulation(study: Study) -> Iterator[Case]:
    for where, seed, value, _ in difference(study):
        yield Case(where, seed, value, value == 0)


@claim(
    "potential-manipulation",
    "4",
    "Improvement potential does not depend on the manipulation.",
    "the largest |P(indirect) - P(direct)| over Lloyd's setup and nine random ones, by NumPy's SVD of either matrix U",
    "<= 1e-8",
    ("random", "lloyd"),
    {"holds": "both matrices span the same space; what remains is rounding."},
)
def potential_manipulation(study: Study) -> Iterator[Case]:
    for where, seed, _, value in difference(study):
        yield Case(where, seed, value, value <= 1e-8)


@claim(
    "rank",
    "4",
    "The deformation matrix has maximal rank, so V is constant, as long as no two centers coincide.",
    "the share of random setups, no two centers in the same place, with V = m/n: drawn as the paper draws them (its "
    "initial populations), and, for the local kernel on the sphere, anywhere in the box that the search may use",
    "1",
    ("random",),
    {
        "holds in part": """distinct centers suffice where each of them reaches a vertex, as in all initial
        populations; in the box around the sphere a local kernel's center may reach none, its column is then 0, and
        the rank falls."""
    },
)
def rank(study: Study) -> Iterator[Case]:
    for panel, seed, (setups,) in study.each(panels_of(manipulation="indirect"), "random"):
        n = len(study.scenario(panel.scenario).vertices)
        ranks = np.rint(setups.variability * n)
        share = float((ranks == setups.centers.shape[1]).mean())
        yield Case(panel.name.removesuffix("-indirect"), seed, share, share == 1)
    (panel,) = panels_of("face", "local", "indirect")
    for _, seed, (setups,) in study.each((panel,), "random"):
        scenario = study.scenario("face")
        evaluate = Evaluator(scenario.vertices, scenario.gradient, Wendland(float(panel.support or 0)), backend="eager")
        stream = random_stream(seed, "centers in the box")
        draws = torch.rand(setups.centers.shape, generator=stream, dtype=torch.float64)
        centers = scenario.lower + (scenario.upper - scenario.lower) * draws
        ranks = (evaluate(centers).variability * len(scenario.vertices)).round()
        share = float((ranks == setups.centers.shape[1]).double().mean())
        yield Case(f"face-{kernel_of(panel)}, anywhere in the box", seed, share, share == 1)


def by_kernel(study: Study, score: str) -> Iterator[tuple[str, int, list[float]]]:
    """Scenario, manipulation and reduction; seed; the reduced score for the local, the wide and the global kernel."""
    for scenario in SCENARIOS:
        for manipulation in ("indirect", "direct"):
            panels = [panels_of(scenario, kernel, manipulation)[0] for kernel in ("local", "wide", "triharmonic")]
            for method, what, reduce in (
                ("random", "median of random setups", np.median),
                ("nsga2", "best of the front", np.max),
            ):
                for seed in study.budget.seeds:
                    found = [study.setups(panel, method, seed) for panel in panels]
                    if all(setups is not None for setups in found):
                        values = [float(reduce(getattr(setups, score))) for setups in found]
                        yield f"{scenario} {manipulation}, {what}", seed, values


@claim(
    "local-regular",
    "4",
    "Local kernels are more regular than global ones.",
    "the least ratio of R from one kernel to the next, from local to wide Wendland and from wide to "
    "triharmonic: median "
    "over the random setups, and best of NSGA-II's front",
    "> 1",
    ("random", "nsga2"),
)
def local_regular(study: Study) -> Iterator[Case]:
    for where, seed, values in by_kernel(study, "regularity"):
        ratio = min(values[0] / max(values[1], 1e-300), values[1] / max(values[2], 1e-300))
        yield Case(where, seed, ratio, ratio > 1)


@claim(
    "global-potential",
    "4",
    "Global kernels have more improvement potential than local ones.",
    "the least gain of P from one kernel to the next, from local to wide Wendland and from wide to triharmonic: median "
    "over the random setups, and best of NSGA-II's front",
    "> 0",
    ("random", "nsga2"),
    {
        "holds in part": """it is so for random setups; once centers are optimized, the wide Wendland kernel reaches as
        much as the triharmonic one, or more."""
    },
)
def global_potential(study: Study) -> Iterator[Case]:
    for where, seed, values in by_kernel(study, "improvement_potential"):
        gain = min(values[1] - values[0], values[2] - values[1])
        yield Case(where, seed, gain, gain > 0)


@claim(
    "direct-regular",
    "4",
    "Direct manipulation is more regular than indirect manipulation.",
    "random setups: the share with R(direct) > R(indirect), the same centers under both; fronts: best R of NSGA-II's "
    "front, direct over indirect",
    "share >= 0.9; ratio > 1",
    ("random", "nsga2"),
)
def direct_regular(study: Study) -> Iterator[Case]:
    for where, seed, _, indirect, direct in by_manipulation(study, "random"):
        share = float((direct.regularity > indirect.regularity).mean())
        yield Case(f"{where} random, share", seed, share, share >= 0.9)
    for where, seed, _, indirect, direct in by_manipulation(study, "nsga2"):
        ratio = float(direct.regularity.max() / indirect.regularity.max())
        yield Case(f"{where} front, ratio", seed, ratio, ratio > 1)


@claim(
    "conflict",
    "4",
    "Regularity and improvement potential are in conflict.",
    "R of the front's setup of best P, over the best R of the front (NSGA-II; the gradient search's does not count)",
    "<= 0.5: the setup of best P gives up at least half of the regularity",
    ("nsga2", "gradient"),
    {
        "holds in part": """where it is not, NSGA-II's front ends early: the gradient search's, which stands beside
        it, goes on to higher P at less R."""
    },
)
def conflict(study: Study) -> Iterator[Case]:
    for method in ("nsga2", "gradient"):
        for panel, seed, (setups,) in study.each(panels_of(), method):
            ratio = float(setups.regularity[setups.most_improvable] / setups.regularity.max())
            yield Case(f"{panel.name} {method}", seed, ratio, ratio <= 0.5, counts=method == "nsga2")


CLAIMS: tuple[Claim, ...] = (
    variability_manipulation,
    potential_manipulation,
    rank,
    local_regular,
    global_potential,
    direct_regular,
    conflict,
)
