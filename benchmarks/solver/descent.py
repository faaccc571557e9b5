"""Descents with a setup on a solver: ten adjoint solutions of steps by one rule, with one bound of the displacement.

`rbfevo.descent` takes the steps: after a rise of J the next one starts from the best design and is half as long; so it
is where the volume mesh cannot follow, which costs no solution.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Protocol

from benchmarks.solver.design import MeshError, Solution
from rbfevo.arrays import Array
from rbfevo.descent import Descent, Line, State
from rbfevo.errors import UserError
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup

SOLUTIONS = 10


class Case(Protocol):
    """A solver with a design: `start` is the solution of the original one."""

    start: Solution

    def solve(self, record: Record, chosen: Setup, weights: Array, at: Path, before: Path | None = None) -> Solution:
        """The solution of a design, whose files go to the directory `at`; MeshError if there is none."""
        ...


def descend(case: Case, record: Record, chosen: Setup, rule: str, step: float, at: Path) -> list[dict[str, Any]]:
    """A line for each solution: J, the best J so far, the predicted change, the step, the quality of the mesh.

    Args:
        step: the largest displacement of a step, a fraction of the diagonal; at: a directory for the solver's files.
    """
    descent = Descent(record, chosen, State.begin((chosen.count, 3), rule, step, 0.0))
    lines = [_line(case.start, descent.accept(case.start.objective, case.start.sensitivity))]
    failed: list[str] = []
    before = None
    while len(lines) <= SOLUTIONS and (proposal := descent.propose()) is not None:
        own = at / str(len(lines))
        try:
            found = case.solve(record, chosen, proposal.weights, own, before)
        except (MeshError, UserError) as error:
            failed.append(descent.fail(str(error)).note)
            continue
        line = descent.accept(found.objective, found.sensitivity)
        if line.kept:
            if before is not None:
                shutil.rmtree(before)
            before = own
        else:
            shutil.rmtree(own)
        lines.append(_line(found, line) | {"solution": len(lines), "note": "; ".join(failed)})
        failed = []
    shutil.rmtree(at, ignore_errors=True)
    return lines


def _line(found: Solution, line: Line) -> dict[str, Any]:
    return {
        "solution": line.number,
        "J": found.objective,
        "best": line.best,
        "predicted": line.predicted or 0.0,
        "step": line.size,
        "non_orthogonality": found.orthogonality,
        "skewness": found.skewness,
        "note": "",
    }
