"""Fits of many setups at once: one evolution strategy each, until the error is close to its optimum."""

from __future__ import annotations

import dataclasses
import math
from array import array
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.choices import FIT_STRATEGIES as STRATEGIES
from rbfevo.choices import refuse_others
from rbfevo.errors import UserError
from rbfevo.fit.manipulations import deformation
from rbfevo.fit.objective import Objective, Optimum, Pairs
from rbfevo.methods.cmaes.algorithm import CMAES
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.representations import Representation

FIRST_STEP = 0.3  # of the wanted displacement: about how far a first offspring moves the design


@dataclasses.dataclass(frozen=True)
class Fit:
    """How the fit of one setup went; errors are those of the strategy's mean, in squared model units, minimized.

    Attributes:
        stop: `reached`, `generations` (the cap), `stopped` (from outside), or `not fitted: ...` with the reason.
        generations: until the error was within reach of the optimum, or until the fit stopped.
        evaluations: offspring scored.
        start_error: that of the undeformed design; optimum: the least there is; error: the last.
        optimum_iterations: how often closest points were looked up for the optimum; 0 if it was given.
        parameters: [m, k], of that error.
        errors, steps: [generations + 1] error and step size (unit of the parameters) by generation, the start first.
        regularity, improvement_potential: R and P of the setup under its manipulation.
    """

    stop: str
    generations: int
    evaluations: int
    start_error: float
    optimum: float
    error: float
    optimum_iterations: int
    parameters: Tensor
    errors: NDArray[np.float64]
    steps: NDArray[np.float64]
    regularity: float
    improvement_potential: float

    @property
    def reached(self) -> bool:
        """Whether the error came within reach of the optimum."""
        return self.stop == "reached"


