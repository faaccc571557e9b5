"""What a run leaves on disk while it works: its history, line by line, and checkpoints to go on from."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rbfevo.errors import UserError
from rbfevo.files import csv_text, write_whole
from rbfevo.methods.method import HistoryLine
from rbfevo.runs import checkpoint

HISTORY = "history.csv"
GROWING = f".{HISTORY}"  # the history of a run that is not done
BUFFER = 65_536  # bytes of history that wait to be written


class Journal:
    """The history and the checkpoints of one run directory.

    A disk that is full for a while does no harm: the history waits in memory, and checkpoints are tried again.

    Args:
        directory: the run directory; every: seconds between checkpoints, None for none but the first and the last.
        facts: what every checkpoint holds beside the progress (settings, versions), no arrays.
        saved: the checkpoint that the run continues from, or None.

    Attributes:
        complaint: the last thing that went wrong, in one line, or None; whoever prints it sets it to None.

    Raises:
        UserError: if the directory cannot be written to, or the history does not belong to `saved`.
    """

    def __init__(
        self, directory: Path, every: float | None, facts: dict[str, Any], saved: dict[str, Any] | None = None
    ) -> None:
        self.directory, self.every, self.facts = directory, every, facts
        self.complaint: str | None = None
        self._path = directory / GROWING
        self._pending = b"" if saved else csv_text(HistoryLine._fields, [])
        self._offset = int(saved["history"]) if saved else 0
        if saved:
            self._continue()
        self._fresh = saved is None and not (directory / checkpoint.NAME).exists()  # to be removed if nothing begins
        if self._fresh:
            checkpoint.save(directory, {**facts, "history": 0, "finished": False, "progress": None})
        self._last = time.monotonic()

    def _continue(self) -> None:
        """See that the history goes as far as the checkpoint; of a run that has results it is `HISTORY`."""
        path = self._path if self._path.exists() else self.directory / HISTORY
        try:
            length = path.stat().st_size
        except OSError as error:
            raise UserError(f"{path} cannot be read ({error.strerror or error}): start a new run") from None
        if length < self._offset:
            raise UserError(f"{path} is shorter than the checkpoint requires (was it changed?); start a new run")

    def record(self, records: Sequence[HistoryLine]) -> None:
        """Add lines to the history."""
        self._pending += csv_text(None, records)
        if len(self._pending) > BUFFER:
            with contextlib.suppress(UserError):  # it waits until there is room; the next checkpoint warns
                self._write()

    def due(self) -> bool:
        """Whether it is time for a checkpoint."""
        return self.every is not None and time.monotonic() - self._last >= self.every

    def keep(self, progress: dict[str, Any], finished: bool = False) -> bool:
        """Write history and checkpoint; return whether that went well. What was on disk stays valid if not."""
        self._last = time.monotonic()
        try:
            self._write()
            state = {**self.facts, "history": self._offset, "finished": finished, "progress": progress}
            checkpoint.save(self.directory, state)
            self._fresh = False
        except UserError as error:
            self.complaint = f"no checkpoint: {error}"
        return not self._pending and self.complaint is None

    def _write(self) -> None:
        """Append what waits, on the disk itself."""
        if not self._pending:
            return
        try:
            if self._offset and not self._path.exists():
                shutil.copyfile(self.directory / HISTORY, self._path)
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)  # Windows changes line ends without it
            with os.fdopen(os.open(self._path, flags, 0o644), "r+b") as file:
                file.truncate(self._offset)
                file.seek(self._offset)
                file.write(self._pending)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise UserError(f"{self._path} cannot be written: {error.strerror or error}") from None
        self._offset += len(self._pending)
        self._pending = b""

    def publish(self) -> None:
        """Write history.csv, whole; what is added later goes on from it.

        Raises:
            UserError: if it cannot be written.
        """
        self._write()
        path = self._path if self._path.exists() else self.directory / HISTORY
        try:
            with path.open("rb") as file:
                content = file.read(self._offset)
        except OSError as error:
            raise UserError(f"{path} cannot be read: {error.strerror or error}") from None
        write_whole(self.directory / HISTORY, content)

    def discard(self) -> None:
        """Remove the first checkpoint of a run that never began; one that was there, or holds progress, stays."""
        if self._fresh:
            (self.directory / checkpoint.NAME).unlink(missing_ok=True)

    def close(self) -> None:
        """Remove the growing history of a run that is done: history.csv holds all of it."""
        self._path.unlink(missing_ok=True)
