"""One run: scenario, kernel, evaluator and methods in; rows, history and summary out."""

from __future__ import annotations

import contextlib
import functools
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from rbfevo import figures, methods
from rbfevo.errors import UserError
from rbfevo.files import clear_unfinished
from rbfevo.methods.method import Method, Problem, Rows, no_preference, random_stream, rows_of, rows_state
from rbfevo.runs import storage
from rbfevo.runs.checkpoint import digest, tensors
from rbfevo.runs.config import Settings, build
from rbfevo.runs.directory import resuming
from rbfevo.runs.identity import changes_since, checkpoint_for, identity, stages_of
from rbfevo.runs.interruption import Interruption
from rbfevo.runs.journal import Journal
from rbfevo.runs.lock import locked
from rbfevo.runs.progress import Reporter
from rbfevo.runs.summary import differences, summary, versions
from rbfevo.scenarios import reach
from rbfevo.scenarios.coarse import coarsened, matched
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring import compilation
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.evolvability import Scores
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.pareto import hypervolume
from rbfevo.scoring.representations import RBF, Representation
from rbfevo.scoring.symmetric import evaluator_of
from rbfevo.scoring.threads import coarse

# Up to this many numbers in U the rows of a result are scored by the definition, above by the blocked evaluator.
DEFINED_UP_TO = 4_000_000
MATCHED_ON = 20  # setups
COUNTERS = ("evaluations", "failed_evaluations", "further_passes", "factorizations", "gradients")
# Below this many evaluations times vertices, plain torch is done before numba has compiled for the first time (8 s).
COMPILE_FROM = 10_000_000


