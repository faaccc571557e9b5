"""What `rbfevo.step` does with files: the state, the solution of the last design, and the mesh of the next one."""

from __future__ import annotations

import argparse
import copy
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo import meshes
from rbfevo.arrays import Array
from rbfevo.commands import adapting, center_rows
from rbfevo.commands.following import Follower
from rbfevo.commands.solutions import Reader, Solution, objective_in
from rbfevo.descent import Descent, Line, State, files, sensitivity
from rbfevo.descent.loop import RULES, TOLERANCE
from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.meshes.openfoam import case_of, times
from rbfevo.names import file_and_name
from rbfevo.recorded.moves import places_of, spatial
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup
from rbfevo.runs.source import settings_of
from rbfevo.scenarios.templates import Template

STEP = 0.01
WEIGHTS = "weights.csv"
KEPT = ("setup", "adapted", "seen", "waited", "outs")  # in state.json beside the state of the descent


class Stepping:
    """A call of `rbfevo.step`, in the lock of its state.

    Args:
        options: of the command line; record, chosen: the run and the setup that they name.

    Raises:
        UserError: if the state is not one of them, or cannot be read.
    """

    def __init__(self, options: argparse.Namespace, record: Record, chosen: Setup) -> None:
        self.options, self.where = options, options.state
        sensitivity.direction_of(record)
        self.run, self.record, self.chosen = options.run, record, chosen
        settings = settings_of(options.run)
        self.keys = settings.scenario
        self.reader = Reader(record, self.keys)
        self.warnings: list[str] = []
        found, own = files.read(self.where), _digest(record, chosen)
        if found is None:
            rule, step = options.rule or RULES[0], options.step or STEP
            tolerance = TOLERANCE if options.tolerance is None else options.tolerance
            state = State.begin((chosen.count, record.gradient.shape[1]), rule, step, tolerance)
            self.more: dict[str, Any] = {"setup": own, "adapted": [], "seen": [], "waited": 0, "outs": []}
        else:
            state, entries = found
            missing = [key for key in KEPT if key not in entries]
            if missing:
                raise UserError(
                    f"{self.where / files.FILE} lacks {', '.join(missing)}: damaged? Begin with another --state"
                )
            self.more = {key: entries[key] for key in KEPT}
            self._refuse_other(state, own)
            if self.more["adapted"]:
                self.run = self.where / self.more["adapted"][-1]["run"]
                self.record, self.chosen = adapting.adapted(self.run, self.more["adapted"][-1]["row"])
        self._before = state, copy.deepcopy(self.more)
        self._original: Template | None = None if options.case is not None else self.reader.original()
        self.descent = Descent(self.record, self.chosen, state, self._template().segments)

    @property
    def state(self) -> State:
        """Where the descent is."""
        return self.descent.state

    @property
    def moves(self) -> bool:
        """Whether the best design wants to move anywhere."""
        return self.state.best is not None and bool(self.state.best.sensitivity.any())

    @property
    def out(self) -> Path:
        """Where the next mesh goes: --out, or the newest time of the case."""
        if self.options.out is not None:
            return self.options.out
        root = self._case_root()
        named = times(root)
        return root / (named[-1] if named else "0")

    def solution(self) -> Solution | None:
        """The solution of the design that waits for it; None where it is not there yet.

        Raises:
            UserError: if it is that of another design, or is incomplete.
        """
        options, proposal = self.options, self.state.proposal
        if proposal is None:  # killed between a solution and the next design
            return None
        design = self.record.vertices + self.descent.displacement(proposal.weights)
        given = None if options.objective is None else objective_in(options.objective)
        if options.case is not None:
            found = self._of_case(design, given)
        elif options.sensitivity is not None:
            found = self._of_file(design, given)
        elif self.state.best is None:
            found = Solution(sensitivity.own(self.record), given, f"the run's own {given!r}", "the run's own")
        else:
            found = None
        if found is None or found.identity in self.more["seen"]:
            return None
        if found.objective is None and self.state.best is not None:
            raise UserError("give --objective, J of the last design: it tells whether the step was good")
        if options.case is not None:
            self.reader.refuse_other(options.case, design, proposal.moved)
        return found

    def accept(self, solution: Solution) -> list[str]:
        """Take a solution; return lines on it."""
        line = self.descent.accept(solution.objective, solution.sensitivity)
        self.more["seen"].append(solution.identity)
        self.more["waited"] = 0
        lines = [f"design {line.number}: {solution.source}", *_report(line)]
        if not line.kept:
            lines.append(self._back())
        return lines

    def fail(self) -> str:
        """Go back; return a line on it."""
        line = self.descent.fail("the solver failed")
        self.more["waited"] = 0
        return f"design {line.number}: the solver failed; {self._back()}"

    def wait(self) -> tuple[int, bool]:
        """Write the mesh of the design that waits for its solution again; its number, and whether it did before."""
        proposal, again = self.state.proposal, bool(self.more["waited"])
        if proposal is None:
            raise UserError("no design waits for a solution")
        if not again:
            with meshes.opened(self._mesh()) as mesh:
                self._write(self._follower(mesh), proposal.weights)
            self.more["waited"] = 1
            self._save()
        return proposal.number, again

    def adapt(self, count: int) -> list[str]:
        """Search more centers, where the setup reaches too little of the sensitivity; return lines on it."""
        found = adapting.adapt(self.descent, self.run, self.options.pick, self.where, len(self.more["adapted"]), count)
        if found.run is not None:
            self.record, self.chosen, self.run = found.record, found.chosen, self.where / found.run
            self.descent = Descent(self.record, self.chosen, found.state, self._template().segments)
            self.more["adapted"].append({"run": found.run, "row": found.chosen.row})
        else:
            self.descent.state = found.state
        return found.lines

    def propose(self) -> list[str]:
        """Write the mesh of the next design, or at the end of the best one; return lines on it."""
        with meshes.opened(self._mesh()) as mesh:
            follower = self._follower(mesh)
            proposal, best = self.descent.propose(follower.unusable), self.state.best
            if best is None:
                raise UserError("the original design has no solution yet")
            weights = best.weights if proposal is None else proposal.weights
            notes = self._write(follower, weights)
        if proposal is None:
            return [f"the descent has ended: {self.state.ended}", self.best_line(), *notes]
        change = "" if proposal.predicted is None else f"; predicted change {proposal.predicted:+.4g} (to first order)"
        return [
            *(f"shorter step: {note}" for note in proposal.notes),
            f"design {proposal.number}: {self.state.rule} step of at most {proposal.size:.3g} of the diagonal, "
            f"a vertex moves by at most {proposal.moved:.4g}{change}",
            *notes,
        ]

    def best_line(self) -> str:
        """A line on the best design."""
        best = self.state.best
        if best is None:
            return ""
        value = "" if best.objective is None else f": J = {best.objective:.8g}"
        return f"the best design is {best.number}{value}"

    def _of_file(self, design: Array, given: float | None) -> Solution | None:
        return self.reader.of_file(self.options.sensitivity, self._template(), design, given, self.more["seen"])

    def _of_case(self, design: Array, given: float | None) -> Solution | None:
        options = self.options
        if options.sensitivity is not None and Path(file_and_name(options.sensitivity)[0]).is_file():
            return self._of_file(design, given)
        found = self.reader.of_case(options.case, options.sensitivity)
        return found if given is None else found._replace(objective=given)

    def _back(self) -> str:
        best = self.state.best
        return "" if best is None else f"back to design {best.number}, with half the step"

    def _template(self) -> Template:
        """The template of the run: connectivity and order; of a case its vertices may be those of any design."""
        if self._original is None:
            self._original = self.reader.template(self.options.case)
        return self._original

    def _mesh(self) -> Path:
        """The mesh that is deformed."""
        if self.options.mesh is not None:
            return self.options.mesh
        if self.options.case is None:
            return Path(str(self.keys["template"]))
        path = self._case_root() / "constant"
        self.reader.refuse_other(path, self.record.vertices, 0.0, "it is not the run's own design; give that as --mesh")
        return path

    def _case_root(self) -> Path:
        case = case_of(self.options.case)
        if case is None:
            raise UserError(f"--case {self.options.case}: it is no OpenFOAM case")
        return case.root

    def _follower(self, mesh: meshes.Mesh) -> Follower:
        options = self.options
        return Follower(self._mesh(), mesh, self.record, self.chosen, options.volume, options.design, options.slip)

    def _write(self, follower: Follower, weights: Array) -> list[str]:
        """Write a mesh, the weights and the state, in this order; return lines on it.

        A call that is killed before the state is written does the same again.
        """
        out, source = self.out, follower.path
        self._refuse_out(source, out)
        displacement = follower.displacement(weights)
        if (
            follower.mesh.dimension == 2
            and meshes.ending_of(out) not in meshes.CONVERSIONS
            and displacement[:, 2].any()
        ):
            raise UserError(f"{source}: its points have no z coordinate, but the setup moves them along z")
        if str(out) not in self.more["outs"]:
            self.more["outs"].append(str(out))
            self._before[1]["outs"] = list(self.more["outs"])
            files.write(self.where, *self._before)
        notes = meshes.write(follower.mesh, source, follower.mesh.points + displacement, displacement, out)
        rows = center_rows.numbered(["wx", "wy", "wz"], spatial(places_of(self.chosen)), spatial(weights))
        write_whole(self.where / WEIGHTS, rows)
        self.warnings += follower.warnings(displacement)
        self._save()
        return [*(f"note: {note}" for note in notes), follower.quality(displacement), f"written: {out}"]

    def _refuse_out(self, source: Path, out: Path) -> None:
        """Raise UserError if a mesh cannot or must not be written to a place."""
        meshes.refuse_ending(source, out)
        written = out / "polyMesh" / "points" if meshes.is_case(source) else out
        if written.exists() and str(out) not in self.more["outs"]:
            raise UserError(f"{written} already exists, and not from this descent: choose another --out, or remove it")
        if not out.parent.is_dir():
            raise UserError(f"--out {out}: the directory {out.parent} does not exist; create it first")

    def _save(self) -> None:
        files.write(self.where, self.state, self.more)

    def _refuse_other(self, state: State, own: str) -> None:
        """Raise UserError where the command line is not that of the state."""
        if self.more["setup"] != own:
            raise UserError(f"--state {self.where}: it is of another run or pick; begin with another --state")
        for name, value in (("rule", state.rule), ("step", state.step), ("tolerance", state.tolerance)):
            asked = getattr(self.options, name)
            if asked is not None and asked != value:
                raise UserError(f"--{name} {asked}: this descent began with {value}; leave it out, or begin another")


def _report(line: Line) -> Iterator[str]:
    """Lines on what became of a design."""
    if line.objective is None:
        yield "J is not known"
        return
    yield f"J = {line.objective:.8g}"
    if line.real is None:
        return
    predicted = "" if line.predicted is None else f"predicted {line.predicted:+.4g}, "
    ratio = "" if not line.predicted else f" (real / predicted {line.real / line.predicted:.2f})"
    yield f"change by the last step: {predicted}real {line.real:+.4g}{ratio}" + ("" if line.kept else "; " + line.note)


def _digest(record: Record, chosen: Setup) -> str:
    """What tells a setup of a run from another one."""
    digest = hashlib.sha256()
    for array in (record.vertices, record.gradient, chosen.centers, chosen.genotype):
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
