"""The nested sequence of a run: what the first 1, 2, ... of the centers that OLS picks score, and its file."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import torch

from rbfevo.methods import OlsHeuristic
from rbfevo.methods.candidates import TooFewCandidatesError, candidates_of
from rbfevo.methods.method import Problem
from rbfevo.runs.assembly import Parts
from rbfevo.scenarios.coarse import coarsened
from rbfevo.scoring.combination import Combination
from rbfevo.scoring.prefixes import bounded_prefixes, shared_scores
from rbfevo.scoring.representations import RBF
from rbfevo.scoring.symmetric import evaluator_of

KEPT = 1.25e9  # bytes: the candidates' columns in single precision; a larger design is coarsened for the picks
FEWEST = 2000  # vertices of a design that is coarsened for the picks


class Picks(NamedTuple):
    """Centers [m, d] in the order picked, and why there are no more of them; empty where nothing ended them."""

    centers: torch.Tensor
    note: str


def table(parts: Parts, picked: torch.Tensor, manipulation: str) -> dict[str, np.ndarray]:
    """The columns of sequence.csv: for each number m of centers R and P of the setup of the first m picks [p, d].

    With a plane of symmetry and an odd number the pick nearest to the plane is moved onto it, as in a run of
    `method=ols`. `x`, `y`, `z` are those of pick m.
    """
    setups = [parts.scenario.parameterization.settle(picked[:m]) for m in range(1, len(picked) + 1)]
    scenario = parts.scenario
    evaluator, combination = evaluator_of(scenario, parts.representation, manipulation, "eager"), _combination(parts)
    regularity, each = shared_scores(evaluator, setups, combination)
    found = {"centers": np.arange(1, len(picked) + 1), "regularity": regularity.numpy()}
    found["improvement_potential"] = combination.mean(each).numpy()
    if parts.norm != 2.0:
        each = torch.stack([bounded_prefixes(one, setups, picked) for one in parts.bounded(scenario)], dim=1)
        found["bounded_potential"] = combination.mean(each).numpy()
    if combination.worst:
        found["worst_potential"] = combination(each).numpy()
    return found | {axis: picked[:, i].numpy() for i, axis in enumerate("xyz"[: picked.shape[1]])}


def picks(parts: Parts, most: int) -> Picks:
    """Up to `most` centers that OLS picks for a run, fewer where no other candidate adds anything.

    Raises:
        UserError: if the representation does not consist of centers, or OLS finds nothing to pick.
    """
    given = parts.problem()
    problem, heuristic = dataclasses.replace(given, centers=most, kept=given.kept[:0]), OlsHeuristic()
    problem = _small(problem, heuristic)
    try:
        return Picks(heuristic.picks(problem), "")
    except TooFewCandidatesError as error:
        if error.found < 1:
            raise
        found = heuristic.picks(dataclasses.replace(problem, centers=error.found))
        return Picks(found, f"no other candidate has a column of its own: the sequence ends with {len(found)} centers")


def _small(problem: Problem, heuristic: OlsHeuristic) -> Problem:
    """The problem on no more vertices than OLS keeps columns of; bounded potential has a coarse design of its own."""
    if problem.norm != 2.0:
        return problem
    count = len(candidates_of(problem.scenario, heuristic.per_axis))
    most = max(FEWEST, int(KEPT / (4 * count))) * (1 if problem.scenario.mirror is None else 2)
    return dataclasses.replace(problem, scenario=coarsened(problem.scenario, most))


def is_scored(parts: Parts) -> bool:
    """Whether the columns of a run's setups belong to one center each."""
    return isinstance(parts.representation, RBF) and parts.representation.plain


def _combination(parts: Parts) -> Combination:
    return Combination.of(parts.scenario.objectives)