class Run:
    """The parts of one run, put together from its settings, and what it has found so far.

    Args:
        settings: checked settings.
        progress: what `progress` said when this run was last saved, with tensors; the run goes on from there.

    Raises:
        UserError: for what only shows when the parts meet (no such device, more centers than vertices, ...).
    """

    def __init__(self, settings: Settings, progress: dict[str, Any] | None = None) -> None:
        self.settings, self._saved = settings, progress
        self.device = chosen_device(settings.device)
        self.scenario: Scenario = build(settings.scenario)
        n, d = self.scenario.vertices.shape
        if settings.centers > n:
            raise UserError(
                f"centers={settings.centers}: scenario {self.scenario.name} has only {n} vertices; use fewer"
            )
        self.kernel: Kernel = build(settings.kernel, d, self.scenario.support, self.scenario.diagonal)
        made = build(settings.representation, self.scenario, self.kernel, settings.centers)
        self.representation: Representation = made
        self.space = self.representation.space(self.scenario, settings.centers)
        method = build(settings.method)
        self._enough_vertices(method)
        self.name: str = method.name
        self.stages = stages_of(method)
        for stage in self.stages:
            stage.check(settings.preferences)
        self.planned = sum(stage.planned_evaluations(settings.preferences) for stage in self.stages)
        backend = settings.evaluator
        self.searched = self.scenario
        if backend == "auto" and self.planned * min(n, self.scenario.search_vertices or n) < COMPILE_FROM:
            backend = "eager"
        if progress is not None and settings.evaluator == "auto":
            backend = progress["evaluator"]  # a longer run might choose another one, which rounds differently
        self._backend = backend
        self.full_evaluator = self.evaluator = self._evaluator(self.scenario)
        self.coarse_evaluators: list[Evaluator] = []
        self.rows: list[Rows] = []
        self._drawn = 0  # of the rows: the initial population, scored on all vertices
        self._done: dict[str, int] = dict.fromkeys(
            COUNTERS, 0
        )  # by the parts of this run that were carried out earlier
        self._stage_index = self._step = self._before = 0  # of the rows, those before this stage
        self.warnings: list[str] = [*self.scenario.warnings, *reach.unfit(self.scenario, self.kernel.support)]
        self.warnings += unused_preferences(settings)
        self.differences: dict[str, float] | None = None
        self.told = 0  # warnings that have been printed
        self.seconds = 0.0
        self.stop_reason = "budget"
        self.threads = torch.get_num_threads()
        if progress is not None:
            self._refuse_others(progress)

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
        return evaluator_of(scenario.to(self.device), self.representation, self.settings.manipulation, self._backend)

    def total(self, counter: str) -> int:
        """One of the evaluator's counters, coarse designs included."""
        evaluators = {id(e): e for e in (self.full_evaluator, self.evaluator, *self.coarse_evaluators)}
        return self._done[counter] + sum(getattr(evaluator, counter) for evaluator in evaluators.values())

    def search(self, reporter: Reporter, interruption: Interruption, journal: Journal) -> None:
        """Run the methods one after the other, until they are done or interrupted; what they find is kept."""
        before = 0.0 if self._saved is None else float(self._saved["seconds"])
        start = time.perf_counter() - before
        try:
            problem = self.problem()
            if self._saved is not None:
                self._resume(self._saved)
            self._before = len(self.rows)
            for index in range(self._stage_index, len(self.stages)):
                if interruption.signal is not None:
                    break
                self._stage_index, self._step, self._before = index, 0, len(self.rows)
                self._stage(self.stages[index], problem, start, reporter, interruption, journal)
            self.keep(journal, reporter)
        finally:
            self.seconds = time.perf_counter() - start
        if interruption.signal is not None:
            self.stop_reason = f"interrupted by {signal.Signals(interruption.signal).name}"

    def _stage(
        self,
        stage: Method,
        problem: Problem,
        start: float,
        reporter: Reporter,
        interruption: Interruption,
        journal: Journal,
    ) -> None:
        saved, self._saved = self._saved, None
        try:
            stage.start(problem)
            if saved is not None:
                stage.load_state_dict(saved["method"])
                self._step = int(saved["step"])
                self._count(saved)
            try:
                for step in range(self._step + 1, stage.steps + 1):
                    stage.step()
                    self._step, self.seconds = step, time.perf_counter() - start
                    evaluations = self.total("evaluations")
                    records = stage.records(step, evaluations, self.seconds, self.total("failed_evaluations"))
                    journal.record(records)
                    reporter.update(evaluations, step, stage.steps, records)
                    if journal.due():
                        self.keep(journal, reporter)
                    if interruption.signal is not None:
                        return
            finally:  # what has been found is kept, whatever happens
                self.rows += stage.rows()
        except UserError as error:
            if len(self.stages) == 1:
                raise
            self.warnings.append(f"{stage.name} was left out: {error}")

    def keep(self, journal: Journal, reporter: Reporter, finished: bool = False) -> None:
        """Write a checkpoint; if that fails one warning is printed, and it is tried again the next time."""
        failed_before = journal.complaint is not None
        journal.complaint = None
        if not journal.keep(self.progress(), finished) and not failed_before:
            reporter.line(f"warning: {journal.complaint}")

    def progress(self) -> dict[str, Any]:
        """Where the run is, for a checkpoint: stage, step, the stage's state, rows of those before, counters."""
        return {
            "stage": self._stage_index,
            "step": self._step,
            "steps": [stage.steps for stage in self.stages],
            "seconds": self.seconds,
            "evaluator": self.evaluator.backend,
            "counters": {counter: self.total(counter) for counter in COUNTERS},
            "warnings": self.warnings,
            "design": self._design,
            "rows": [rows_state(rows) for rows in self.rows[self._drawn : self._before]],
            "method": self.stages[self._stage_index].state_dict() if self._step else None,
        }

    @functools.cached_property
    def _design(self) -> str:
        """A hash of what is scored, bit for bit."""
        return digest(self.scenario.vertices, self.scenario.gradient, self.scenario.weights)

    def _refuse_others(self, saved: dict[str, Any]) -> None:
        """Raise UserError if it was saved on another design, or the budgets have changed so that it does not fit."""
        if saved["design"] != self._design:
            raise UserError("the scenario has another mesh or gradient than when the run began (has a file changed?)")
        index, step = int(saved["stage"]), int(saved["step"])
        for place, (stage, steps) in enumerate(zip(self.stages, saved["steps"], strict=True)):
            if stage.steps == steps or place > index:
                continue
            if place < index or not stage.fits(steps) or stage.steps < step:
                why = "it is done" if place < index else f"it has taken {step} already"
                if place == index and not stage.fits(steps):
                    why = "its plan depends on their number from the start"
                raise UserError(f"method={stage.name}: the generations cannot be changed on the way: {why}")

    def _resume(self, saved: dict[str, Any]) -> None:
        """Take up what was saved, but for the state of the stage that it was saved in, which that stage takes."""
        self._stage_index = int(saved["stage"])
        self.rows += [rows_of(state) for state in saved["rows"]]
        self.warnings += [warning for warning in saved["warnings"] if warning not in self.warnings]
        self._count(saved)
        if saved["method"] is None:
            self._saved = None

    def _count(self, saved: dict[str, Any]) -> None:
        """Let the counters go on from those saved: starting again has counted a second time."""
        self._done.update(dict.fromkeys(COUNTERS, 0))
        self._done = {counter: int(saved["counters"][counter]) - self.total(counter) for counter in COUNTERS}

    def _initial(self) -> Rows:
        count = max(stage.initial for stage in self.stages)
        centers = self.space.place(self.space.sample(count, self._stream("initial")))
        rows = no_preference("random", centers, self.full_evaluator(centers))
        if count:
            self.rows.append(rows)
            self._drawn = 1
        return rows

    @functools.cached_property
    def _for_matching(self) -> Rows:
        """A few random setups, scored on all vertices, where a method asks for no initial population."""
        centers = self.space.place(self.space.sample(MATCHED_ON, self._stream("matching")))
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
            space=self.space,
            centers=self.settings.centers,
            stream=self._stream,
            preferences=self.settings.preferences,
            initial=initial,
            scenario=scenario,
            representation=self.representation,
            spectrum=evaluator.spectrum,
            coarsened=fewer_vertices,
        )
        return problem

    @property
    def defined(self) -> bool:
        """Whether the rows of the result are scored by the definition."""
        return len(self.scenario.vertices) * self.settings.centers <= DEFINED_UP_TO

    def _final(self, centers: torch.Tensor) -> Scores:
        """Scores on all vertices, by the definition where U is not too large for that."""
        evaluator = self.full_evaluator
        if self.defined:
            return evaluator.definition(centers)
        return evaluator_of(
            self.scenario.to(self.device), self.representation, self.settings.manipulation, evaluator.backend
        )(centers)  # one of its own: these are no evaluations of the search

    def save(self, directory: Path, reporter: Reporter, journal: Journal) -> None:
        """Score the rows on all vertices, write the run directory and draw its figures."""
        if not self.rows:
            reporter.line("stopped before anything was found; nothing was written")
            return
        rescored = [rows._replace(scores=self._final(rows.centers)) for rows in self.rows]
        if self.searched is not self.scenario:
            self.differences = differences(self.rows[self._drawn :], rescored[self._drawn :])
        if isinstance(self.representation, RBF):
            found = torch.cat([row.centers for row in self.rows])
            self.warnings += reach.out_of_reach(self.scenario, self.kernel.support, found)
        table = storage.setup_table(rescored, self.representation, self.scenario.vertices.shape[1])
        objectives = torch.cat([rows.scores.objectives for rows in rescored])
        storage.write_scenario(directory, self.scenario)
        storage.write_setups(directory, table)
        journal.publish()
        storage.write_summary(directory, summary(self, hypervolume(objectives)))
        drawn = figures.draw(directory) if self.settings.figures else []
        for warning in [*self.warnings[self.told :], *drawn]:
            reporter.line(f"warning: {warning}")
        reporter.closing_table(table, directory)


