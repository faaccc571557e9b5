"""One run: its parts in; rows, history and summary out."""

from __future__ import annotations

import contextlib
import functools
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rbfevo import figures
from rbfevo.errors import UserError
from rbfevo.files import clear_unfinished
from rbfevo.methods.method import Method, Problem, Rows, rows_of, rows_state
from rbfevo.runs import sequence, storage
from rbfevo.runs.assembly import Parts, unused_preferences
from rbfevo.runs.checkpoint import digest, tensors
from rbfevo.runs.config import Settings
from rbfevo.runs.directory import resuming
from rbfevo.runs.identity import changes_since, checkpoint_for, identity
from rbfevo.runs.interruption import Interruption
from rbfevo.runs.journal import Journal
from rbfevo.runs.lock import locked
from rbfevo.runs.progress import Reporter
from rbfevo.runs.summary import differences, searched, summary, versions
from rbfevo.scenarios import reach
from rbfevo.scoring import compilation
from rbfevo.scoring.fronts import ENOUGH, enough_of
from rbfevo.scoring.pareto import hypervolume
from rbfevo.scoring.representations import RBF
from rbfevo.scoring.threads import coarse

COUNTERS = ("evaluations", "failed_evaluations", "further_passes", "factorizations", "gradients")


class Run(Parts):
    """The parts of one run, and what it has found so far.

    Args:
        settings: checked settings.
        progress: `Run.progress()` of when this run was last saved, with tensors; the run goes on from there.

    Raises:
        UserError: for what only shows when the parts meet (no such device, more centers than vertices, ...).
    """

    def __init__(self, settings: Settings, progress: dict[str, Any] | None = None) -> None:
        # A longer run might choose another backend, which rounds differently.
        same = None if progress is None or settings.evaluator != "auto" else progress["evaluator"]
        super().__init__(settings, same)
        self._saved = progress
        self.rows: list[Rows] = []
        self._drawn = 0  # of the rows: the initial population, scored on all vertices
        self._done: dict[str, int] = dict.fromkeys(COUNTERS, 0)  # by the parts of this run carried out earlier
        self._stage_index = self._step = self._before = 0  # of the rows, those before this stage
        self.warnings: list[str] = [*self.scenario.warnings, *reach.unfit(self.scenario, self.kernel.support)]
        self.warnings += self.representation.doubts(self.scenario)
        self.warnings += unused_preferences(settings)
        self.differences: dict[str, float] | None = None
        self.printed = 0  # of the warnings
        self.seconds = 0.0
        self.stop_reason = "budget"
        self.threads = torch.get_num_threads()
        if progress is not None:
            self._refuse_others(progress)

    def total(self, counter: str) -> int:
        """One of the evaluator's counters, coarse designs included."""
        evaluators = {id(e): e for e in (self.full_evaluator, self.evaluator, *self.coarse_evaluators)}
        return self._done[counter] + sum(getattr(evaluator, counter) for evaluator in evaluators.values())

    def search(self, reporter: Reporter, interruption: Interruption, journal: Journal) -> None:
        """Run the methods one after the other, until they are done or interrupted; what they find is kept."""
        before = 0.0 if self._saved is None else float(self._saved["seconds"])
        start = time.perf_counter() - before
        try:
            initial = self.initial()
            if len(initial.centers):
                self.rows.append(initial)
                self._drawn = 1
            problem = self.problem(initial)
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
            self.warnings.append(f"{stage.name} was skipped: {error}")

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
            "inputs": self._inputs,
            "rows": [rows_state(rows) for rows in self.rows[self._drawn : self._before]],
            "method": self.stages[self._stage_index].state_dict() if self._step else None,
        }

    @functools.cached_property
    def _design(self) -> str:
        """A hash of what is scored, bit for bit."""
        parts = (self.scenario.vertices, self.scenario.gradient, self.scenario.weights)
        more = (self.scenario.blend, self.scenario.max_displacement)
        return digest(*parts, *(part for part in more if part is not None))

    @functools.cached_property
    def _inputs(self) -> str | None:
        """A hash of what methods have read from files; None where they read none."""
        found = [stage.inputs for stage in self.stages if stage.inputs is not None]
        found += [self.kept] if len(self.kept) else []
        return digest(*found) if found else None

    def _refuse_others(self, saved: dict[str, Any]) -> None:
        """Raise UserError if it was saved on another design, or the budgets have changed so that it does not fit."""
        if saved["design"] != self._design:
            raise UserError(
                "the mesh or gradient of the scenario has changed since the run started (was a file replaced?); "
                "start a new run"
            )
        if saved.get("inputs") != self._inputs:
            raise UserError(
                "the centers in the files of keep, method.start or method.centers have changed since the run started; "
                "start a new run"
            )
        index, step = int(saved["stage"]), int(saved["step"])
        for place, (stage, steps) in enumerate(zip(self.stages, saved["steps"], strict=True)):
            if stage.steps == steps or place > index:
                continue
            if place < index or not stage.fits(steps) or stage.steps < step:
                why = "it is done" if place < index else f"it has taken {step} already"
                if place == index and not stage.fits(steps):
                    why = "its plan depends on their number from the start"
                raise UserError(f"method={stage.name}: the number of generations cannot change on resume: {why}")

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

    def save(self, directory: Path, reporter: Reporter, journal: Journal) -> None:
        """Score the rows on all vertices, write the run directory and draw its figures."""
        if not self.rows:
            reporter.line("stopped before any result; nothing was written")
            return
        judged = [self.judged(rows) for rows in self.rows]
        if self.searched is not self.scenario:
            found = [one.rows._replace(scores=one.searched) for one in judged]
            self.differences = differences(self.rows[self._drawn :], found[self._drawn :])
        idle = None
        if isinstance(self.representation, RBF) and self.kernel.support is not None:
            found = torch.cat([row.centers for row in self.rows])
            self.warnings += reach.out_of_reach(self.scenario, self.kernel.support, found)
            idle = reach.idle_centers(self.scenario, self.kernel.support, found.nan_to_num()).numpy()
        rows = [one.rows for one in judged]
        table = storage.setup_table(rows, self.representation, self.scenario.vertices.shape[1], judged)
        self.warnings += self._of_ranks(table)
        objectives = torch.cat([one.searched.objectives for one in judged])
        storage.write_scenario(directory, self.scenario)
        names = () if self.scenario.objectives is None else self.scenario.objectives.names
        storage.write_setups(directory, table, names)
        self._write_sequence(directory, reporter)
        journal.publish()
        storage.write_summary(directory, summary(self, hypervolume(objectives)))
        drawn = figures.draw(directory) if self.settings.figures else []
        for warning in [*self.warnings[self.printed :], *drawn]:
            reporter.line(f"warning: {warning}")
        reporter.closing_table(table, directory, idle, self.norm, names)

    def _of_ranks(self, table: dict[str, np.ndarray]) -> list[str]:
        """A warning where columns of setups that are no centers depend on each other."""
        if "genotype" not in table:
            return []
        m = self.representation.parameters(torch.from_numpy(table["genotype"]))
        ranks = np.rint(table["variability"] * len(self.scenario.vertices)).astype(int)
        low = ranks[ranks < m]
        if not len(low):
            return []
        span = f"{low.min()}" if low.min() == low.max() else f"{low.min()} to {low.max()}"
        hint = "" if len(low) < len(ranks) else "; a lower degree, fewer control points or method=ols may help"
        return [f"{len(low)} of {len(ranks)} setups have R = 0: their {m} columns have the rank {span}{hint}"]

    def _write_sequence(self, directory: Path, reporter: Reporter) -> None:
        """Write sequence.csv where a method placed one center after the other, and say where another stops paying."""
        picked = next((rows.picked for rows in self.rows if rows.picked is not None), None)
        if picked is None or not sequence.is_scored(self):
            return
        table = sequence.table(self, picked, self.settings.manipulation)
        storage.write_sequence(directory, table)
        gains = np.sqrt(table[searched(self)])
        number = enough_of(table["centers"].tolist(), gains.tolist())
        if number is not None and len(self.stages) == 1:
            P = "P" if self.norm == 2.0 else f"P_{self.norm:g}"
            share = f"{ENOUGH:.0%} of the gain of all, the square root of {P}"
            reporter.line(f"the first {number} of {len(picked)} centers reach {share}")


