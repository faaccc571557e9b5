"""Random setups, to compare with."""

from __future__ import annotations

from torch import Tensor

from rbfevo.methods.method import Heuristic, Problem, at_least_one


class RandomHeuristic(Heuristic):
    """`population` setups drawn as the scenario draws initial ones: uniform in the plane's box, or on the sphere."""

    name = "random"

    def __init__(self, population: int = 100) -> None:
        super().__init__()
        self.population = at_least_one(f"{self.name}: population", population)

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        return self.population

    def place(self, problem: Problem) -> Tensor:
        """[population, *setup]."""
        return problem.space.place(problem.space.sample(self.population, problem.stream("random")))
