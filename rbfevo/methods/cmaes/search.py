"""CMA-ES as a method of a run: settings, one generation a step, and what it has found."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.cmaes.algorithm import CMAES
from rbfevo.methods.method import Method, Problem, Rows, at_least_one, starts_of, unscored
from rbfevo.scoring.fronts import preferred


class CmaesSearch(Method):
    """One setup per preference by (parents, population)-CMA-ES, all preferences as one batch (paper, eq. 9).

    Every element starts at the member of the initial population that its preference likes best, or of the setups in
    the files of `start`, with step size `sigma` times the sides of the box.
    """

    name = "cmaes"
    prefers = True

    def __init__(
        self,
        parents: int = 25,
        population: int = 100,
        generations: int = 300,
        sigma: float = 0.05,
        start: Any = None,
    ) -> None:
        self.steps = at_least_one(f"{self.name}: generations", generations)
        self.initial = self.population = at_least_one(f"{self.name}: population", population)
        self.parents = at_least_one(f"{self.name}: parents", parents)
        if not (math.isfinite(sigma) and sigma > 0):
            raise UserError(f"cmaes: sigma={sigma}: the first step size must be a positive fraction of the box")
        if parents > population:
            raise UserError(f"cmaes: parents={parents}: give at most population={population}, the number of offspring")
        self.sigma = sigma
        self.begins = starts_of(start, self.name, population)
        self.default_preferences: tuple[float, ...] = (0.5,)

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        searched = self.steps * self.population * len(preferences or self.default_preferences)
        return searched + len(self.begins)

    def start(self, problem: Problem) -> None:
        self._problem = problem
        preferences = problem.preferences or self.default_preferences
        initial, scores = problem.initial.centers, problem.initial.scores
        if self.inputs is not None:
            initial = problem.space.place(self.inputs.to(initial))
            scores = problem.evaluate(initial)
        self._preferences = torch.tensor(preferences, dtype=initial.dtype, device=initial.device)
        fitness = preferred(self._preferences[:, None], scores.objectives)
        lower, upper = problem.flat_box
        self._algorithm = CMAES(
            problem.flatten(initial)[fitness.argmax(1)],
            self.sigma,
            lower,
            upper,
            generators=[problem.stream(f"cmaes {preference!r}") for preference in preferences],
            parents=self.parents,
            offspring=self.population,
        )
        best, genotypes = fitness.max(1), problem.flatten(initial)
        self._fitness = best.values
        self._best, self._objectives = genotypes[best.indices], scores.objectives[best.indices]

    def step(self) -> None:
        genotypes = self._algorithm.ask()
        objectives = self._problem.evaluate(self._problem.unflatten(genotypes)).objectives
        fitness = preferred(self._preferences[:, None], objectives)
        self._algorithm.tell(fitness)
        value, index = fitness.max(1)
        better = value > self._fitness
        rows = torch.arange(len(index), device=index.device)
        self._fitness = torch.where(better, value, self._fitness)
        self._best = torch.where(better[:, None], genotypes[rows, index], self._best)
        self._objectives = torch.where(better[:, None], objectives[rows, index], self._objectives)

    def progress(self) -> list[tuple[float, Tensor]]:
        return [
            (preference, row[None])
            for preference, row in zip(self._preferences.tolist(), self._objectives, strict=True)
        ]

    def rows(self) -> list[Rows]:
        centers = self._problem.unflatten(self._best)
        return [Rows(self.name, centers, unscored(centers, self._objectives), self._preferences)]

    def state_dict(self) -> dict[str, Any]:
        """The strategies, and the best that they have met."""
        best = {"fitness": self._fitness.clone(), "best": self._best.clone(), "objectives": self._objectives.clone()}
        return {"algorithm": self._algorithm.state_dict(), **best}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with those strategies."""
        self._algorithm.load_state_dict(state["algorithm"])
        self._fitness, self._best, self._objectives = (
            state[name].to(self._best).clone() for name in ("fitness", "best", "objectives")
        )

    def fits(self, steps: int) -> bool:
        """A generation does not know how many there will be."""
        return True
