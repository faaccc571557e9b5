"""The state of a descent in a directory: `state.json`, and the sensitivity of the best design beside it."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.descent.state import VERSION, State
from rbfevo.errors import UserError
from rbfevo.files import clear_unfinished, npz, write_whole

FILE = "state.json"


def write(directory: Path, state: State, more: dict[str, Any]) -> None:
    """Write a state so that it is the old or the new one whenever the process dies.

    Args:
        more: entries of JSON beside those of the state.

    Raises:
        UserError: if it cannot be written.
    """
    name = None
    if state.best is not None:
        content = npz({"sensitivity": state.best.sensitivity})
        name = f"sensitivity-{state.best.number}-{hashlib.sha256(content).hexdigest()[:8]}.npz"
        if not (directory / name).exists():
            write_whole(directory / name, content)
    entries = {"version": VERSION, **more, "sensitivity": name, **state.entries()}
    write_whole(directory / FILE, (json.dumps(entries, indent=1) + "\n").encode())
    for old in directory.glob("sensitivity-*.npz"):
        if old.name != name:
            old.unlink(missing_ok=True)
    clear_unfinished(directory)


def read(directory: Path) -> tuple[State, dict[str, Any]] | None:
    """The state in a directory, and all entries of its file; None where there is none yet.

    Raises:
        UserError: if it is damaged, or of another version.
    """
    path = directory / FILE
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: damaged? ({' '.join(str(error).split())})") from None
    if not isinstance(entries, dict) or entries.get("version") != VERSION:
        raise UserError(f"{path} is no state of a descent of this version ({VERSION}); begin with another --state")
    name = entries.get("sensitivity")
    try:
        return State.of(entries, None if name is None else _array(directory / str(name))), entries
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def _array(path: Path) -> Array:
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            return archive["sensitivity"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path.name} cannot be read: {' '.join(str(error).split())}") from None
