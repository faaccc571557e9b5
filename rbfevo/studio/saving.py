"""From the page to files: a run directory of the setups, and what export and apply make of one of them."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.files import csv_text, refuse_held, write_whole
from rbfevo.runs.directory import RESULTS
from rbfevo.studio.keeping import FILE, State, keep
from rbfevo.studio.searching import write_mesh

MESH, CENTERS = "painted.vtp", "centers"


class Saved(NamedTuple):
    """A saved run: its directory, the command that scores its setups, and the one that searches the field anew."""

    run: Path
    scores: str
    searches: str


def save(run: Path, state: State) -> Saved:
    """Write the setups of a state as a run, with the painted mesh, and with all that opening it again needs.

    Raises:
        UserError: if there are none, the directory holds results, or the run fails.
    """
    if not len(state.centers):
        raise UserError("there is no front to save yet: paint where the mesh should move first")
    refuse_held(run, (*RESULTS, FILE), "directory")
    try:
        (run / CENTERS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{run} cannot be written: {error.strerror or error}") from None
    write_mesh(run / MESH, state.vertices, state.triangles, state.field, state.held)
    for number, centers in enumerate(state.centers):
        write_whole(run / CENTERS / f"setup-{number:03d}.csv", csv_text(["x", "y", "z"], centers.tolist()))
    arguments = state.choices.arguments(run / MESH, len(state.vertices), bool(state.held.any()))
    given = [*arguments, "method=given", f"method.centers={run / CENTERS}"]
    carried_out(["rbfevo", *given, f"hydra.run.dir={run}", "quiet=true"])
    keep(run, state)
    scores = ["python", "-m", "rbfevo", *given, f"hydra.run.dir={run}-again"]
    searches = ["python", "-m", "rbfevo", *arguments, "method=gradient", f"hydra.run.dir={run}-searched"]
    return Saved(run, shlex.join(scores), shlex.join(searches))


def export(saved: Saved, row: int) -> Path:
    """Export a setup of a saved run; return the directory.

    Raises:
        UserError: if that fails.
    """
    out = free(saved.run / f"export-{row}")
    carried_out(["rbfevo.export", str(saved.run), "--pick", f"index:{row}", "--out", str(out)])
    return out


def apply(saved: Saved, row: int, weights: Array, mesh: Path) -> Path:
    """Deform a mesh as the page shows it; return the file.

    Args:
        weights: [m, 3] of the setup's columns; mesh: the file that the painting began with.

    Raises:
        UserError: if that fails.
    """
    out = free(saved.run / f"deformed{mesh.suffix}")
    file = free(saved.run / "weights.npy")
    np.save(file, weights)
    pick = ["--pick", f"index:{row}", "--weights", str(file), "--mesh", str(mesh), "--out", str(out)]
    carried_out(["rbfevo.apply", str(saved.run), *pick])
    return out


def free(path: Path) -> Path:
    """A path, or the next one with a number that does not exist yet."""
    number, found = 2, path
    while found.exists():
        found, number = path.with_name(f"{path.stem}-{number}{path.suffix}"), number + 1
    return found


def carried_out(arguments: Sequence[str]) -> None:
    """Carry out `python -m` with these arguments.

    Raises:
        UserError: with the line that it ended with, if it failed.
    """
    done = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise UserError((done.stderr.strip().splitlines() or [f"{arguments[0]} ended with {done.returncode}"])[-1])
