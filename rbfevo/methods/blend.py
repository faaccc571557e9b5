"""Setups between those of Lloyd and of OLS, by preference, in about the time of OLS (the paper's section 8).

Starts are the setups between the two, center by center, and those of `rbfevo.methods.penalized`, as they are and moved
towards the middles of their cells. From the best start of each preference a few quasi-Newton steps climb on a coarse
design.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.methods.candidates import atoms_of, candidates_of
from rbfevo.methods.gradient.lbfgs import LBFGS
from rbfevo.methods.gradient.rise import rise
from rbfevo.methods.gradient.tracing import Preference
from rbfevo.methods.lloyd import LloydHeuristic, towards_centroids
from rbfevo.methods.method import Heuristic, Problem, at_least_one
from rbfevo.methods.ols import OlsHeuristic
from rbfevo.methods.penalized import penalized
from rbfevo.scenarios.coarse import coarsened
from rbfevo.scoring.fronts import preferred

COARSE = 2000  # vertices on which starts are made and compared, and setups climb
CANDIDATES = {2: 40, 3: 13}  # along each axis of the box
RELAXED = (0, 3, 10)  # steps towards the middles of the cells after which a setup is a start
SHARPNESS = 16.0  # of the smooth R


class BlendHeuristic(Heuristic):
    """One setup for each preference, from 0 (as OLS: improvement potential) to 1 (as Lloyd: regularity).

    A preference weighs R / R* against (P - P*) / (P+ - P*), where R* is the largest R and P+ the largest P of all
    starts, and P* the P of Lloyd's setup: unlike in eq. 9 both count alike whatever the kernel makes of R.

    Args:
        climbs: quasi-Newton steps of each setup.
        per_axis: candidates of OLS along each axis of the box.
    """

    name = "blend"
    prefers = True
    default_preferences = tuple(i / 10 for i in range(11))

    def __init__(self, climbs: int = 25, per_axis: int = 30) -> None:
        super().__init__()
        self.climbs = at_least_one(f"{self.name}: climbs", climbs)
        self.per_axis = at_least_one(f"{self.name}: per_axis", per_axis)

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        """Starts, steps, and the setups themselves."""
        count = len(self.default_preferences if preferences is None else preferences)
        return count * (1 + len(RELAXED) + self.climbs + 2)

    def place(self, problem: Problem) -> Tensor:
        """[p, m, d]."""
        coarse = problem.coarsened(COARSE)
        starts = Starts.of(problem, coarse, self.heuristics(problem), self._wishes(problem))
        chosen = starts.best()
        both = torch.stack((chosen, climbed(coarse, chosen, starts.weight, self.climbs)), dim=1)
        better = preferred(starts.weight[:, None], problem.evaluate(both).objectives).argmax(1)
        return both[torch.arange(len(both)), better]

    def heuristics(self, problem: Problem) -> Tensor:
        """The setups [2, *setup] of OLS and of Lloyd."""
        ols, lloyd = OlsHeuristic(self.per_axis).place(problem), LloydHeuristic().place(problem)
        return torch.cat((ols, lloyd))

    def step(self) -> None:
        """Place and score the setups, each with its preference."""
        super().step()
        if self._problem is not None:
            wishes = self._wishes(self._problem)
            self._rows = [rows._replace(preference=wishes.to(rows.preference)) for rows in self._rows]

    def _wishes(self, problem: Problem) -> Tensor:
        asked = self.default_preferences if problem.preferences is None else problem.preferences
        return torch.tensor(asked, dtype=problem.space.lower.dtype, device=problem.space.lower.device)

    def progress(self) -> list[tuple[float, Tensor]]:
        """A line of the history for each preference."""
        found = []
        for rows in self._rows:
            pairs = zip(rows.preference.tolist(), rows.scores.objectives, strict=True)
            found += [(preference, row[None]) for preference, row in pairs]
        return found


class Starts(NamedTuple):
    """Where setups can begin to climb.

    Attributes:
        setups: [s, *setup]: p between OLS and Lloyd, and p of each step of `RELAXED`; objectives: [s, 2] R and P.
        weight: [p] the preferences of eq. 9 that weigh the range of R and that of P alike.
    """

    setups: Tensor
    objectives: Tensor
    weight: Tensor

    @classmethod
    def of(cls, problem: Problem, coarse: Problem, heuristics: Tensor, wishes: Tensor) -> Starts:
        """Those of a problem, compared on a coarse one.

        Args:
            heuristics: [2, *setup] of OLS and of Lloyd; wishes: [p].
        """
        setups = torch.cat((between(problem, heuristics, wishes), spread(problem, wishes)))
        objectives = coarse.evaluate(torch.cat((setups, heuristics[1:]))).objectives
        regular, potential = objectives.amax(0)
        gained = (potential - objectives[-1, 1]).clamp_min(torch.finfo(objectives.dtype).eps)
        of_regularity, of_potential = wishes * gained, (1.0 - wishes) * regular
        both = of_regularity + of_potential
        return cls(setups, objectives[:-1], torch.where(both > 0, of_regularity / both, 0.0))

    def best(self) -> Tensor:
        """The best for each preference [p, *setup]."""
        return self.setups[preferred(self.weight[:, None], self.objectives).argmax(1)]


def between(problem: Problem, two: Tensor, wishes: Tensor) -> Tensor:
    """Setups [p, *setup] between two of them [2, *setup], whose centers are paired so that they move the least."""
    from scipy.optimize import linear_sum_assignment

    here, there = problem.space.points(two)
    rows, columns = linear_sum_assignment(torch.cdist(here, there).square().cpu().numpy())
    share = wishes[:, None, None]
    return problem.space.place((1.0 - share) * here[rows] + share * there[columns])


def spread(problem: Problem, wishes: Tensor) -> Tensor:
    """The picks of `penalized` for each preference, as they are and moved towards the middles of their cells."""
    scenario = problem.scenario
    design = coarsened(scenario.half(), COARSE)
    atoms, root = atoms_of(problem.representation.placed_by, design), design.weights.sqrt()[:, None]
    root = root if design.blend is None else root * design.blend[:, None]
    flat = scenario.vertices.shape[1] == 2 or scenario.planar is not None
    candidates, kept = candidates_of(scenario, CANDIDATES[2 if flat else 3]), problem.kept_on_one_side
    there = None if kept is None else root * atoms(kept)
    g = design.weights.sqrt()[:, None] * design.gradient
    centers = candidates[penalized(root * atoms(candidates), g, problem.free, wishes, there)]
    vertices = design.vertices if design.planar is None else design.planar.pinned(design.vertices)
    found = []
    for step in range(max(RELAXED) + 1):
        if step in RELAXED:
            found.append(problem.assembled(BlendHeuristic.name, centers))
        centers = towards_centroids(vertices, design.weights, centers, 0.5 * wishes, kept)
    return torch.cat(found)


def climbed(problem: Problem, setups: Tensor, weight: Tensor, steps: int) -> Tensor:
    """Setups [p, *setup] after quasi-Newton steps on R and P weighed as in eq. 9."""
    space = problem.space
    side = space.upper - space.lower
    climb = LBFGS(((space.points(setups) - space.lower) / side).flatten(1).clamp(0.0, 1.0))
    aim, exponents, near = Preference(weight), None, None
    for _ in range(steps):
        placed = space.lower + side * climb.ask().unflatten(1, side.shape)
        risen = rise(problem, placed, aim, SHARPNESS, exponents, near, climb.accepts)
        exponents, near = risen.exponents, risen.near
        climb.tell(risen.values, (risen.gradients * side).flatten(1))
    return space.place(space.lower + side * climb.points.unflatten(1, side.shape))
