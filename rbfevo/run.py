"""One run: scenario, kernel, evaluator and methods in; rows, history and summary out."""

from __future__ import annotations

import functools
import importlib.metadata
import platform
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from rbfevo import figures, reach, storage
from rbfevo.config import Settings, build
from rbfevo.errors import UserError
from rbfevo.evaluator import Evaluator
from rbfevo.evolvability import Scores
from rbfevo.kernels import Kernel
from rbfevo.methods.stage import Method, Problem, Record, Rows, no_preference, random_stream
from rbfevo.mirrored import evaluator_of, spectrum_of
from rbfevo.pareto import hypervolume
from rbfevo.progress import Reporter
from rbfevo.scenarios.coarse import coarsened, matched
from rbfevo.scenarios.scenario import Scenario
from rbfevo.threads import coarse

# Up to this many numbers in U the rows of a result are scored by the definition, above by the blocked evaluator.
DEFINED_UP_TO = 4_000_000
MATCHED_ON = 20  # setups
# Below this many evaluations times vertices, plain torch is done before numba has compiled for the first time (8 s).
COMPILE_FROM = 10_000_000


class Interruption:
    """Turns the first SIGINT or SIGTERM into a flag that a run looks at between steps; the second ends the process."""

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        try:
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        except ValueError:  # not the main thread: whoever runs us there decides
            pass
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.signal is not None:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        self.signal = number


