"""The solution of a deformed design, from a solver's files: sensitivity and objective, read as the run read its own."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbfevo import meshes
from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.meshes.openfoam import case_of, objective_of
from rbfevo.names import file_and_name
from rbfevo.recorded.record import Record
from rbfevo.scenarios.boundaries import field_of, sensitivity_of
from rbfevo.scenarios.design import Design
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.sensitivities import Convention, convention_in, nodal
from rbfevo.scenarios.templates import Template, read_template

SAME = 1e-6  # of the template's diagonal: vertices at one place
OF_STEP = 0.01  # of the last step: the same, where it is larger


class Solution(NamedTuple):
    """A solution.

    Attributes:
        sensitivity: [n, 3] dJ/dx, nodal; objective: J, None where it is not known.
        identity: the same for the same files; source: where the sensitivity is from, for the screen.
    """

    sensitivity: Array
    objective: float | None
    identity: str
    source: str


class Reader:
    """What reads the solutions of a run's deformed designs.

    Args:
        record: the run; keys: its settings below `scenario`.

    Raises:
        UserError: if the run is not of `scenario=mesh`, or does not say what its sensitivity means.
    """

    def __init__(self, record: Record, keys: dict[str, Any]) -> None:
        if record.summary.get("scenario") != "mesh":
            raise UserError(f"the scenario of this run is {record.summary.get('scenario')}; step needs scenario=mesh")
        self.record, self.keys = record, keys
        self.convention: Convention = convention_in(str(record.summary.get("notes", {}).get("sensitivity")))
        plane = record.summary.get("planar")
        self.axis = None if plane is None else str(plane["axis"])
        self.diagonal = float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
        self._known: dict[str, Template] = {}

    def template(self, path: str | Path) -> Template:
        """The template in a file or case; its vertices are those of any design."""
        if str(path) not in self._known:
            self._known[str(path)] = self._read(path)
        return self._known[str(path)]

    def _read(self, path: str | Path) -> Template:
        patches = self.keys.get("patches")
        named = None if patches is None else [patches] if isinstance(patches, str | int) else list(patches)
        read = read_template(path, None if named is None else [str(name) for name in named], self.axis is not None)
        if len(read.vertices) != len(self.record.vertices):
            raise UserError(
                f"{path} has {len(read.vertices)} vertices, the run has {len(self.record.vertices)}: it is another mesh"
            )
        return read

    def original(self) -> Template:
        """The run's own template.

        Raises:
            UserError: if it is not there any more, or is another one.
        """
        path = str(self.keys["template"])
        if meshes.is_case(Path(path)):
            raise UserError(f"the run's template is the OpenFOAM case {path}: give --case")
        read = self.template(path)
        away = _farthest(read.vertices, self.record.vertices)
        if away > SAME * self.diagonal:
            raise UserError(f"{path} has changed since the run: a vertex is {away:.3g} from where it was")
        return read

    def of_case(self, path: Path, source: str | None) -> Solution:
        """The solution in an OpenFOAM case, of its newest time with sensitivities.

        Args:
            source: the sensitivity, None for that of the run.
        """
        case = case_of(path)
        if case is None:
            raise UserError(f"--case {path}: it is no OpenFOAM case")
        template = self.template(path)
        field = source or self._field(template)
        if field is None:
            raise UserError(f"--case {path}: it has no sensitivities; solve it first")
        field = field_of(template, field)
        objective = objective_of(case, template.meanings[field].solver) if field in template.meanings else None
        identity = _identity([case.fields()[field]] if field in case.fields() else [], str(case.time), objective)
        return Solution(self._nodal(field, template), objective, identity, f"{field} of {path} at time {case.time}")

    def refuse_other(self, path: Path, design: Array, moved: float, advice: str = "") -> None:
        """Raise UserError if the vertices of a mesh are not those of a design [n, 3], with the largest distance.

        Args:
            moved: how far a vertex moved at most by the last step.
        """
        away = _farthest(self.template(path).vertices, design)
        if away > max(SAME * self.diagonal, OF_STEP * moved):
            advice = advice or (
                "it is not the design that waits for its solution"
                + (f"; the last step moved one by {moved:.3g}" * (moved > 0))
            )
            raise UserError(f"{path}: a vertex is {away:.3g} away from where it should be: {advice}")

    def of_file(
        self, source: str, original: Template, design: Array, objective: float | None, seen: Sequence[str]
    ) -> Solution | None:
        """The solution in a file or a quantity of one, as `scenario.sensitivity` takes it; None for one that is `seen`.

        Args:
            original: the run's template; design: [n, 3] where its vertices are now; objective: J.
            seen: identities of solutions.
        """
        path = Path(file_and_name(source)[0])
        if not path.is_file():
            raise UserError(f"--sensitivity {source}: no such file")
        identity = _identity([path], "", objective)
        if identity in seen:
            return None
        deformed = dataclasses.replace(original, vertices=design, arrays={}, cell_arrays={}, meanings={})
        try:
            found = self._nodal(source, deformed)
        except UserError as error:
            message = str(error).replace("scenario.sensitivity=", "", 1).removeprefix(f"{source}: ")
            message, other, _ = message.partition("; for values of another mesh")
            message += ": is this the solution of the design that waits for one?" * bool(other)
            raise UserError(f"--sensitivity {source}: {message}") from None
        return Solution(found, objective, identity, source)

    def _field(self, template: Template) -> str | None:
        """The array of a case that the run took."""
        asked = self.keys.get("sensitivity")
        name = str(asked) if isinstance(asked, str) else None
        known = {*template.arrays, *template.cell_arrays, *(one.solver for one in template.meanings.values())}
        return name if name in known else sensitivity_of(template)

    def _nodal(self, source: str, template: Template) -> Array:
        flat = Planar.of(self.axis, template.vertices, template.curve)
        design, _ = Design.of(template, str(self.keys.get("weights", "uniform")), flat)
        match = str(self.keys.get("sensitivity_match", "exact"))
        return nodal(source, self.convention, match, template, design.sides(template, flat), design.areas)


def objective_in(text: str) -> float:
    """J as a number, or the last number of a file.

    Raises:
        UserError: where there is none.
    """
    try:
        return float(text)
    except ValueError:
        pass
    path = Path(text)
    try:
        parts = path.read_text(encoding="utf-8", errors="replace").split()
    except OSError as error:
        raise UserError(f"--objective {text}: give a number, or a file with one ({error.strerror or error})") from None
    try:
        return float(parts[-1])
    except (ValueError, IndexError):
        raise UserError(f"--objective {text}: it does not end with a number") from None


def _farthest(vertices: Array, others: Array) -> float:
    away = float(np.linalg.norm(vertices - others, axis=1).max())
    return away if math.isfinite(away) else math.inf


def _identity(paths: list[Path], time: str, objective: float | None) -> str:
    """A digest of files' contents, of a time and of J."""
    digest = hashlib.sha256(f"{time} {objective!r}".encode())
    for path in paths:
        there = path if path.exists() else path.with_name(f"{path.name}.gz")
        digest.update(there.read_bytes())
    return digest.hexdigest()
