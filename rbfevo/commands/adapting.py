"""`--adapt`: more centers beside those of a descent, where the setup reaches too little of the sensitivity by now.

The old centers stay (`keep=`), so each old design is a design of the new setup, with weights of 0 for the new centers.
"""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from omegaconf import OmegaConf

from rbfevo import meshes, names
from rbfevo.arrays import Array
from rbfevo.descent import Descent, Solved, State
from rbfevo.errors import UserError
from rbfevo.files import csv_text, write_whole
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import Setup, setup
from rbfevo.runs.source import settings_of

FALLEN = 0.5  # of the gain at first
SAME = 1e-10  # of the diagonal: displacements of one design by the old and the new setup
REPLACED = (
    *("keep", "centers", "figures", "quiet", "resume", "checkpoint.every", "method.start", "scenario.template"),
    *("scenario.sensitivity", "scenario.sensitivity_kind", "scenario.sensitivity_normal", "scenario.sensitivity_match"),
)


class Adapted(NamedTuple):
    """What came of it: the name of the new run in the directory of the state, or None; the setup, and lines."""

    run: str | None
    record: Record
    chosen: Setup
    state: State
    lines: list[str]


def adapted(run: Path, row: int) -> tuple[Record, Setup]:
    """A run and a setup of it."""
    record = read(run)
    return record, setup(record, row)


def adapt(descent: Descent, run: Path, choice: str, where: Path, done: int, count: int) -> Adapted:
    """Compare the gain that the setup can reach with that at first, and search more centers if it has fallen by half.

    Args:
        run: of the descent's setup; choice: the pick; where: the directory of the state.
        done: how often this was done before; count: how many centers to add, 0 for half as many as there are.

    Raises:
        UserError: if the search fails, or the new setup does not hold the old designs.
    """
    record, chosen, state = descent.record, descent.chosen, descent.state
    gain = descent.gain
    if state.first_gain is None:
        state = dataclasses.replace(state, first_gain=gain)
    first = state.first_gain or gain
    line = f"the setup can reach {gain:.3f} of the gain that is possible, {first:.3f} at first"
    if gain > FALLEN * first:
        return Adapted(None, record, chosen, state, [line])
    if chosen.kernel is None:
        raise UserError("--adapt adds centers of RBFs, and this run has another representation; leave it out")
    if not chosen.plain:
        raise UserError("--adapt adds centers of RBFs without a polynomial; leave it out")
    m = len(chosen.centers)
    count = count or max(1, m // 2)
    name = f"adapted-{done + 1}"
    _search(record, chosen, run, where, name, m + count, state)
    record_of_new = read(where / name)
    new = setup(record_of_new, pick(record_of_new, choice))
    extended = carried_over(descent, record_of_new, new)
    found = Descent(record_of_new, new, extended, descent.segments)
    extended = dataclasses.replace(extended, first_gain=found.gain)
    lines = [line, f"{count} centers were added: the setup of {where / name} can reach {found.gain:.3f}"]
    return Adapted(name, record_of_new, new, extended, lines)


def carried_over(descent: Descent, record: Record, new: Setup) -> State:
    """The state of a descent with a setup that begins with its centers; slopes of quasi-Newton begin anew.

    Raises:
        UserError: if a displacement would not be the same.
    """
    old, state, m = descent.chosen, descent.state, len(descent.chosen.centers)
    same = (
        np.array_equal(record.vertices, descent.record.vertices)
        and np.array_equal(new.centers[:m], old.centers)
        and np.array_equal(new.on_plane[:m], old.on_plane)
    )
    best = state.best
    if not same or best is None:
        raise UserError("the new setup does not begin with the old centers on the same design, so it is not taken")

    def longer(weights: Array) -> Array:
        return np.vstack([weights, np.zeros((new.count - m, weights.shape[1]))])

    before = descent.displacement(best.weights)
    after = new.displacement(record.vertices, longer(best.weights))
    if np.abs(after - before).max() > SAME * descent.diagonal:
        raise UserError("the new setup does not displace the best design as the old one does, so it is not taken")
    solved = Solved(best.number, longer(best.weights), best.objective, best.sensitivity)
    return dataclasses.replace(state, best=solved, slopes=())


def _search(record: Record, chosen: Setup, run: Path, where: Path, name: str, total: int, state: State) -> None:
    """Make a run with the settings of the one before, on the best design's sensitivity, with its centers kept."""
    best, template = state.best, str(settings_of(run).scenario["template"])
    if best is None:
        raise UserError("the original design has no solution yet")
    kept, values = where / f"{name}-centers.csv", where / f"{name}-sensitivity.npy"
    write_whole(kept, csv_text(["x", "y", "z"], chosen.centers.tolist()))
    write_whole(values, _npy(best.sensitivity))
    shutil.rmtree(where / name, ignore_errors=True)  # of a search that was killed
    if meshes.is_case(Path(template)):
        template = str(Path(template) / "constant")
    arguments = [
        *(f"{given}" for given in _overrides(run)),
        *(names.override("scenario.template", template), names.override("scenario.sensitivity", values)),
        *("scenario.sensitivity_kind=nodal", names.override("keep", kept), f"centers={total}"),
        *("figures=false", "quiet=true", names.override("hydra.run.dir", where / name)),
    ]
    done = subprocess.run([sys.executable, "-m", "rbfevo", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise UserError(f"--adapt: the search for more centers failed: {reason.removeprefix('rbfevo: ')}")


def _overrides(run: Path) -> list[str]:
    """The overrides of a run that stay as they are."""
    listed = OmegaConf.load(run / ".hydra" / "overrides.yaml")
    found = [str(one) for one in listed]
    kept = [one for one in found if one.lstrip("+~").partition("=")[0] not in REPLACED]
    kept = [one for one in kept if not one.startswith("hydra.")]
    if any(one == "method=given" for one in kept):
        kept = ["method=gradient", *(one for one in kept if not one.startswith("method"))]
    return kept


def _npy(values: Array) -> bytes:
    import io

    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()
