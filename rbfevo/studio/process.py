"""The search in a process of its own, so that the page never waits for it."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rbfevo.arrays import Points, Triangles
from rbfevo.errors import UserError
from rbfevo.studio.choices import Choices

if TYPE_CHECKING:
    from rbfevo.studio.searching import Search, Task

STOP = "stop"


class Failure(NamedTuple):
    """A task, by its number, that could not be searched, and why in one line."""

    number: int
    reason: str


class Lost(NamedTuple):
    """The process has ended by itself."""

    code: int | None


class SearchProcess:
    """A process that searches one task after the other; a new one takes the place of the one before.

    Args:
        vertices, triangles, file: as `Search` takes them; choices: for `Search.prepare`.
        hear: takes each `Front`, `Failure` and `Lost`, in a thread of its own.
    """

    def __init__(
        self, vertices: Points, triangles: Triangles, file: Path, choices: Choices, hear: Callable[[object], None]
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(
            target=serve, args=(other, vertices, triangles, file, choices), name="rbfevo-search", daemon=True
        )
        self._process.start()
        other.close()
        self._closing = False
        self._thread = threading.Thread(target=self._listen, args=(hear,), name="rbfevo-fronts", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return self._process.pid

    def _listen(self, hear: Callable[[object], None]) -> None:
        """Hand over what the process sends, until it ends."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                hear(self._connection.recv())
        if not self._closing:
            self._process.join(10.0)
            hear(Lost(self._process.exitcode))

    def ask(self, task: Task | str | None) -> None:
        """Search a `Task`, in the place of the one before."""
        with contextlib.suppress(OSError):  # a lost process is heard of
            self._connection.send(task)

    def stop(self) -> None:
        """End the search of the task; what it has found stays."""
        self.ask(STOP)

    def close(self) -> None:
        """End the process."""
        self._closing = True
        self.ask(None)
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join(5.0)
        self._connection.close()


def serve(connection: Connection, vertices: Points, triangles: Triangles, file: Path, choices: Choices) -> None:
    """What the process does: take tasks, send fronts, until it is asked to end or the studio is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program that has started it
    from rbfevo.studio.searching import Search

    search = Search(vertices, triangles, file)
    with contextlib.suppress(UserError):  # a stroke will tell
        search.prepare(choices)
    with contextlib.suppress(EOFError, OSError):
        while (message := connection.recv()) is not None:
            while connection.poll():  # only the newest counts
                message = connection.recv()
            if message is None:
                return
            if message != STOP:
                _carry_out(search, message, connection)


def _carry_out(search: Search, task: Task, connection: Connection) -> None:
    """Search one task until it is done or the next message is there."""
    try:
        connection.send(search.take(task))
        for front in search.improve(task, connection.poll):
            connection.send(front)
    except UserError as error:
        connection.send(Failure(task.number, str(error)))
    except (OSError, EOFError):
        raise
    except Exception as error:  # the page shows it, and the next stroke is searched again
        traceback.print_exc()
        connection.send(Failure(task.number, f"the search failed: {type(error).__name__}: {error}"))
