"""The budgets: seeds, evaluations, generations, and the size of the fits."""

from __future__ import annotations

from typing import NamedTuple

from rbfevo.errors import UserError


class Budget(NamedTuple):
    """One budget of `scripts/reproduce`.

    Attributes:
        name: on the command line.
        seeds: of the random setups, of Lloyd and of NSGA-II's fronts.
        search_seeds: of CMA-ES and of the gradient search, whose results are not in the repository.
        evaluations: of NSGA-II for one front.
        computes_fronts: False uses only the fronts in `benchmarks/fronts` and leaves out missing ones.
        generations: of the (25,100)-CMA-ES for each preference.
        full: panels on which CMA-ES also gets the paper's 1,000 generations, for three preferences and the first seed.
        random: setups drawn at random for each panel and seed.
        fit_subdivisions: of the sphere that the fits deform.
        fit_generations: after which a fit is given up, on the plane and on the sphere.
        fit_seeds: of the fits' evolution strategies, on the plane and on the sphere.
        gradient: further Hydra overrides of the gradient search.
        plane, face: further Hydra overrides of each scenario, such as its size; none for the paper's scenario.
    """

    name: str
    seeds: tuple[int, ...]
    search_seeds: tuple[int, ...]
    evaluations: int
    computes_fronts: bool
    generations: int
    full: tuple[str, ...]
    random: int
    fit_subdivisions: int
    fit_generations: tuple[int, int]
    fit_seeds: tuple[int, int]
    gradient: tuple[str, ...] = ()
    plane: tuple[str, ...] = ()
    face: tuple[str, ...] = ()

    def overrides(self, scenario: str) -> tuple[str, ...]:
        """The further Hydra overrides of a scenario."""
        return {"plane": self.plane, "face": self.face}[scenario]

    @property
    def description(self) -> str:
        """The evaluations of each search and the overrides, for captions."""
        spent = f"NSGA-II {self.evaluations:,} evaluations, CMA-ES {self.generations * 100:,} for each preference"
        return "; ".join([spent, *self.gradient, *self.plane, *self.face])


FULL = (
    "face-triharmonic-direct",
    "plane-wendland-0.25-indirect",
    "plane-wendland-0.5-direct",
    "face-wendland-0.5-direct",
    "face-triharmonic-indirect",
)

BUDGETS = {
    budget.name: budget
    for budget in (
        Budget("quick", (0, 1, 2), (0,), 250_000, False, 20, (), 100, 3, (2_000, 300), (1, 1)),
        Budget("medium", (0, 1, 2), (0, 1, 2), 250_000, True, 100, FULL, 100, 4, (10_000, 500), (3, 1)),
        Budget("paper", (0, 1, 2), (0, 1, 2), 2_500_000, True, 1_000, (), 100, 4, (50_000, 2_000), (5, 3)),
    )
}


def budget_named(name: str) -> Budget:
    """The budget of that name.

    Raises:
        UserError: if there is none.
    """
    if name not in BUDGETS:
        raise UserError(f"--budget {name}: there is no such budget; choose one of {', '.join(BUDGETS)}")
    return BUDGETS[name]
