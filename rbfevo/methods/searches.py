"""The searches as methods of a run: settings, one generation a step, and what they have found."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.cmaes import CMAES
from rbfevo.methods.method import Method, Problem, Rows, at_least_one, no_preference
from rbfevo.methods.nsga2 import NSGA2, check_settings
from rbfevo.scoring.evolvability import Scores


class Nsga2Search(Method):
    """The front of regularity and improvement potential by NSGA-II (paper, section 5)."""

    name = "nsga2"

    def __init__(
        self,
        population: int = 100,
        generations: int = 1000,
        crossover_probability: float = 0.9,
        crossover_eta: float = 20.0,
        mutation_probability: float | None = None,
        mutation_eta: float = 20.0,
    ) -> None:
        self.steps = at_least_one(f"{self.name}: generations", generations)
        check_settings(population, crossover_probability, crossover_eta, mutation_probability, mutation_eta)
        self.initial = self.population = population
        self.crossover_probability, self.crossover_eta = crossover_probability, crossover_eta
        self.mutation_probability, self.mutation_eta = mutation_probability, mutation_eta

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        return self.steps * self.population

    def start(self, problem: Problem) -> None:
        lower, upper = problem.flat_box
        self._problem = problem
        start = problem.initial.centers[: self.population]
        self.algorithm = NSGA2(
            start.flatten(1),
            lower,
            upper,
            generator=problem.stream("nsga2"),
            crossover_probability=self.crossover_probability,
            crossover_eta=self.crossover_eta,
            mutation_probability=self.mutation_probability,
            mutation_eta=self.mutation_eta,
        )
        self.algorithm.ask()
        self.algorithm.tell(problem.initial.scores.objectives[: self.population])

    def step(self) -> None:
        centers = self._problem.unflatten(self.algorithm.ask())
        self.algorithm.tell(self._problem.evaluate(centers).objectives)

    def progress(self) -> list[tuple[float, Tensor]]:
        return [(math.nan, self.algorithm.objectives)]

    def rows(self) -> list[Rows]:
        centers = self._problem.unflatten(self.algorithm.population)
        return [no_preference(self.name, centers, unscored(centers, self.algorithm.objectives))]

    def state_dict(self) -> dict[str, Any]:
        """The population, its objectives and the generator."""
        return self.algorithm.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with that population."""
        self.algorithm.load_state_dict(state)

    def fits(self, steps: int) -> bool:
        """A generation does not know how many there will be."""
        return True


class CmaesSearch(Method):
    """One setup per preference by (parents, population)-CMA-ES, all preferences as one batch (paper, eq. 9).

    Every element starts at the member of the initial population that its preference likes best, with step size
    `sigma` times the sides of the box.
    """

    name = "cmaes"
    prefers = True

    def __init__(self, parents: int = 25, population: int = 100, generations: int = 300, sigma: float = 0.05) -> None:
        self.steps = at_least_one(f"{self.name}: generations", generations)
        self.initial = self.population = at_least_one(f"{self.name}: population", population)
        self.parents = at_least_one(f"{self.name}: parents", parents)
        if not (math.isfinite(sigma) and sigma > 0):
            raise UserError(f"cmaes: sigma={sigma}: the first step size must be a positive fraction of the box")
        if parents > population:
            raise UserError(f"cmaes: parents={parents}: there are no more than population={population} offspring")
        self.sigma = sigma
        self.default_preferences: tuple[float, ...] = (0.5,)

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        return self.steps * self.population * len(preferences or self.default_preferences)

    def start(self, problem: Problem) -> None:
        self._problem = problem
        preferences = problem.preferences or self.default_preferences
        initial, scores = problem.initial.centers, problem.initial.scores
        self._preferences = torch.tensor(preferences, dtype=initial.dtype, device=initial.device)
        fitness = preferred(self._preferences[:, None], scores.objectives)
        lower, upper = problem.flat_box
        self._algorithm = CMAES(
            initial[fitness.argmax(1)].flatten(1),
            self.sigma,
            lower,
            upper,
            generators=[problem.stream(f"cmaes {preference!r}") for preference in preferences],
            parents=self.parents,
            offspring=self.population,
        )
        best, genotypes = fitness.max(1), initial.flatten(1)
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


class Panel:
    """One panel of the paper's figures 3 and 6: front, preference grid, Lloyd and OLS, one after the other."""

    name = "panel"

    def __init__(self, nsga2: Method, cmaes: CmaesSearch, lloyd: Method, ols: Method) -> None:
        cmaes.default_preferences = tuple(i / 10 for i in range(11))
        self.stages: list[Method] = [nsga2, cmaes, lloyd, ols]


def preferred(preference: Tensor, objectives: Tensor) -> Tensor:
    """f = preference R + (1 - preference) P of objectives [..., 2], maximized (paper, eq. 9)."""
    return preference * objectives[..., 0] + (1.0 - preference) * objectives[..., 1]


def unscored(centers: Tensor, objectives: Tensor) -> Scores:
    """Scores of setups of which a search keeps no more than the objectives; V is filled in when a run is saved."""
    nan = torch.full_like(objectives[:, 0], math.nan)
    return Scores(objectives[:, 0], objectives[:, 1], nan, torch.zeros_like(nan, dtype=torch.bool))
