"""Claims about the fronts (paper, section 5 and figures 3 and 6)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.spatial import ConvexHull

from rbfevo.scoring.pareto import hypervolume
from reproduction import measures
from reproduction.claims.claim import Case, Claim, claim
from reproduction.study import Study, panels_of


@claim(
    "smooth",
    "5.1",
    "The fronts are smooth.",
    """degrees by which NSGA-II's front, scaled to [0, 1] in R and in P, turns to and fro along its way: all turns
    between 15 equal stretches less their sum (0 for a front that bends one way only; 360 for a staircase of three
    steps; some 500 for a quarter circle with noise of half a percent)""",
    "<= 180",
    ("nsga2",),
)
def smooth(study: Study) -> Iterator[Case]:
    for panel, seed, (setups,) in study.each(panels_of(), "nsga2"):
        value = measures.roughness(setups.front.objectives)
        yield Case(panel.name, seed, value, value <= 180)


@claim(
    "without-gaps",
    "5.1",
    "The fronts are well covered: they have no gaps.",
    "the largest step between neighbours on NSGA-II's front, scaled to [0, 1] in R and in P",
    "<= 0.1",
    ("nsga2",),
)
def without_gaps(study: Study) -> Iterator[Case]:
    for panel, seed, (setups,) in study.each(panels_of(), "nsga2"):
        value = float(measures.steps(setups.front.objectives).max())
        yield Case(panel.name, seed, value, value <= 0.1)


@claim(
    "convex",
    "5.1",
    "The fronts are well-shaped: bulging towards the ideal point, without dents.",
    "the area that NSGA-II's front, scaled to [0, 1] in R and in P, has below its polygon, over the area below "
    "its convex "
    "hull",
    ">= 0.97",
    ("nsga2",),
)
def convex(study: Study) -> Iterator[Case]:
    for panel, seed, (setups,) in study.each(panels_of(), "nsga2"):
        front = measures.scaled(setups.front.objectives, setups.front.objectives)
        hull = ConvexHull(np.concatenate([front, [[0.0, 0.0]]])).volume
        value = float(np.trapezoid(front[:, 1], front[:, 0]) / hull)
        yield Case(panel.name, seed, value, value >= 0.97)


def best(study: Study, score: str, **which: str) -> Iterator[tuple[str, int, float]]:
    """Panel and method, seed and best score of NSGA-II's fronts and of the gradient search's."""
    for method in ("nsga2", "gradient"):
        for panel, seed, (setups,) in study.each(panels_of(**which), method):
            yield f"{panel.name} {method}", seed, float(getattr(setups, score).max())


@claim(
    "local-regularity-near-1",
    "5.1",
    "The front of the local Wendland kernel almost reaches 1 in regularity.",
    "best R of NSGA-II's front; the gradient search's stands beside it and does not count",
    ">= 0.9",
    ("nsga2", "gradient"),
    {
        "holds in part": "NSGA-II stops just short of it on this budget; the gradient search gets to 0.98 and more.",
    },
)
def local_regularity(study: Study) -> Iterator[Case]:
    for where, seed, value in best(study, "regularity", kernel="local"):
        yield Case(where, seed, value, value >= 0.9, counts=where.endswith("nsga2"))


@claim(
    "local-potential-near-1",
    "5.1",
    "The front of the local Wendland kernel almost reaches 1 in improvement potential.",
    "best P of NSGA-II's front; the gradient search's stands beside it and does not count",
    ">= 0.9",
    ("nsga2", "gradient"),
    {
        "holds in part": """on the sphere 25 supports of radius 0.5 are too few for the face: NSGA-II ends below 0.9,
        the gradient search just above."""
    },
)
def local_potential(study: Study) -> Iterator[Case]:
    for where, seed, value in best(study, "improvement_potential", kernel="local"):
        yield Case(where, seed, value, value >= 0.9, counts=where.endswith("nsga2"))


@claim(
    "triharmonic-indirect",
    "5.1",
    "The triharmonic kernel is very irregular under indirect manipulation.",
    "best R of NSGA-II's front, over the best R of the wide Wendland kernel's on the same scenario, both indirect",
    "<= 0.05",
    ("nsga2",),
)
def triharmonic_indirect(study: Study) -> Iterator[Case]:
    for panel, seed, (setups,) in study.each(panels_of(kernel="triharmonic", manipulation="indirect"), "nsga2"):
        wide = study.setups(panels_of(panel.scenario, "wide", "indirect")[0], "nsga2", seed)
        if wide is not None:
            value = float(setups.regularity.max() / wide.regularity.max())
            yield Case(panel.name, seed, value, value <= 0.05)


@claim(
    "sphere-like-plane",
    "5.2",
    "The sphere's plots are qualitatively like the plane's.",
    "Spearman's correlation between the two scenarios over their six panels of best R, of best P and of the "
    "hypervolume "
    "(reference point (0, 0)) of NSGA-II's fronts",
    ">= 0.8",
    ("nsga2",),
)
def sphere_like_plane(study: Study) -> Iterator[Case]:
    columns = {
        "best R": lambda setups: setups.regularity.max(),
        "best P": lambda setups: setups.improvement_potential.max(),
        "hypervolume": lambda setups: hypervolume(torch.from_numpy(setups.objectives)),
    }
    for seed in study.budget.seeds:
        found = {name: [study.setups(panel, "nsga2", seed) for panel in panels_of(name)] for name in ("plane", "face")}
        if any(setups is None for series in found.values() for setups in series):
            continue
        for name, column in columns.items():
            plane, sphere = (np.array([column(setups) for setups in series]) for series in found.values())
            value = measures.spearman(plane, sphere)
            yield Case(name, seed, value, value >= 0.8)


@claim(
    "sphere-like-plane-shape",
    "5.2",
    "The sphere's fronts have the shape of the plane's.",
    "root mean square difference in P between NSGA-II's fronts of the sphere and of the plane, each scaled to "
    "[0, 1] in R "
    "and in P, over R; panels in pairs by kernel (local, wide, triharmonic) and manipulation",
    "<= 0.1",
    ("nsga2",),
)
def sphere_like_plane_shape(study: Study) -> Iterator[Case]:
    across = np.linspace(0, 1, 201)
    for plane, sphere in zip(panels_of("plane"), panels_of("face"), strict=True):
        for seed in set(study.seeds(plane, "nsga2")) & set(study.seeds(sphere, "nsga2")):
            shapes = []
            for panel in (plane, sphere):
                front = study.held(panel, "nsga2", seed).front.objectives
                shapes.append(np.interp(across, *measures.scaled(front, front).T))
            value = float(np.sqrt(((shapes[0] - shapes[1]) ** 2).mean()))
            yield Case(f"{plane.name} and {sphere.name.split('-', 1)[1]}", seed, value, value <= 0.1)


CLAIMS: tuple[Claim, ...] = (
    smooth,
    without_gaps,
    convex,
    local_regularity,
    local_potential,
    triharmonic_indirect,
    sphere_like_plane,
    sphere_like_plane_shape,
)
