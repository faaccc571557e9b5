"""The names of what a run leaves in its directory, and that none of it is overwritten; without torch and NumPy."""

from __future__ import annotations

import shlex
from pathlib import Path

from rbfevo import names
from rbfevo.errors import UserError
from rbfevo.files import refuse_held

CHECKPOINT = "checkpoint.npz"
RESULTS = (
    *("setups.npz", "setups.csv", "sequence.csv", "history.csv", "scenario.npz", "summary.json"),
    *("front.png", "centers.png", "report.html"),
)


def refuse_results(directory: Path) -> None:
    """Raise UserError if the directory already holds results, or a run that is not done: nothing is overwritten."""
    refuse_held(directory, RESULTS, "hydra.run.dir")
    if (directory / CHECKPOINT).exists():
        raise UserError(
            f"{directory} holds an unfinished run: continue it with {resuming(directory)}, or choose another "
            "hydra.run.dir"
        )


def resuming(directory: Path) -> str:
    """The word with which `python -m rbfevo` goes on with a run, as one types it into a shell."""
    plain = names.name_of(str(directory)) == str(directory)
    return shlex.quote(f"resume={directory}" if plain else names.override("resume", directory))
