"""What a run prints while it works and when it is done."""

from __future__ import annotations

import collections
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from rbfevo.methods.method import HistoryLine
from rbfevo.scoring.pareto import hypervolume, knee

LINE_EVERY = 10.0  # seconds between lines where the output is not a terminal
SOON = 2.0  # seconds to the first line, and to the next after one that could not yet show the rate
WINDOW = 20.0  # seconds that a rate looks back
SHORTEST = 1.0  # seconds that a rate worth telling looks back at least


class Rate:
    """Evaluations a second over the last steps of one method.

    It starts with the first step that is done: what was there before, such as the evaluations of a run that is resumed,
    or the time that a compiler took, is no measure of the time that is left.
    """

    def __init__(self) -> None:
        self._marks: collections.deque[tuple[float, int]] = collections.deque()
        self._method = ""

    def mark(self, now: float, evaluations: int, method: str) -> None:
        """Note how many evaluations there are after a step."""
        if method != self._method:
            self._method = method
            self._marks.clear()
        self._marks.append((now, evaluations))
        while len(self._marks) > 2 and now - self._marks[1][0] >= WINDOW:
            self._marks.popleft()

    def __call__(self) -> float | None:
        """The rate, or None while there is none worth telling."""
        if not self._marks:
            return None
        (since, before), (now, evaluations) = self._marks[0], self._marks[-1]
        if now - since < SHORTEST or evaluations <= before:
            return None
        return (evaluations - before) / (now - since)


class Reporter:
    """Progress on a terminal, a line now and then elsewhere, nothing when quiet.

    Args:
        planned: evaluations that the whole run will take, with those of before it was resumed.
        quiet: print nothing at all.
        clock: seconds.
    """

    def __init__(
        self, planned: int, quiet: bool, console: Console | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.console = console or Console(quiet=quiet, highlight=False, soft_wrap=True)
        self.planned = max(planned, 1)
        self._clock, self._rate = clock, Rate()
        self._next_line = clock() + SOON
        self._bar: Progress | None = None
        if self.console.is_terminal and not quiet:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[state]}"),
                TimeElapsedColumn(),
                console=self.console,
                transient=True,
                refresh_per_second=4,
            )
            self._task = self._bar.add_task("start", total=self.planned, state="")
            self._bar.start()

    def line(self, text: str) -> None:
        """Say one thing."""
        self.console.print(text, markup=False)

    def update(self, evaluations: int, step: int, steps: int, records: Sequence[HistoryLine]) -> None:
        """Show the state after a step of a method."""
        if not records:
            return
        now = self._clock()
        self._rate.mark(now, evaluations, records[0].method)
        if self._bar is None and now < self._next_line:
            return
        rate, state = self._rate(), f"hypervolume {records[0].hypervolume:.4f}"
        if rate is not None:
            left = max(self.planned - evaluations, 0) / rate
            state = f"{rate:,.0f} evaluations/s, {state}, {left:.0f} s left"
        self._next_line = now + (SOON if rate is None else LINE_EVERY)
        name = f"{records[0].method} {step}/{steps}"
        if self._bar is not None:
            self._bar.update(self._task, description=name, completed=evaluations, state=state)
        else:
            self.line(f"{name}: {state}")

    def close(self) -> None:
        """Take the progress bar away."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def closing_table(
        self,
        table: dict[str, np.ndarray],
        directory: Path,
        idle: np.ndarray | None = None,
        norm: float = 2.0,
        several: Sequence[str] = (),
    ) -> None:
        """Best regularity, best potential as searched and hypervolume by method, the knee, and where the files are.

        Args:
            table: the arrays of setups.npz; idle: [p, m] which centers have no free vertex in reach: those of the
                knee and of the best setups are named. norm: p of the potential that was searched; several: names of
                several objectives, whose potentials at the knee are shown.
        """
        plain = "P" if norm == 2.0 else f"P_{norm:g}"
        potential, P = table.get("bounded_potential", table["improvement_potential"]), plain
        if several:
            P = f"mean {plain}"
        if "worst_potential" in table:
            potential, P = table["worst_potential"], f"min {plain}"
        objectives = np.stack((table["regularity"], potential), axis=1)
        names = list(dict.fromkeys(table["method"].tolist()))
        shown = Table("method", "setups", "best R", f"best {P}", "hypervolume")
        for name in names:
            rows = objectives[table["method"] == name]
            shown.add_row(name, str(len(rows)), *figures(rows))
        shown.add_section()
        shown.add_row("all", str(len(objectives)), *figures(objectives))
        self.console.print(shown)
        i = knee(torch.from_numpy(objectives))
        preference = table["preference"][i]
        origin = table["method"][i] + ("" if math.isnan(preference) else f", preference {preference:g}")
        self.line(f"knee: R = {objectives[i, 0]:.4g}, {P} = {objectives[i, 1]:.4f} (row {i}, {origin})")
        if several:
            own = table["potentials" if norm == 2.0 else "bounded_potentials"][i].tolist()
            listed = ", ".join(f"{name} {value:.4f}" for name, value in zip(several, own, strict=True))
            self.line(f"knee, {plain} of each objective: {listed}")
        if "label" in table:
            for row in np.flatnonzero(table["label"] != "").tolist():
                R, value = objectives[row]
                self.line(f"{table['label'][row]}: R = {R:.4g}, {P} = {value:.4f} (row {row}, {table['method'][row]})")
        if idle is not None:
            picks = {"knee": i, "best R": int(objectives[:, 0].argmax()), f"best {P}": int(objectives[:, 1].argmax())}
            for name, row in picks.items():
                if idle[row].any():
                    numbers = ", ".join(map(str, np.flatnonzero(idle[row])))
                    self.line(f"{name} (row {row}): no free vertex in reach of centers {numbers}, which move nothing")
        self.line(f"files: {directory}")


def figures(objectives: np.ndarray) -> tuple[str, str, str]:
    """Best R, best P and hypervolume of objectives [p, 2], for a table."""
    return (
        f"{objectives[:, 0].max():.4g}",
        f"{objectives[:, 1].max():.4f}",
        f"{hypervolume(torch.from_numpy(objectives)):.4g}",
    )