class Run:
    """The parts of one run, put together from its settings, and what it has found so far.

    Raises:
        UserError: for what only shows when the parts meet (no such device, more centers than vertices, ...).
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.device = chosen_device(settings.device)
        self.scenario: Scenario = build(settings.scenario)
        n, d = self.scenario.vertices.shape
        if settings.centers > n:
            raise UserError(
                f"centers={settings.centers}: scenario {self.scenario.name} has only {n} vertices; use fewer"
            )
        self.kernel: Kernel = build(settings.kernel, d, self.scenario.support, self.scenario.diagonal)
        method = build(settings.method)
        self._enough_vertices(method)
        self.name: str = method.name
        self.stages: list[Method] = getattr(method, "stages", [method])
        self.planned = sum(stage.planned_evaluations(settings.preferences) for stage in self.stages)
        backend = settings.evaluator
        self.searched = self.scenario
        if backend == "auto" and self.planned * min(n, self.scenario.search_vertices or n) < COMPILE_FROM:
            backend = "eager"
        self._backend = backend
        self.full_evaluator = self.evaluator = self._evaluator(self.scenario)
        self.coarse_evaluators: list[Evaluator] = []
        self.rows: list[Rows] = []
        self._drawn = 0  # of the rows: the initial population, scored on all vertices
        self.history: list[Record] = []
        self.warnings: list[str] = [*self.scenario.warnings, *reach.unfit(self.scenario, self.kernel)]
        self.differences: dict[str, float] | None = None
        self.told = 0  # warnings that have been printed
        self.seconds = 0.0
        self.stop_reason = "budget"
        self.threads = torch.get_num_threads()

    def _enough_vertices(self, method: Any) -> None:
        """Raise UserError if a search would look at fewer vertices than twice the centers."""
        asked = {
            "scenario.search_vertices": self.scenario.search_vertices,
            "method.coarse": getattr(method, "coarse", None),
        }
        for key, count in asked.items():
            if count is not None and count < len(self.scenario.vertices) and count < 2 * self.settings.centers:
                raise UserError(f"{key}={count}: at least twice as many as centers={self.settings.centers} are needed")

    def _evaluator(self, scenario: Scenario) -> Evaluator:
        """Of this run's kernel and manipulation, on a scenario's vertices; all that a GPU does, it does in there."""
        return evaluator_of(scenario.to(self.device), self.kernel, self.settings.manipulation, self._backend)

    def total(self, counter: str) -> int:
        """One of the evaluator's counters, coarse designs included."""
        evaluators = {id(e): e for e in (self.full_evaluator, self.evaluator, *self.coarse_evaluators)}
        return sum(getattr(evaluator, counter) for evaluator in evaluators.values())

    def search(self, reporter: Reporter, interruption: Interruption) -> None:
        """Run the methods one after the other, until they are done or interrupted; what they find is kept."""
        start = time.perf_counter()
        try:
            problem = self.problem()
            for stage in self.stages:
                self._stage(stage, problem, start, reporter, interruption)
        finally:
            self.seconds = time.perf_counter() - start
        if interruption.signal is not None:
            self.stop_reason = f"interrupted by {signal.Signals(interruption.signal).name}"

    def _stage(
        self, stage: Method, problem: Problem, start: float, reporter: Reporter, interruption: Interruption
    ) -> None:
        if interruption.signal is not None:
            return
        try:
            stage.start(problem)
            try:
                for step in range(1, stage.steps + 1):
                    stage.step()
                    seconds = time.perf_counter() - start
                    evaluations = self.total("evaluations")
                    records = stage.records(step, evaluations, seconds, self.total("failed_evaluations"))
                    self.history += records
                    reporter.update(evaluations, step, stage.steps, records)
                    if interruption.signal is not None:
                        return
            finally:  # what has been found is kept, whatever happens
                self.rows += stage.rows()
        except UserError as error:
            if len(self.stages) == 1:
                raise
            self.warnings.append(f"{stage.name} was left out: {error}")

    def _initial(self) -> Rows:
        m, count = self.settings.centers, max(stage.initial for stage in self.stages)
        centers = self.scenario.parameterization(self.scenario.sample(count, m, self._stream("initial")))
        rows = no_preference("random", centers, self.full_evaluator(centers))
        if count:
            self.rows.append(rows)
            self._drawn = 1
        return rows

    @functools.cached_property
    def _for_matching(self) -> Rows:
        """A few random setups, scored on all vertices, where a method asks for no initial population."""
        sample = self.scenario.sample(MATCHED_ON, self.settings.centers, self._stream("matching"))
        centers = self.scenario.parameterization(sample)
        return no_preference("random", centers, self.full_evaluator(centers))

    def _stream(self, name: str) -> torch.Generator:
        return random_stream(self.settings.seed, name)

    def problem(self) -> Problem:
        """What the methods are given; draws and scores the initial population, on all vertices."""
        initial = self._initial()
        problem = self._problem(self.scenario, self.full_evaluator, initial)
        if self.scenario.search_vertices is not None and self.scenario.search_vertices < len(self.scenario.vertices):
            problem = problem.coarsened(self.scenario.search_vertices)
            self.evaluator = self.coarse_evaluators.pop()
            self.searched = problem.scenario
        return problem

    def _problem(self, scenario: Scenario, evaluator: Evaluator, initial: Rows) -> Problem:
        def fewer_vertices(count: int) -> Problem:
            """The same problem on at most `count` weighted vertices; P is matched on the initial population."""
            fewer = coarsened(scenario, count)
            if fewer is scenario:
                return problem
            trial = self._evaluator(fewer)
            known = initial if len(initial.centers) else self._for_matching
            potential = trial(known.centers).improvement_potential
            fewer = matched(fewer, potential, known.scores.improvement_potential)
            coarse = self._evaluator(fewer)
            coarse.evaluations = trial.evaluations
            self.coarse_evaluators.append(coarse)
            return self._problem(fewer, coarse, initial)

        problem = Problem(
            evaluate=evaluator,
            lower=scenario.search_box[0],
            upper=scenario.search_box[1],
            centers=self.settings.centers,
            stream=self._stream,
            preferences=self.settings.preferences,
            initial=initial,
            scenario=scenario,
            kernel=self.kernel,
            spectrum=lambda centers: spectrum_of(evaluator, centers),
            coarsened=fewer_vertices,
            parameterization=scenario.parameterization,
        )
        return problem

    def summary(self, volume: float) -> dict[str, Any]:
        """The contents of `summary.json`."""
        evaluations = self.total("evaluations")
        return {
            "scenario": self.scenario.name,
            "kernel": self.kernel.name,
            "support": self.kernel.support,
            "manipulation": self.settings.manipulation,
            "method": self.name,
            "centers": self.settings.centers,
            "seed": self.settings.seed,
            "device": describe(self.device),
            "versions": versions(),
            "evaluations": evaluations,
            "failed_evaluations": self.total("failed_evaluations"),
            "further_passes": self.total("further_passes"),
            "factorizations": self.total("factorizations"),
            "gradients": self.total("gradients"),
            "coarse_vertices": [len(evaluator.deformation.vertices) for evaluator in self.coarse_evaluators],
            "scored_by": "definition" if self._defined else "evaluator",
            "seconds": self.seconds,
            "evaluations_per_second": evaluations / self.seconds if self.seconds > 0 else 0.0,
            "hypervolume": volume,
            "stop_reason": self.stop_reason,
            "evaluator": self.evaluator.backend,
            "threads": self.threads,
            "gradient_norm": self.scenario.gradient_norm,
            "gradient_is": "direction" if self.scenario.direction_only else "displacement",
            "symmetry": self._symmetry(),
            "up": self.scenario.up,
            "vertices": len(self.scenario.vertices),
            "search_vertices": len(self.searched.vertices),
            "search_differences": self.differences,
            "notes": self.scenario.notes,
            "warnings": self.warnings,
        }

    def _symmetry(self) -> dict[str, Any] | None:
        mirror = self.scenario.mirror
        return None if mirror is None else {"axis": "xyz"[mirror.axis], "at": mirror.at}

    @property
    def _defined(self) -> bool:
        return len(self.scenario.vertices) * self.settings.centers <= DEFINED_UP_TO

    def _final(self, centers: torch.Tensor) -> Scores:
        """Scores on all vertices, by the definition where U is not too large for that."""
        evaluator = self.full_evaluator
        if self._defined:
            return evaluator.definition(centers)
        return evaluator_of(self.scenario.to(self.device), self.kernel, self.settings.manipulation, evaluator.backend)(
            centers
        )  # one of its own: these are no evaluations of the search

    def save(self, directory: Path, reporter: Reporter) -> None:
        """Score the rows on all vertices, write the run directory and draw its figures."""
        if not self.rows:
            reporter.line("stopped before anything was found; nothing was written")
            return
        rescored = [rows._replace(scores=self._final(rows.centers)) for rows in self.rows]
        if self.searched is not self.scenario:
            self.differences = differences(self.rows[self._drawn :], rescored[self._drawn :])
        self.warnings += reach.out_of_reach(self.scenario, self.kernel, torch.cat([row.centers for row in self.rows]))
        table = storage.setup_table(rescored)
        objectives = torch.cat([rows.scores.objectives for rows in rescored])
        storage.write_scenario(directory, self.scenario)
        storage.write_setups(directory, table)
        storage.write_history(directory, self.history)
        storage.write_summary(directory, self.summary(hypervolume(objectives)))
        drawn = figures.draw(directory) if self.settings.figures else []
        for warning in [*self.warnings[self.told :], *drawn]:
            reporter.line(f"warning: {warning}")
        reporter.closing_table(table, directory)


