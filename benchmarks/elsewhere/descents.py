"""Descents on the true objective with a setup: ten steps of one rule, all of the same largest displacement.

U stays on the original mesh, displacements accumulate, and the sensitivities are taken anew on the deformed mesh. No
step is refused: a reduction is that of the best design so far.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from benchmarks.elsewhere.cases import Case
from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.moves import wanted_move
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup

AFTER = (1, 4, 10)  # iterations


def at(case: Case, record: Record, displacement: Array) -> tuple[float, Record]:
    """J of a displaced design [n, k], and the record with its sensitivity in place of the run's."""
    J, s = case.sensitivity(displacement)
    g = -s / record.weights[:, None]
    norm = float(np.sqrt((record.weights[:, None] * g**2).sum())) or 1.0
    summary = {**record.summary, "gradient_is": "direction", "objective": "minimize", "gradient_norm": norm}
    summary["smooth"] = None  # the rule `natural` is the projection
    return J, dataclasses.replace(record, gradient=g / norm, gradient_raw=None, summary=summary)


def descend(case: Case, record: Record, chosen: Setup, rule: str, reach: float) -> dict[str, float]:
    """The reductions of J in percent after 1, 4 and 10 iterations, and the real over the predicted first gain.

    NaN where a rule does not work for a setup (steepest descent where Psi is singular).

    Args:
        reach: the largest displacement of all iterations, if they all went the same way, model units.
    """
    step = reach / AFTER[-1] / float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    u = np.zeros((len(case.vertices), case.components))
    start, here = at(case, record, u)
    best, ratio, found = start, np.nan, {}
    for iteration in range(1, AFTER[-1] + 1):
        try:
            move = wanted_move(here, chosen, step, rule)
        except UserError:
            return {**{f"after_{count}": np.nan for count in AFTER}, "ratio": np.nan}
        u = u + move.reached
        J, here = at(case, record, u)
        if iteration == 1 and move.change:
            ratio = (start - J) / -move.change
        best = min(best, J) if np.isfinite(J) else best
        if iteration in AFTER:
            found[f"after_{iteration}"] = 100.0 * (1.0 - best / start)
        if not np.isfinite(here.gradient).all():
            break
    return {**{f"after_{count}": 100.0 * (1.0 - best / start) for count in AFTER}, **found, "ratio": ratio}


def least_squares(case: Case, record: Record, chosen: Setup) -> float:
    """The reduction of J in percent by the best approximation of the target, of any size."""
    start = case.sensitivity(np.zeros((len(case.vertices), case.components)))[0]
    return 100.0 * (1.0 - case.sensitivity(wanted_move(record, chosen, 0.0).reached)[0] / start)