def carry_out(
    settings: Settings,
    directory: Path,
    arguments: Sequence[str] = (),
    resume: bool = False,
    stop: Callable[[], bool] | None = None,
) -> int:
    """Carry out one run into its directory; return 0, or 128 and the number of the signal that stopped it.

    That is 130 for SIGINT and 143 for SIGTERM.

    Args:
        settings: checked settings; directory: where everything goes; it is locked meanwhile.
        arguments: the command line that the settings come from, for the checkpoint.
        resume: go on from the checkpoint in the directory.
        stop: says whether to stop the run, as SIGTERM does.

    Raises:
        UserError: for a user's mistake; what had been found by then is written all the same.
    """
    with locked(directory), Interruption(stop) as interruption, coarse() as threads:
        clear_unfinished(directory)
        saved = checkpoint_for(settings, directory) if resume else None
        if not resume:
            storage.refuse_results(directory)
        facts = {"words": list(arguments), "settings": identity(settings), "whole": identity(settings, whole=True)}
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
        run.printed = len(run.warnings)
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
        stopped = interruption.signal
        if stopped is None:
            run.keep(journal, reporter, finished=True)
            journal.close()
        else:
            reporter.line(f"to continue: python -m rbfevo {resuming(directory)}")
    return 0 if stopped is None else 128 + stopped
