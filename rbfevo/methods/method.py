"""What a method is to a run: it starts, takes one step after the other, and has at any time what it has found."""

from __future__ import annotations

import abc
import dataclasses
import math
import zlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.evolvability import Scores
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.pareto import hypervolume
from rbfevo.scoring.representations import Representation, Space, beginning_with


class Rows(NamedTuple):
    """Setups of one method with their scores.

    Attributes:
        centers: [p, m, d], or other setups [p, *setup]; scores: [p]; preference: [p], NaN where there is none.
        labels: a name for each setup, or none at all.
        picked: of a method that places one center after the other, [m, d] in that order, before a setup is made of
            them; or None.
    """

    method: str
    centers: Tensor
    scores: Scores
    preference: Tensor
    labels: Sequence[str] = ()
    picked: Tensor | None = None


class HistoryLine(NamedTuple):
    """One line of the history; hypervolume with reference (0, 0), the best values so far are maximized."""

    method: str
    preference: float
    generation: int
    evaluations: int
    seconds: float
    hypervolume: float
    best_regularity: float
    best_improvement_potential: float
    failed_evaluations: int


@dataclasses.dataclass(frozen=True)
class Problem:
    """What methods are given: searches use scores, space and initial setups; heuristics scenario and representation.

    Attributes:
        evaluate: setups [*pop, *setup], of RBFs [*pop, m, d], -> Scores [*pop].
        space: the box that is searched, random setups, and what makes setups of points of the box.
        centers: m, centers a setup; kept: [k, d] those that every setup begins with and that stay.
        stream: name -> a generator that depends on the run's seed and that name alone.
        preferences: those asked for, or None.
        initial: the run's initial population, method `random`; empty if no method asked for one.
        scenario, representation: for heuristics.
        spectrum: setups [p, *setup], and perhaps what a spectrum of similar ones had as `near` -> singular values and P
            with gradients, for searches that climb.
        coarsened: count -> the same problem on at most so many weighted vertices.
        norm: p of the potential that is searched, 2 for improvement potential.
    """

    evaluate: Callable[[Tensor], Scores]
    space: Space
    centers: int
    stream: Callable[[str], torch.Generator]
    preferences: tuple[float, ...] | None
    initial: Rows
    scenario: Scenario
    representation: Representation
    spectrum: Callable[..., Spectrum]
    coarsened: Callable[[int], Problem]
    norm: float = 2.0
    kept: Tensor = dataclasses.field(default_factory=lambda: torch.empty(0, 0, dtype=torch.float64))

    @property
    def free(self) -> int:
        """m - k, the centers that a method places."""
        return self.centers - len(self.kept)

    @property
    def kept_on_one_side(self) -> Tensor | None:
        """The centers that stay [k, d], each on the side of the mirror, if any, on which others are placed; or None."""
        mirror = self.scenario.mirror
        if mirror is None or not len(self.kept):
            return self.kept if len(self.kept) else None
        other = self.scenario.side * (self.kept[:, mirror.axis] - mirror.at) < 0
        return torch.where(other[:, None], mirror.image(self.kept), self.kept)

    @property
    def flat_box(self) -> tuple[Tensor, Tensor]:
        """Corners [D] of the box of flat genotypes; of RBFs D = (m - k) d."""
        return self.space.lower.flatten(), self.space.upper.flatten()

    def unflatten(self, genotypes: Tensor) -> Tensor:
        """Genotypes [*pop, D] in the box -> setups [*pop, *setup]."""
        return self.space.place(genotypes.unflatten(-1, self.space.lower.shape))

    def flatten(self, setups: Tensor) -> Tensor:
        """Setups [p, *setup] that `unflatten` could have made -> their genotypes [p, D]."""
        return self.space.points(setups).flatten(1)

    def assembled(self, method: str, centers: Tensor) -> Tensor:
        """Setups [*pop, *setup] of centers [*pop, m - k, d] that a heuristic has placed beside those that stay.

        Raises:
            UserError: if the representation does not consist of centers.
        """
        settled = centers if self.representation.dims == 1 else self.scenario.parameterization.settle(centers)
        setups = self.representation.assemble(beginning_with(self.kept, settled) if len(self.kept) else settled)
        if setups is None:
            raise UserError(f"method={method} places centers, and representation={self.representation.name} has none")
        return setups


