"""The objective of a case, as its adjoint solver writes it: optimisation/objective/TIME/NAME."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.openfoam.case import Case, times
from rbfevo.meshes.openfoam.dictionary import UNKNOWN, read_dictionary
from rbfevo.meshes.openfoam.meaning import DICTIONARY

FOLDER = Path("optimisation/objective")


def objective_of(case: Case, solver: str) -> float | None:
    """J of an adjoint solver: the weighted sum of its objectives, by the last lines that the newest start wrote.

    Returns:
        None where a value is missing, or optimisationDict does not say which objectives there are.
    """
    weights, started = _weights(case, solver), times(case.root / FOLDER)
    if not weights or not started:
        return None
    total = 0.0
    for name, weight in weights.items():
        value = _last(case.root / FOLDER / started[-1] / f"{name}{solver}")
        if value is None:
            return None
        total += weight * value
    return total


def _weights(case: Case, solver: str) -> dict[str, float]:
    """The weights of an adjoint solver's objectives by name; none where they are not known."""
    try:
        found = read_dictionary(case.root / DICTIONARY)
    except (OSError, FormatError, RecursionError):
        return {}
    for name, entries in _solvers(found.get("adjointManagers")):
        names = entries.get("objectives", {})
        names = names.get("objectiveNames") if isinstance(names, dict) else None
        if name == solver and isinstance(names, dict):
            try:
                return {str(key): float(one.get("weight", 1.0)) for key, one in names.items()}
            except (AttributeError, TypeError, ValueError):
                return {}
    return {}


def _solvers(managers: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    for manager in managers.values() if isinstance(managers, dict) else ():
        solvers = manager.get("adjointSolvers") if isinstance(manager, dict) else None
        for name, entries in solvers.items() if isinstance(solvers, dict) else ():
            if isinstance(entries, dict) and UNKNOWN not in (name, entries):
                yield str(name), entries


def _last(path: Path) -> float | None:
    """The second number of the last line with two."""
    try:
        lines = path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return None
    for line in reversed(lines):
        found = re.fullmatch(r"\s*\S+\s+(\S+).*", line)
        if found and not line.lstrip().startswith("#"):
            try:
                value = float(found[1])
            except ValueError:
                return None
            return value if math.isfinite(value) else None
    return None
