"""The search that follows the painting: one task after the other, and what the page says of it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfevo.arrays import Array
from rbfevo.studio.choices import Choices
from rbfevo.studio.painting import Painting
from rbfevo.studio.process import Failure, Lost, SearchProcess

if TYPE_CHECKING:
    from rbfevo.studio.searching import Front


class Follower:
    """Searches what is painted, in a process that is started when there is something to search.

    Args:
        page: the variables of the page; file: where the process writes the mesh; found: takes each new front.
    """

    def __init__(self, page: Any, file: Path, found: Callable[[Front], None]) -> None:
        self._page, self._file, self._found = page, file, found
        self._number = 0  # of the last task
        self._process: SearchProcess | None = None

    def start(self, painting: Painting, choices: Choices) -> None:
        """Start the process, so that the first stroke does not wait for it."""
        if self._process is None:
            loop = asyncio.get_running_loop()

            def hear(message: object) -> None:
                """Hand a message over to the thread of the page."""
                loop.call_soon_threadsafe(self._hear, message)

            self._process = SearchProcess(painting.vertices, painting.triangles, self._file, choices, hear)

    def search(self, painting: Painting, choices: Choices, known: Array | None = None) -> None:
        """Search what is painted now, with other setups to begin with, or those of the search before."""
        from rbfevo.studio.searching import Task

        if painting.empty:
            self.stop()
            self._number += 1  # what is still on its way is no longer asked for
            self._page.searching = "Nothing is painted that may move."
            return
        self.start(painting, choices)
        self._number += 1
        if self._process is not None:
            self._process.ask(Task(self._number, painting.field.copy(), painting.held.copy(), choices, known))
        self._page.busy, self._page.progress, self._page.searching = True, 0.0, "Scoring the known setups…"

    def _hear(self, message: object) -> None:
        """A front, or bad news, from the process."""
        from rbfevo.studio.searching import Front

        page = self._page
        if isinstance(message, Lost):
            self._process, page.busy = None, False
            page.problem = f"the process of the search has ended ({message.code}); the next stroke starts another one"
        elif isinstance(message, Failure) and message.number == self._number:
            page.busy, page.problem, page.searching = False, message.reason, "The search could not be done."
        elif isinstance(message, Front) and message.number == self._number:
            page.busy, page.progress = not message.settled, message.step / message.steps
            done = "Done" if message.settled else "Searching"
            failed = f", {message.failed} failed" if message.failed else ""
            page.searching = (
                f"{done}: {len(message.record.regularity)} setups, hypervolume {message.hypervolume:.4f}, "
                f"{message.evaluations} evaluations{failed}"
            )
            self._found(message)
        page.flush()

    def stop(self) -> None:
        """Stop the search; what it has found stays."""
        if self._process is not None:
            self._process.stop()
        if self._page.busy:
            self._page.busy, self._page.searching = False, f"Stopped. {self._page.searching}"

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.close()
            self._process = None
