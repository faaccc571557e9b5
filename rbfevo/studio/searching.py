"""The search behind the page: it scores all setups that it knows on a new field at once, and then improves them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import hydra
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.arrays import Array, Points, Triangles
from rbfevo.commands.overrides import initialized
from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.meshes import foreign, vtk_datasets
from rbfevo.methods.gradient.search import GradientSearch
from rbfevo.recorded.record import Record
from rbfevo.runs.assembly import Parts
from rbfevo.runs.config import CONF, check
from rbfevo.runs.storage import scenario_arrays
from rbfevo.runs.summary import of_parts
from rbfevo.scoring.pareto import hypervolume, well_spread
from rbfevo.scoring.threads import coarse
from rbfevo.studio.choices import FIELD, HELD, Choices, overrides

DRAWN = 100  # random setups that are scored where no setup is known yet
KEPT = 100  # setups of the front that are kept
OFTEN = 1.0  # seconds between two fronts of one search
ROUNDING = 1e-12  # of the diagonal: a setup that is moved by less stays as it is
NAME = "studio"  # the method in the record of a front


class Task(NamedTuple):
    """A painted field to find setups for.

    Attributes:
        number: of the task; wanted: [n, 3] the painted field, model units; held: [n] vertices that must stay.
        choices: what is searched; known: [p, m, 3] setups to begin with, or None for those of the task before.
    """

    number: int
    wanted: Points
    held: NDArray[np.bool_]
    choices: Choices
    known: Array | None = None


class Front(NamedTuple):
    """The front of a task so far.

    Attributes:
        number: of the task; step, steps: how far its search is, 0 where known setups were scored anew.
        record: as a run directory would be read, with the setups of the front by rising regularity.
        hypervolume: of the front, with reference (0, 0); evaluations, failed: of the task so far.
    """

    number: int
    step: int
    steps: int
    record: Record
    hypervolume: float
    evaluations: int
    failed: int

    @property
    def settled(self) -> bool:
        """Whether the search has come to its end."""
        return self.step == self.steps


class Search:
    """Setups for one painted field after the other; with what it has found for the last one it begins the next.

    Args:
        vertices: [n, 3] model units; triangles: [f, 3]; file: where the painted mesh is written for a run to read.
    """

    def __init__(self, vertices: Points, triangles: Triangles, file: Path) -> None:
        self._vertices, self._triangles, self._file = vertices, triangles, file
        self._parts: Parts | None = None
        self._key: tuple[object, ...] | None = None
        self._known: Tensor | None = None
        self._objectives = torch.empty(0, 2, dtype=torch.float64)
        self._arrays: dict[str, Array] = {}

    def prepare(self, choices: Choices) -> None:
        """Build the design with its normals as the field, so that the first stroke does not wait for that.

        Raises:
            UserError: if the mesh or the choices cannot be searched.
        """
        normals = topology.vertex_normals(self._vertices, self._triangles)
        parts = self._of(Task(0, normals, np.zeros(len(normals), bool), choices))
        parts.full_evaluator(parts.space.place(parts.space.sample(2, torch.Generator().manual_seed(0))))

    def take(self, task: Task) -> Front:
        """Score all setups that are known, or random ones, on the field of a task.

        Raises:
            UserError: if the field or the choices cannot be searched.
        """
        with coarse():
            parts = self._of(task)
            known = self._known if task.known is None else torch.from_numpy(task.known.copy())
            space, generator = parts.space, torch.Generator().manual_seed(parts.settings.seed)
            if known is None or known.shape[1:] != space.lower.shape:
                known = space.place(space.sample(DRAWN, generator))
            else:
                known = self._where_allowed(known, parts)
            self._keep(known, parts.full_evaluator(known).objectives)
            return self._front(task, 0, 1)

    def improve(self, task: Task, stop: Callable[[], bool] = lambda: False) -> Iterator[Front]:
        """Climb from the setups of `take` on; yields the front about every second, and at the end.

        Args:
            stop: asked after each step whether to end early.
        """
        parts = self._parts
        if parts is None or self._known is None:
            return
        with coarse():
            problem, method = parts.problem(), parts.stages[0]
            if not isinstance(method, GradientSearch):
                raise TypeError("the studio searches by gradients")
            method.inputs = self._known[well_spread(self._objectives, method.population // 8)]
            method.start(problem)
            known, objectives = self._known, self._objectives
            if problem.evaluate is not parts.full_evaluator:
                objectives = problem.evaluate(known).objectives
            last = time.monotonic()
            for step in range(1, method.steps + 1):
                method.step()
                if stop():
                    return
                settled = step == method.steps
                if not settled and time.monotonic() - last < OFTEN:
                    continue
                found = torch.cat([rows.centers for rows in method.rows()])
                if settled:
                    whole = torch.cat([known, found])
                    self._keep(whole, parts.full_evaluator(whole).objectives)
                else:
                    scores = problem.evaluate(found).objectives
                    self._keep(torch.cat([known, found]), torch.cat([objectives, scores]))
                yield self._front(task, step, method.steps)
                last = time.monotonic()

    def _of(self, task: Task) -> Parts:
        """The parts of a run for a task; the design is read again only where more than the field has changed."""
        key = task.held.tobytes(), task.choices
        if self._parts is None or key != self._key:
            write_mesh(self._file, self._vertices, self._triangles, task.wanted, task.held)
            arguments = task.choices.arguments(self._file, len(task.wanted), bool(task.held.any()))
            with initialized(CONF):
                settings = check(
                    hydra.compose("config", overrides=overrides([*arguments, "method=gradient"])), arguments
                )
            parts = Parts(settings)
        else:
            scenario = self._parts.scenario.wanting(torch.from_numpy(task.wanted.copy()))
            parts = Parts(self._parts.settings, scenario=scenario)
        self._parts, self._key = parts, key
        self._arrays = {name: value for name, value in scenario_arrays(parts.scenario).items() if name != "rows"}
        return parts

    @staticmethod
    def _where_allowed(known: Tensor, parts: Parts) -> Tensor:
        """Setups [p, m, 3], moved where symmetry, box and held regions do not let them be; others to the bit as are."""
        space = parts.space
        placed = space.place(known.clamp(space.lower, space.upper))
        stays = (placed - known).abs().amax((1, 2)) <= ROUNDING * parts.scenario.diagonal
        return torch.where(stays[:, None, None], known, placed)

    def _keep(self, setups: Tensor, objectives: Tensor) -> None:
        """Keep the front of setups with objectives [p, 2], by rising regularity."""
        rows = well_spread(objectives, KEPT)
        self._known, self._objectives = setups[rows], objectives[rows]

    def _front(self, task: Task, step: int, steps: int) -> Front:
        """What is known now, as a front of a task."""
        parts, known = self._parts, self._known
        if parts is None or known is None:
            raise UserError("nothing has been searched yet")
        p = len(known)
        record = Record(
            centers=known.numpy().copy(),
            regularity=self._objectives[:, 0].numpy().copy(),
            improvement_potential=self._objectives[:, 1].numpy().copy(),
            method=np.full(p, NAME),
            preference=np.full(p, np.nan),
            nondominated=np.ones(p, bool),
            summary=of_parts(parts),
            **self._arrays,
        )
        evaluators = {id(one): one for one in (parts.full_evaluator, parts.evaluator, *parts.coarse_evaluators)}
        counts = [(one.evaluations, one.failed_evaluations) for one in evaluators.values()]
        volume = hypervolume(self._objectives)
        return Front(task.number, step, steps, record, volume, *(sum(column) for column in zip(*counts, strict=True)))


def write_mesh(
    path: Path, vertices: Points, triangles: Triangles, field: Points, held: NDArray[np.bool_], **arrays: Array
) -> None:
    """Write a painted mesh (VTP): its field [n, 3] and its held marks [n] as point arrays, and others.

    Raises:
        UserError: if it cannot be written.
    """
    marks = {FIELD: field, HELD: held.astype(np.float64), **arrays}
    foreign.write_dataset(vtk_datasets.polydata(vertices, triangles, marks), path)
