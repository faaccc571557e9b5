"""The run directory: each file is written whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rbfevo.errors import UserError
from rbfevo.methods.stage import Record, Rows
from rbfevo.pareto import nondominated
from rbfevo.scenarios.scenario import Scenario

RESULTS = ("setups.npz", "setups.csv", "history.csv", "scenario.npz", "summary.json", "front.png", "centers.png")


def refuse_results(directory: Path, names: Sequence[str] = RESULTS, option: str = "hydra.run.dir") -> None:
    """Raise UserError if the directory already holds one of the results `names`: they are never overwritten."""
    held = [name for name in names if (directory / name).exists()]
    if held:
        raise UserError(f"{directory} already holds results ({held[0]}): choose another {option}, or move them away")


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it appears complete or not at all, even if the process dies meanwhile.

    Raises:
        UserError: if the file cannot be written there.
    """
    temporary = None
    try:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from error


def setup_table(rows: Sequence[Rows]) -> dict[str, np.ndarray]:
    """The arrays of `setups.npz`: all rows of all methods, `nondominated` among all of them."""
    method = np.array([series.method for series in rows for _ in range(len(series.centers))], dtype=np.str_)

    def joined(parts: Iterable[torch.Tensor]) -> np.ndarray:
        return torch.cat(list(parts)).cpu().to(torch.float64).numpy()

    objectives = torch.cat([series.scores.objectives for series in rows])
    failed = torch.cat([series.scores.failed for series in rows])
    return {
        "centers": joined(series.centers for series in rows),
        "regularity": joined(series.scores.regularity for series in rows),
        "improvement_potential": joined(series.scores.improvement_potential for series in rows),
        "variability": joined(series.scores.variability for series in rows),
        "method": method,
        "preference": joined(series.preference for series in rows),
        "nondominated": (nondominated(objectives) & ~failed).cpu().numpy(),
    }


def write_setups(directory: Path, table: dict[str, np.ndarray]) -> None:
    """Write `setups.npz` and, without the centers, `setups.csv`."""
    write_whole(directory / "setups.npz", npz(table))
    names = [name for name in table if name != "centers"]
    write_whole(directory / "setups.csv", csv_text(names, zip(*(table[name].tolist() for name in names), strict=True)))


def write_history(directory: Path, history: Sequence[Record]) -> None:
    """Write `history.csv`, one line per method, preference and generation."""
    write_whole(directory / "history.csv", csv_text(Record._fields, history))


def write_scenario(directory: Path, scenario: Scenario) -> None:
    """Write `scenario.npz`: what the scores of the setups can be computed from."""
    names = ("vertices", "faces", "gradient", "weights", "lower", "upper")
    write_whole(directory / "scenario.npz", npz({name: getattr(scenario, name).cpu().numpy() for name in names}))


def write_summary(directory: Path, summary: dict[str, Any]) -> None:
    """Write `summary.json`."""
    write_whole(directory / "summary.json", (json.dumps(summary, indent=2, allow_nan=False) + "\n").encode())


def npz(arrays: dict[str, np.ndarray]) -> bytes:
    """A compressed .npz archive as bytes; no array needs pickle to be read."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def csv_text(names: Sequence[str], lines: Iterable[Sequence[Any]]) -> bytes:
    """A CSV table as bytes; floats keep all their digits, NaN is an empty cell."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(["" if isinstance(cell, float) and cell != cell else cell for cell in line] for line in lines)
    return buffer.getvalue().encode()