class Method(abc.ABC):
    """One stage of a run. Settings are the constructor's; `start` binds it to a problem; `step` until `steps` are done.

    Attributes:
        name: as on the command line.
        steps: generations of a search; 1 for a heuristic.
        initial: setups of the run's initial population that the method starts from.
        prefers: whether what it finds depends on the preferences asked for.
        brings: whether its own settings determine the number of centers, as `bring` returns it.
        begins: files with setups that a search starts from.
        inputs: what `bring` has read, or the searched centers [s, f, d] of the setups in `begins`, so that they can be
            compared when a run is resumed; or None.
    """

    name: str
    steps: int = 1
    initial: int = 0
    prefers: bool = False
    brings: bool = False
    begins: tuple[str, ...] = ()
    inputs: Tensor | None = None

    def check(self, preferences: tuple[float, ...] | None) -> None:  # noqa: B027 - most have nothing to refuse
        """Refuse settings that do not fit the preferences asked for.

        Raises:
            UserError: naming the setting and what it has to be.
        """

    def bring(self, scenario: Scenario) -> tuple[int, dict[str, str]]:
        """Of a method that brings its centers: how many a setup has on a scenario, and notes by title.

        Raises:
            UserError: if the method brings none.
        """
        raise UserError(f"method={self.name} brings no centers")

    @abc.abstractmethod
    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        """Evaluations that all steps together will take, the initial population apart."""

    @abc.abstractmethod
    def start(self, problem: Problem) -> None:
        """Bind to a problem."""

    @abc.abstractmethod
    def step(self) -> None:
        """Take one step."""

    @abc.abstractmethod
    def rows(self) -> list[Rows]:
        """What has been found so far."""

    @abc.abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """All that steps change, as tensors, numbers and text, by name; copies, so that it stays as it is."""

    @abc.abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue, after `start` on the same problem, bit for bit where `state_dict` was taken.

        Raises:
            UserError: if the state does not fit the settings.
        """

    def fits(self, steps: int) -> bool:
        """Whether a state that was taken under settings of `steps` steps is also one of these settings."""
        return steps == self.steps

    def progress(self) -> list[tuple[float, Tensor]]:
        """For each preference (NaN where none) the objectives [p, 2] that the history's line is made of."""
        return [(math.nan, rows.scores.objectives) for rows in self.rows()]

    def records(self, generation: int, evaluations: int, seconds: float, failed: int) -> list[HistoryLine]:
        """Lines of the history for the state after `generation` steps."""
        progress = self.progress()
        volume = hypervolume(torch.cat([points for _, points in progress])) if progress else 0.0
        best = [points.amax(0).tolist() for _, points in progress]
        return [
            HistoryLine(self.name, preference, generation, evaluations, seconds, volume, regularity, potential, failed)
            for (preference, _), (regularity, potential) in zip(progress, best, strict=True)
        ]


class Heuristic(Method):
    """A method of one step that sees scenario and kernel and returns centers [p, m, d]."""

    def __init__(self) -> None:
        self._problem: Problem | None = None
        self._rows: list[Rows] = []

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        """One setup, unless a heuristic proposes more."""
        return 1

    @abc.abstractmethod
    def place(self, problem: Problem) -> Tensor:
        """Centers [p, m, d] of the setups that the heuristic proposes."""

    def start(self, problem: Problem) -> None:
        self._problem, self._rows = problem, []

    def step(self) -> None:
        if self._problem is None:
            raise UserError(f"{self.name}: call start() with a problem first")
        centers = self.place(self._problem)
        self._rows = [no_preference(self.name, centers, self._problem.evaluate(centers))]

    def rows(self) -> list[Rows]:
        return self._rows

    def state_dict(self) -> dict[str, Any]:
        """The rows."""
        return {"rows": [rows_state(rows) for rows in self._rows]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take the rows."""
        self._rows = [rows_of(saved) for saved in state["rows"]]


def rows_state(rows: Rows) -> dict[str, Any]:
    """Rows as tensors and text, by name; without what they do not have."""
    parts = {name: value for name, value in rows._asdict().items() if value is not None}
    return {**parts, "scores": rows.scores._asdict()}


def rows_of(state: dict[str, Any]) -> Rows:
    """Rows from `rows_state`."""
    return Rows(**{**state, "scores": Scores(**state["scores"])})


def no_preference(method: str, centers: Tensor, scores: Scores) -> Rows:
    """Rows of setups that no preference belongs to."""
    return Rows(method, centers, scores, torch.full_like(scores.regularity, math.nan))


def unscored(centers: Tensor, objectives: Tensor) -> Scores:
    """Scores of setups of which a search keeps no more than the objectives; V is filled in when a run is saved."""
    nan = torch.full_like(objectives[:, 0], math.nan)
    return Scores(objectives[:, 0], objectives[:, 1], nan, torch.zeros_like(nan, dtype=torch.bool))


def files_of(setting: str, value: Any) -> tuple[str, ...]:
    """The files that a setting names, a file or a list of files.

    Raises:
        UserError: if it names none, or one twice.
    """
    files = [value] if isinstance(value, str) else value
    usable = isinstance(files, Sequence) and all(isinstance(file, str) and file for file in files)
    if not usable or not files:
        shown = "null" if value is None else value
        raise UserError(f"{setting}={shown}: give a file with control points, or a list of files")
    if len(set(files)) < len(files):
        raise UserError(f"{setting}={','.join(files)}: a file is listed twice")
    return tuple(files)


def starts_of(value: Any, method: str, most: int) -> tuple[str, ...]:
    """The files of `method.start`, none for null.

    Raises:
        UserError: if they are no list of files, or more than the setups that the search begins with.
    """
    files = () if value is None else files_of("method.start", value)
    if len(files) > most:
        raise UserError(f"method.start: {len(files)} files, and method={method} begins with {most} setups; give fewer")
    return files


def at_least_one(setting: str, value: int) -> int:
    """`value` if it is at least 1.

    Raises:
        UserError: naming the setting otherwise.
    """
    if value < 1:
        raise UserError(f"{setting}={value}: at least 1 is needed")
    return value


def random_stream(seed: int, name: str) -> torch.Generator:
    """A generator for one purpose of one run: streams of different names or seeds are independent."""
    state = np.random.SeedSequence([seed, zlib.crc32(name.encode())]).generate_state(2, np.uint32)
    return torch.Generator().manual_seed(int(state[0]) << 31 ^ int(state[1]))
