"""An evolution strategy on the parameters of setups, on the bracket, whose solver takes a second: docs/solver-es.csv.

pycma's CMA-ES as it comes (population 4 + 3 ln N), from no displacement, with the parameters of direct manipulation and
a step size of half a step of the descents. A mesh that cannot follow counts as an evaluation, and is worst.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.solver.design import MeshError
from benchmarks.solver.elastic import Elastic
from benchmarks.solver.plan import Chosen
from rbfevo.recorded.parameters import Parameters

EVALUATIONS, SEEDS = 300, (1, 2, 3)


def searched(case: Elastic, chosen: Chosen, step: float, seed: int, at: Path) -> list[dict[str, Any]]:
    """A line for each evaluation: the best objective so far.

    Args:
        step: of a descent, model units; at: a directory for the solver.
    """
    import cma

    parameters = Parameters(chosen.setup, 3, None)
    options = {"seed": seed, "maxfevals": EVALUATIONS, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.zeros(len(parameters)), 0.5 * step, options)
    best, lines = case.start.objective, []
    while len(lines) < EVALUATIONS:
        asked, values = strategy.ask(), []
        for vector in asked:
            try:
                found = case.solve(chosen.record, chosen.setup, parameters.weights(np.asarray(vector)), at).objective
            except MeshError:
                found = np.inf
            values.append(found)
            best = min(best, found)
            lines.append({"evaluation": len(lines) + 1, "J": found, "best": best})
        worst = max((value for value in values if np.isfinite(value)), default=case.start.objective)
        strategy.tell(asked, [value if np.isfinite(value) else worst + abs(case.start.objective) for value in values])
    return lines[:EVALUATIONS]
