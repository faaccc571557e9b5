"""Setups between those of Lloyd and of OLS, by preference, in about the time of OLS (the paper's section 8).

Starts are the setups between the two, center by center, and those of `rbfevo.methods.penalized`, as they are and moved
towards the middles of their cells. From the best start of each preference a few quasi-Newton steps climb on a coarse
design.
"""

from __future__ import annotations

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
SHARPNESS = 16.0  # of the smooth R, as in the first round of `method=gradient`


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
        coarse, wishes = problem.coarsened(COARSE), self._wishes(problem)
        lloyd = LloydHeuristic().place(problem)[0]
        ols = OlsHeuristic(self.per_axis).place(problem)[0]
        starts = torch.cat((between(problem, ols, lloyd, wishes), spread(problem, wishes)))
        objectives = coarse.evaluate(torch.cat((starts, lloyd[None]))).objectives
        weight = range_weights(objectives, wishes)
        chosen = starts[preferred(weight[:, None], objectives[:-1]).argmax(1)]
        raised = climbed(coarse, chosen, weight, self.climbs)
        both = torch.stack((chosen, raised), dim=1)
        better = preferred(weight[:, None], problem.evaluate(both).objectives).argmax(1)
        return both[torch.arange(len(both)), better]

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


def range_weights(objectives: Tensor, wishes: Tensor) -> Tensor:
    """The preferences [p] of eq. 9 that weigh both ranges alike, of objectives [s, 2] whose last row is Lloyd's."""
    regular, potential = objectives.amax(0)
    gained = (potential - objectives[-1, 1]).clamp_min(torch.finfo(objectives.dtype).eps)
    of_regularity, of_potential = wishes * gained, (1.0 - wishes) * regular
    both = of_regularity + of_potential
    return torch.where(both > 0, of_regularity / both, 0.0)


def between(problem: Problem, ols: Tensor, lloyd: Tensor, wishes: Tensor) -> Tensor:
    """Setups [p, *setup] between two of them, the centers of which are paired so that they move the least."""
    from scipy.optimize import linear_sum_assignment

    here, there = problem.space.points(ols), problem.space.points(lloyd)
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
        risen = rise(problem, placed, aim, SHARPNESS, exponents, near)
        exponents, near = risen.exponents, risen.near
        climb.tell(risen.values, (risen.gradients * side).flatten(1))
    return space.place(space.lower + side * climb.points.unflatten(1, side.shape))
