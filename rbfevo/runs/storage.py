"""The run directory: each file is written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rbfevo.files import csv_text, npz, write_whole
from rbfevo.methods.method import Rows
from rbfevo.runs.directory import RESULTS, refuse_results
from rbfevo.runs.judged import Judged
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.combination import ONE
from rbfevo.scoring.pareto import nondominated
from rbfevo.scoring.representations import RBF, Representation

__all__ = [
    "RESULTS",
    "csv_text",
    "npz",
    "refuse_results",
    "setup_table",
    "write_scenario",
    "write_sequence",
    "write_setups",
    "write_summary",
    "write_whole",
]


def setup_table(
    rows: Sequence[Rows],
    representation: Representation,
    dimension: int = 2,
    judged: Sequence[Judged] | None = None,
) -> dict[str, np.ndarray]:
    """The arrays of `setups.npz`: all rows of all methods, `nondominated` among all of them.

    Where another potential than P was searched, or several objectives were, `judged` are the rows with those: it is
    `bounded_potential`, or the `worst_potential` of several, that decides which rows are nondominated. `potentials`
    and `bounded_potentials` [p, J] are those of each objective.

    `label` [p] names the setups that have a name of their own; it is left out where none has.

    Of another representation than RBFs, `genotype` [p, D] are the setups, and `centers` [p, h, dimension] where their
    control points sit.
    """
    method = np.array([series.method for series in rows for _ in range(len(series.centers))], dtype=np.str_)

    def joined(parts: Iterable[torch.Tensor]) -> np.ndarray:
        return torch.cat(list(parts)).cpu().to(torch.float64).numpy()

    made = [Judged(series, None, None, ONE) for series in rows] if judged is None else judged
    columns = [one.columns() for one in made]

    labels = [label for series in rows for label in (series.labels or [""] * len(series.centers))]
    objectives = torch.cat([one.searched.objectives for one in made])
    failed = torch.cat([series.scores.failed for series in rows])
    setups = torch.cat([series.centers for series in rows]).cpu()
    handles = representation.handles(setups)
    places = {"centers": setups.new_zeros(len(setups), 0, dimension) if handles is None else handles}
    if not isinstance(representation, RBF):
        places["genotype"] = setups
    return {
        **{name: array.to(torch.float64).numpy() for name, array in places.items()},
        "regularity": joined(series.scores.regularity for series in rows),
        **{name: joined(column[name] for column in columns) for name in columns[0]},
        "variability": joined(series.scores.variability for series in rows),
        "method": method,
        "preference": joined(series.preference for series in rows),
        "nondominated": (nondominated(objectives) & ~failed).cpu().numpy(),
        **({"label": np.array(labels, dtype=np.str_)} if any(labels) else {}),
    }


def write_setups(directory: Path, table: dict[str, np.ndarray], objectives: Sequence[str] = ()) -> None:
    """Write `setups.npz` and, without the centers, `setups.csv`, with a column for each potential of `objectives`."""
    write_whole(directory / "setups.npz", npz(table))
    columns: dict[str, np.ndarray] = {}
    for name, array in table.items():
        if name in ("potentials", "bounded_potentials"):
            titles = [f"{name.removesuffix('s')}_{objective}" for objective in objectives]
            columns |= dict(zip(titles, array.T, strict=True))
        elif name not in ("centers", "genotype"):
            columns[name] = array
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    write_whole(directory / "setups.csv", csv_text(list(columns), rows))


def write_sequence(directory: Path, table: dict[str, np.ndarray]) -> None:
    """Write `sequence.csv`: a line for each number of centers."""
    rows = zip(*(column.tolist() for column in table.values()), strict=True)
    write_whole(directory / "sequence.csv", csv_text(list(table), rows))


def scenario_arrays(scenario: Scenario) -> dict[str, np.ndarray]:
    """The arrays of `scenario.npz`: what the scores of the setups can be computed from."""
    names = ("vertices", "faces", "gradient", "weights", "lower", "upper")
    arrays = {name: getattr(scenario, name).cpu().numpy() for name in names}
    if scenario.stays is not None:
        arrays["stays"] = scenario.stays.cpu().numpy()
    if scenario.hold is not None and scenario.blend is not None:
        arrays["blend"], arrays["held"] = scenario.blend.cpu().numpy(), scenario.hold.points
    if scenario.max_displacement is not None:
        arrays["max_displacement"] = scenario.max_displacement.cpu().numpy()
    if scenario.objectives is not None:
        arrays["gradients"] = scenario.fields.cpu().numpy()
    if scenario.gradient_raw is not None:
        arrays["gradient_raw"] = scenario.gradient_raw.cpu().numpy()  # before smoothing
    if scenario.rows is not None:
        arrays["rows"] = scenario.rows.numpy()  # which points of the template's file the vertices are
    return arrays


def write_scenario(directory: Path, scenario: Scenario) -> None:
    """Write `scenario.npz`."""
    write_whole(directory / "scenario.npz", npz(scenario_arrays(scenario)))


def write_summary(directory: Path, summary: dict[str, Any]) -> None:
    """Write `summary.json`."""
    write_whole(directory / "summary.json", (json.dumps(summary, indent=2, allow_nan=False) + "\n").encode())
