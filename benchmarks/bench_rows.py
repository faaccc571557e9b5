"""Measurements as rows of a table: printed once they are measured, and written to one JSON file."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import threadpoolctl
import torch
from rich.console import Console
from rich.table import Table


class Row(NamedTuple):
    """One measurement, compared with its floor or peer.

    Attributes:
        group: of rows, as in `--only`.
        name: what was measured.
        value: the measurement, in `unit`; None if it could not be measured, for the reason in `note`.
        peer: the measurement of the floor or peer in the same unit; `against` names it.
        ratio: median over the rounds; `target` or `note` give its direction.
        target: the target as text; met: whether it is met, None if there is no target.
    """

    group: str
    name: str
    value: float | None
    unit: str
    peer: float | None = None
    against: str = ""
    ratio: float | None = None
    target: str = ""
    met: bool | None = None
    note: str = ""


def at_most(limit: float, value: float, what: str = "") -> dict[str, Any]:
    """The fields `target` and `met` of a row whose target is a `value` of at most `limit`."""
    return {"target": f"<= {limit:g}{what}", "met": bool(value <= limit)}


def at_least(limit: float, value: float, what: str = "") -> dict[str, Any]:
    """The fields `target` and `met` of a row whose target is a `value` of at least `limit`."""
    return {"target": f">= {limit:g}{what}", "met": bool(value >= limit)}


class Screen:
    """The printed table. Columns have fixed widths, because each line is printed before the next is measured."""

    COLUMNS = (("figure", 46), ("value", 16), ("floor or peer", 38), ("ratio", 7), ("target", 20), ("met", 4))

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(highlight=False)
        if not self.console.is_terminal:
            self.console.width = 180
        self._group = ""
        self._line(*(f"[bold]{name}" for name, _ in self.COLUMNS), "[bold]note")

    def show(self, row: Row) -> None:
        """Print one row, preceded by its group's name if the group changes."""
        if row.group != self._group:
            self._group = row.group
            self.console.print(f"[bold]{row.group}")
        value = "-" if row.value is None else f"{shown(row.value)} {row.unit}"
        peer = row.against if row.peer is None else f"{shown(row.peer)} {row.unit}, {row.against}"
        ratio = "" if row.ratio is None else shown(row.ratio)
        met = {None: "", True: "[green]yes", False: "[red]no"}[row.met]
        self._line(f"  {row.name}", value, peer, ratio, row.target, met, row.note)

    def _line(self, *cells: str) -> None:
        table = Table(box=None, show_header=False, pad_edge=False, expand=True)
        for (_, width), justify in zip(self.COLUMNS, ("left", "right", "left", "right", "left", "left"), strict=True):
            table.add_column(width=width, justify=justify)
        table.add_column(ratio=1)
        table.add_row(*cells)
        self.console.print(table)


def shown(value: float) -> str:
    """The value with three significant digits, or rounded to an integer from 1,000 on."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def record(rows: Sequence[Row], groups: Sequence[str], quick: bool, seconds: float, facts: dict[str, Any]) -> bytes:
    """The content of the JSON file."""
    content = {
        "quick": quick,
        "groups": list(groups),
        "seconds": round(seconds, 1),
        "machine": facts,
        "targets_met": sum(row.met is True for row in rows),
        "targets_missed": sum(row.met is False for row in rows),
        "rows": [
            {name: float(f"{cell:.4g}") if isinstance(cell, float) else cell for name, cell in row._asdict().items()}
            for row in rows
        ],
    }
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def machine(threads: int) -> dict[str, Any]:
    """What the measurements depend on: processor, threads, versions, and the load of the machine at the start."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = [line for line in information.read_text().splitlines() if line.startswith("model name")]
        model = names[0].split(":", 1)[1].strip() if names else model
    blas = [pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"]
    facts: dict[str, Any] = {
        "processor": model,
        "vector_instructions": torch.backends.cpu.get_cpu_capability(),
        "cores": os.cpu_count(),
        "threads": threads,
        "numpy_blas_threads": max(blas, default=None),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "load_at_start": round(os.getloadavg()[0], 2),
        "versions": {"python": platform.python_version()},
    }
    for package in ("rbfevo", "torch", "numpy", "scipy", "numba", "pymoo", "cma"):
        try:
            facts["versions"][package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return facts
