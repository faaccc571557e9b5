"""The heuristics as methods of a run: one step, no search (paper, section 7)."""

from __future__ import annotations

from torch import Tensor

from rbfevo.methods.lloyd import lloyd
from rbfevo.methods.method import Heuristic, Problem, at_least_one
from rbfevo.methods.ols import grid_candidates, ols
from rbfevo.scoring.gram import kernel_columns


class RandomHeuristic(Heuristic):
    """`population` setups drawn as the scenario draws initial ones: uniform in the plane's box, or on the sphere."""

    name = "random"

    def __init__(self, population: int = 100) -> None:
        super().__init__()
        self.population = at_least_one(f"{self.name}: population", population)

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        return self.population

    def place(self, problem: Problem) -> Tensor:
        """[population, m, d]."""
        centers = problem.scenario.sample(self.population, problem.centers, problem.stream("random"))
        return problem.parameterization(centers)


class LloydHeuristic(Heuristic):
    """Uniform centers by Lloyd sampling, for high regularity: the best of `starts` runs of k-means on the vertices.

    Of a symmetric design it sees one half, and no vertices where no center may sit.
    """

    name = "lloyd"

    def __init__(self, starts: int = 10, iterations: int = 100) -> None:
        super().__init__()
        self.starts = at_least_one(f"{self.name}: starts", starts)
        self.iterations = at_least_one(f"{self.name}: iterations", iterations)

    def place(self, problem: Problem) -> Tensor:
        """[1, m, d]."""
        design = problem.scenario.half(open_only=True)
        centers = lloyd(
            design.vertices,
            problem.centers,
            generator=problem.stream("lloyd"),
            weights=design.weights,
            starts=self.starts,
            iterations=self.iterations,
        )
        return problem.parameterization.settle(centers)[None]


class OlsHeuristic(Heuristic):
    """Greedy centers by orthogonal least squares on a grid of candidates, for high improvement potential.

    They are chosen for indirect manipulation and used for both, since P is the same for both. Of a symmetric design it
    sees one half, without the images of the centers.
    """

    name = "ols"

    def __init__(self, per_axis: int = 30) -> None:
        super().__init__()
        self.per_axis = at_least_one(f"{self.name}: per_axis", per_axis)

    def _candidates(self, problem: Problem) -> Tensor:
        """The grid [c, d] over the box, without the region where no center may sit."""
        grid = grid_candidates(problem.lower, problem.upper, self.per_axis)
        region = problem.scenario.keep_out
        return grid if region is None else grid[~region.contains(grid)]

    def place(self, problem: Problem) -> Tensor:
        """[1, m, d]."""
        design = problem.scenario.half()
        centers = ols(
            kernel_columns(design.vertices, problem.kernel),
            self._candidates(problem),
            design.gradient,
            problem.centers,
            weights=design.weights,
        ).centers
        return problem.parameterization.settle(centers)[None]