def carry_out(settings: Settings, directory: Path, words: Sequence[str] = (), resume: bool = False) -> int:
    """Carry out one run into its directory; return 0, or 130 and 143 after SIGINT and SIGTERM.

    Args:
        settings: checked settings; directory: where everything goes, with a lock meanwhile.
        words: the command line that the settings come from, for a checkpoint to tell.
        resume: go on from the checkpoint in the directory.

    Raises:
        UserError: for a user's mistake; what had been found by then is written all the same.
    """
    with locked(directory), Interruption() as interruption, coarse() as threads:
        clear_unfinished(directory)
        saved = checkpoint_for(settings, directory) if resume else None
        if not resume:
            storage.refuse_results(directory)
        facts = {"words": list(words), "settings": identity(settings), "whole": identity(settings, whole=True)}
        facts |= {"versions": versions(), "threads": threads, "cwd": str(Path.cwd())}
        journal = Journal(directory, settings.checkpoint_every, facts, saved)
        try:
            run = Run(settings, None if saved is None else tensors(saved["progress"]))
        except BaseException:
            journal.discard()
            raise
        run.threads = threads
        if saved is not None:
            run.warnings += changes_since(saved, {**facts, "threads": threads})
        reporter = Reporter(run.planned + max(stage.initial for stage in run.stages), settings.quiet)
        for note in run.scenario.notes.values():
            reporter.line(note)
        for warning in run.warnings:
            reporter.line(f"warning: {warning}")
        run.told = len(run.warnings)
        try:
            with compilation.heard(reporter.line):
                run.search(reporter, interruption, journal)
        except BaseException:
            run.stop_reason = "error"
            with contextlib.suppress(UserError):  # the first mishap is the one to report
                run.save(directory, reporter, journal)
            if not run.rows:
                journal.discard()
            raise
        finally:
            reporter.close()
        run.save(directory, reporter, journal)
        if interruption.signal is None:
            run.keep(journal, reporter, finished=True)
            journal.close()
        else:
            reporter.line(f"to go on: python -m rbfevo {resuming(directory)}")
    return 0 if interruption.signal is None else 128 + interruption.signal


def unused_preferences(settings: Settings) -> list[str]:
    """A warning where preferences are asked for and none of the methods has any use for them."""
    stages = stages_of(build(settings.method))
    if settings.preferences is None or any(stage.prefers for stage in stages):
        return []
    every = [getattr(methods, name) for name in methods.__all__]
    others = sorted(other.name for other in every if issubclass(other, Method) and other.prefers)
    asked = [f"{preference:g}" for preference in settings.preferences]
    value = asked[0] if len(asked) == 1 else f"[{','.join(asked)}]"
    return [
        f"preference={value}: method={stages[0].name} finds the same setups without it; leave it out, or choose method="
        f"{' or '.join(others)}"
    ]


def chosen_device(name: str) -> torch.device:
    """The device that `device=` asks for.

    Raises:
        UserError: if it asks for CUDA and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device=cuda: torch sees no CUDA device here; use device=cpu or device=auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
