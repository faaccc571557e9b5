"""What a run says while it works and when it is done."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from rbfevo.methods.stage import Record
from rbfevo.pareto import hypervolume, knee

LINE_EVERY = 10.0  # seconds between lines where the output is not a terminal


class Reporter:
    """Progress on a terminal, a line now and then elsewhere, nothing when quiet.

    Args:
        planned: evaluations that the whole run will take.
        quiet: say nothing at all.
    """

    def __init__(self, planned: int, quiet: bool, console: Console | None = None) -> None:
        self.console = console or Console(quiet=quiet, highlight=False, soft_wrap=True)
        self.planned = max(planned, 1)
        self._start = time.monotonic()
        self._last_line = self._start - 0.8 * LINE_EVERY  # the first line comes soon
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

    def update(self, evaluations: int, step: int, steps: int, records: Sequence[Record]) -> None:
        """Show the state after a step of a method."""
        now = time.monotonic()
        if not records or (self._bar is None and now - self._last_line < LINE_EVERY):
            return
        self._last_line = now
        rate = evaluations / max(now - self._start, 1e-9)
        left = max(self.planned - evaluations, 0) / max(rate, 1e-9)
        state = f"{rate:,.0f} evaluations/s, hypervolume {records[0].hypervolume:.4f}, {left:.0f} s left"
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

    def closing_table(self, table: dict[str, np.ndarray], directory: Path) -> None:
        """Best regularity, best improvement potential and hypervolume by method, the knee, and where the files are."""
        objectives = np.stack((table["regularity"], table["improvement_potential"]), axis=1)
        names = list(dict.fromkeys(table["method"].tolist()))
        shown = Table("method", "setups", "best R", "best P", "hypervolume")
        for name in names:
            rows = objectives[table["method"] == name]
            shown.add_row(name, str(len(rows)), *figures(rows))
        shown.add_section()
        shown.add_row("all", str(len(objectives)), *figures(objectives))
        self.console.print(shown)
        i = knee(torch.from_numpy(objectives))
        preference = table["preference"][i]
        origin = table["method"][i] + ("" if math.isnan(preference) else f", preference {preference:g}")
        self.line(f"knee: R = {objectives[i, 0]:.4g}, P = {objectives[i, 1]:.4f} (row {i}, {origin})")
        self.line(f"files: {directory}")


def figures(objectives: np.ndarray) -> tuple[str, str, str]:
    """Best R, best P and hypervolume of objectives [p, 2], for a table."""
    return (
        f"{objectives[:, 0].max():.4g}",
        f"{objectives[:, 1].max():.4f}",
        f"{hypervolume(torch.from_numpy(objectives)):.4g}",
    )