def carry_out(settings: Settings, directory: Path) -> int:
    """Carry out one run into its directory; return 0, or 130 and 143 after SIGINT and SIGTERM.

    Raises:
        UserError: for a user's mistake; what had been found by then is written all the same.
    """
    storage.refuse_results(directory)
    with Interruption() as interruption, coarse() as threads:
        run = Run(settings)
        run.threads = threads
        reporter = Reporter(run.planned, settings.quiet)
        for note in run.scenario.notes.values():
            reporter.line(note)
        for warning in run.warnings:
            reporter.line(f"warning: {warning}")
        run.told = len(run.warnings)
        try:
            run.search(reporter, interruption)
        except BaseException:
            run.stop_reason = "error"
            run.save(directory, reporter)
            raise
        finally:
            reporter.close()
        run.save(directory, reporter)
    return 0 if interruption.signal is None else 128 + interruption.signal


def differences(searched: Sequence[Rows], final: Sequence[Rows]) -> dict[str, float] | None:
    """How far scores on a search's vertices were from those on all: (R' - R)/R and P' - P, R' and P' the search's.

    Medians tell the bias, the others the largest size; g is scaled so that P fits for random setups. None where there
    are no rows.
    """
    if not searched:
        return None
    before, after = (torch.cat([row.scores.objectives for row in rows]) for rows in (searched, final))
    relative = (before[:, 0] - after[:, 0]) / after[:, 0].clamp_min(1e-12)
    absolute = before[:, 1] - after[:, 1]
    return {
        "regularity_median": float(relative.median()),
        "regularity_largest": float(relative.abs().max()),
        "improvement_potential_median": float(absolute.median()),
        "improvement_potential_largest": float(absolute.abs().max()),
    }


def chosen_device(name: str) -> torch.device:
    """The device that `device=` asks for.

    Raises:
        UserError: if it asks for CUDA and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device=cuda: torch sees no CUDA device here; use device=cpu or device=auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def describe(device: torch.device) -> str:
    """The device in words: `cpu`, or `cuda (NVIDIA ...)`."""
    return f"cuda ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else device.type


def versions() -> dict[str, str]:
    """Versions of what the numbers of a run depend on."""
    found = {"python": platform.python_version()}
    for package in ("rbfevo", "torch", "numpy", "scipy", "numba", "trimesh", "pyvista", "hydra-core", "mne"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
