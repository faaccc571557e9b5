"""One process at a time in a run directory."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import filelock

from rbfevo.errors import UserError

NAME = ".lock"


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Hold the lock of a directory, which is made if it is not there; the same process may hold it more than once.

    The operating system lets go of it when the process ends, however that happens.

    Raises:
        UserError: if another process holds it, or the directory cannot be written to.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(directory.resolve() / NAME, timeout=0, is_singleton=True)
        lock.acquire()
    except filelock.Timeout:
        raise UserError(
            f"{directory} is in use: another process is working on this run; wait for it or stop it"
        ) from None
    except OSError as error:
        raise UserError(f"{directory} cannot be written: {error.strerror or error}") from None
    try:
        yield
    finally:
        lock.release()
