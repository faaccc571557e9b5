"""Descents with a setup on a solver: ten adjoint solutions of steps by one rule, with one bound of the displacement.

U stays on the original design, weights accumulate, sensitivities are taken anew on each design and smoothed as in the
run. After a rise of J the next step starts from the best design and is half as long; so it is where the volume mesh
cannot follow, which costs no solution.
"""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from benchmarks.solver.flow import MeshError, Solution
from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.moves import wanted_move
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup
from rbfevo.scenarios.smoothing import smoothed

SOLUTIONS, HALVINGS = 10, 6


class Case(Protocol):
    """A solver with a design: `start` is the solution of the original one."""

    start: Solution

    def solve(self, record: Record, chosen: Setup, weights: Array, at: Path, before: Path | None = None) -> Solution:
        """The solution of a design, whose files go to the directory `at`; MeshError if there is none."""
        ...


def looking_at(record: Record, sensitivity: Array) -> Record:
    """A run's record with another sensitivity [n, 3], nodal dJ/dx of the objective to be minimized."""
    held = np.zeros(len(sensitivity), bool) if record.blend is None else record.blend == 0.0
    raw = -sensitivity / record.weights[:, None]
    raw[held] = 0.0
    length = float(record.summary["smooth"])
    g = smoothed(raw, record.vertices, record.faces, record.weights, held, length, True).wanted
    norm = float(np.sqrt((record.weights[:, None] * g**2).sum()))
    summary = {**record.summary, "gradient_is": "direction", "objective": "minimize", "gradient_norm": norm}
    return dataclasses.replace(record, gradient=g / norm, gradient_raw=raw / norm, summary=summary)


def descend(case: Case, record: Record, chosen: Setup, rule: str, step: float, at: Path) -> list[dict[str, Any]]:
    """A line for each solution: J, the best J so far, the predicted change, the step, the quality of the mesh.

    Args:
        step: the largest displacement of a step, a fraction of the diagonal; at: a directory for the solver's files.
    """
    best, weights, here = case.start, np.zeros((chosen.count, 3)), looking_at(record, case.start.sensitivity)
    lines: list[dict[str, Any]] = [_line(0, best, best, 0.0, 0.0)]
    halved, failed, before = 0, "", None
    while len(lines) <= SOLUTIONS and halved < HALVINGS:
        size = step / 2**halved
        try:
            move = wanted_move(here, chosen, size, rule)
            number = len(lines)
            found = case.solve(record, chosen, weights + move.weights, at / str(number), before)
        except (MeshError, UserError) as error:
            halved, failed = halved + 1, str(error)
            continue
        if np.isfinite(found.objective) and found.objective < best.objective:
            best, weights, here = found, weights + move.weights, looking_at(record, found.sensitivity)
            if before is not None:
                shutil.rmtree(before)
            before = at / str(number)
        else:
            halved += 1
            shutil.rmtree(at / str(number))
        lines.append(_line(number, found, best, move.change or 0.0, size) | {"note": failed})
        failed = ""
    shutil.rmtree(at, ignore_errors=True)
    return lines


def _line(number: int, found: Solution, best: Solution, predicted: float, size: float) -> dict[str, Any]:
    return {
        "solution": number,
        "J": found.objective,
        "best": best.objective,
        "predicted": predicted,
        "step": size,
        "non_orthogonality": found.orthogonality,
        "skewness": found.skewness,
        "note": "",
    }
