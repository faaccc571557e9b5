"""Files that appear whole or not at all, and the bytes of tables and archives."""

from __future__ import annotations

import csv
import io
import os
import re
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfevo.errors import UserError

if TYPE_CHECKING:
    import numpy as np


def refuse_held(directory: Path, files: Sequence[str], option: str) -> None:
    """Raise UserError if the directory already holds one of the results `files`: they are never overwritten."""
    held = [name for name in files if (directory / name).exists()]
    if held:
        raise UserError(f"{directory} already holds results ({held[0]}): choose another {option}, or move them away")


def refuse_missing(path: Path) -> None:
    """Raise UserError if there is no such file; other faults are found when it is read."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"{path}: no such file") from None
    except (OSError, ValueError):
        pass


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


_UNFINISHED = re.compile(r"\.[\w-]+\.(npz|csv|json|yaml|html|png)\.\w{8}")


def clear_unfinished(directory: Path) -> None:
    """Remove the unfinished files of killed processes from a directory in which no other process works."""
    for path in directory.glob(".*"):
        if _UNFINISHED.fullmatch(path.name):
            path.unlink(missing_ok=True)


def npz(arrays: dict[str, np.ndarray]) -> bytes:
    """A compressed .npz archive as bytes; no array needs pickle to be read."""
    import numpy as np  # not before there is something to write: command lines are read without it

    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def csv_text(names: Sequence[str] | None, lines: Iterable[Sequence[Any]]) -> bytes:
    """A CSV table as bytes, without a header if `names` is None; floats keep all digits, NaN is an empty cell."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    if names is not None:
        writer.writerow(names)
    writer.writerows(["" if isinstance(cell, float) and cell != cell else cell for cell in line] for line in lines)
    return buffer.getvalue().encode()