def fits(
    scenario: Scenario,
    kernel: Kernel | Representation,
    centers: Tensor,
    manipulation: str | Sequence[str] = "indirect",
    strategy: str = "isotropic",
    *,
    generators: Sequence[torch.Generator],
    generations: int = 5000,
    within: float = 0.05,
    smoothness: float = 0.0,
    parents: int = 25,
    population: int = 100,
    optima: Tensor | None = None,
    report: Callable[[int, int, float], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> list[Fit]:
    """Fit the design to its target from each of B setups, by (parents, population) evolution strategies from P = 0.

    The error (`Objective`) is minimized. A fit has reached it once the error of the strategy's mean is at most
    1 + within times the optimum. A first offspring moves the design by 0.3 of the wanted displacement, |t|_F, whatever
    the unit of the parameters is. All offspring of a generation are scored with the closest points of its mean. The
    steps of an element depend on its setup, settings and generator alone, up to rounding.

    Args:
        scenario, kernel: the design, what it should become, and phi, or another representation, which a run has made.
        centers: [B, m, d], model units, or other setups [B, D].
        manipulation: one of `MANIPULATIONS`, or one for each setup.
        strategy: `isotropic` (only the step size adapts) or `cmaes`.
        generators: B generators, on the host.
        generations: cap.
        within: of the optimum, at least 0.
        smoothness: weight of the umbrella Laplacian term (targets with closest points only).
        optima: [B] the least errors where they are known already (`Objective.optimum`; no manipulation changes them).
        report: called with (generation, elements running, their largest error / optimum) after each generation.
        stop: all fits end where it returns true.

    Returns:
        B fits. Setups that cannot be fitted have `stop` "not fitted: ...", no generations, and NaN everywhere else.

    Raises:
        UserError: for settings out of range or shapes that do not fit.
    """
    scenario = scenario.to(torch.device("cpu"))
    centers = centers.detach().to("cpu", torch.float64)
    manipulations = _checked(scenario, kernel, centers, manipulation, strategy, len(generators), generations, within)
    facts: dict[int, tuple[float, float]] = {}
    failures: dict[int, str] = {}

    def matrices() -> Iterator[Tensor]:
        for b, name in enumerate(manipulations):
            try:
                found = deformation(scenario, kernel, centers[b], name)
            except UserError as error:
                failures[b] = f"not fitted: {error}"
                continue
            facts[b] = found.regularity, found.improvement_potential
            yield found.U

    objective = Objective(scenario, matrices(), smoothness)
    m = kernel.parameters(centers) if isinstance(kernel, Representation) else centers.shape[1]
    k = scenario.gradient.shape[1]
    results = {b: _failed(reason, m, k) for b, reason in failures.items()}
    if facts:
        rows = list(facts)
        settings = {"parents": parents, "offspring": population, "covariance": strategy == "cmaes"}
        if optima is None:
            optimum = objective.optimum(stop=stop)
        else:
            known = optima.to("cpu", torch.float64)[rows]
            optimum = Optimum(known, torch.empty(0), torch.zeros(len(rows), dtype=torch.int64))
        fitting = _Fitting(objective, optimum, [generators[b] for b in rows], k, **settings)
        while fitting.step(generations, within, stop):
            if report is not None:
                report(fitting.generation, len(fitting.running), fitting.ratio)
        results |= {b: fitting.fit(i, population, *facts[b]) for i, b in enumerate(rows)}
    return [results[b] for b in range(len(centers))]


class _Fitting:
    """The fits of all setups that can be fitted; a strategy's coordinates are parameters over their first step size."""

    def __init__(
        self,
        objective: Objective,
        optimum: Optimum,
        generators: list[torch.Generator],
        k: int,
        *,
        covariance: bool,
        **sizes: int,
    ) -> None:
        A, m = objective.T.shape[:2]
        self.objective, self.k, self.m = objective, k, m
        self.scale = FIRST_STEP * objective.wanted / (objective.size * math.sqrt(k))  # [A]
        infinite = torch.full((k * m,), math.inf, dtype=torch.float64)
        start = torch.zeros(A, k * m, dtype=torch.float64)
        self.search = CMAES(
            start, 1.0, -infinite, infinite, generators=generators, covariance=covariance,
            parents=sizes["parents"], offspring=sizes["offspring"],
        )  # fmt: skip
        self.optimum = optimum
        self.running = list(range(A))
        self.errors, self.steps = [array("d") for _ in range(A)], [array("d") for _ in range(A)]
        self.stops = [""] * A
        self.parameters = torch.zeros(A, m, k, dtype=torch.float64)
        self.ratio = math.nan
        self._goal = self.optimum.error
        self._pairs = self._look()

    @property
    def generation(self) -> int:
        return self.search.generation

    def _decoded(self, genotypes: Tensor) -> Tensor:
        """Genotypes [A, *pop, k m] -> parameters [A, *pop, m, k]; the columns of P lie one after the other."""
        scale = self.scale.reshape(-1, *(1,) * (genotypes.ndim - 1))
        return (genotypes * scale).unflatten(-1, (self.k, self.m)).mT

    def _look(self) -> Pairs:
        """Look up closest points for the means, and record their errors."""
        mean = self._decoded(self.search.mean)
        pairs = self.objective.pairs(self.objective.T @ mean)
        self.parameters[self.running] = mean
        lines = zip(self.running, pairs.error.tolist(), (self.search.sigma * self.scale).tolist(), strict=True)
        for i, error, step in lines:
            self.errors[i].append(error)
            self.steps[i].append(step)
        return pairs

    def step(self, generations: int, within: float, stop: Callable[[], bool] | None) -> bool:
        """Remove the elements that are done and carry out one generation of the others; False if there are none."""
        reached = self._pairs.error <= (1 + within) * self._goal
        ended = "generations" if self.generation >= generations else "stopped" if stop is not None and stop() else ""
        done = torch.ones_like(reached) if ended else reached
        if bool(done.any()):
            for i, here, over in zip(self.running, reached.tolist(), done.tolist(), strict=True):
                if over:
                    self.stops[i] = "reached" if here else ended
            self._retain(~done)
        if not self.running:
            return False
        offspring = self._decoded(self.search.ask())
        self.search.tell(-self.objective.errors(offspring, self._pairs))
        self._pairs = self._look()
        self.ratio = float((self._pairs.error / self._goal).max())
        return True

    def _retain(self, elements: Tensor) -> None:
        self.running = [i for i, kept in zip(self.running, elements.tolist(), strict=True) if kept]
        self.search.retain(elements)
        self.objective = self.objective.select(elements)
        self.scale, self._goal = self.scale[elements], self._goal[elements]
        self._pairs = Pairs(*(part[elements] for part in self._pairs))

    def fit(self, i: int, population: int, regularity: float, potential: float) -> Fit:
        """The result of element `i`."""
        generations = len(self.errors[i]) - 1
        return Fit(
            stop=self.stops[i],
            generations=generations,
            evaluations=generations * population,
            start_error=self.errors[i][0],
            optimum=float(self.optimum.error[i]),
            error=self.errors[i][-1],
            optimum_iterations=int(self.optimum.iterations[i]),
            parameters=self.parameters[i].clone(),
            errors=np.array(self.errors[i]),
            steps=np.array(self.steps[i]),
            regularity=regularity,
            improvement_potential=potential,
        )


def _failed(reason: str, m: int, k: int) -> Fit:
    none, nan = np.empty(0), math.nan
    parameters = torch.full((m, k), nan, dtype=torch.float64)
    return Fit(reason, 0, 0, nan, nan, nan, 0, parameters, none, none, nan, nan)


def _checked(
    scenario: Scenario,
    kernel: Kernel | Representation,
    centers: Tensor,
    manipulation: str | Sequence[str],
    strategy: str,
    generators: int,
    generations: int,
    within: float,
) -> list[str]:
    """The manipulation of each setup; UserError for the first setting that is wrong."""
    d = scenario.vertices.shape[1]
    if isinstance(kernel, Representation):
        kernel.refuse(centers, d)
    elif centers.ndim != 3 or centers.shape[2] != d:
        raise UserError(f"centers must have shape [B, m, {d}], not {list(centers.shape)}")
    refuse_others("strategy", strategy, STRATEGIES)
    if generations < 0:
        raise UserError(f"generations={generations}: give a number of at least 0")
    if not (math.isfinite(within) and within >= 0):
        raise UserError(f"within={within}: give a number of at least 0")
    names = [manipulation] * len(centers) if isinstance(manipulation, str) else list(manipulation)
    if len(names) != len(centers) or generators != len(centers):
        raise UserError(
            f"{len(centers)} setups need one generator and one manipulation each, not {generators} and {len(names)}"
        )
    return names
