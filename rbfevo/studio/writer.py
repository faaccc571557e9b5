"""The buttons that write files: saving, export and apply, without the page waiting for them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rbfevo.errors import UserError
from rbfevo.studio import saving
from rbfevo.studio.keeping import State


class Writer:
    """Saves a state, unless nothing has changed since it was saved, and does more with the saved run.

    Args:
        page: the variables of the page.
    """

    def __init__(self, page: Any) -> None:
        self._page = page
        self._saved: tuple[saving.Saved, int] | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    def write(self, state: State, changes: int, act: Callable[[saving.Saved], str]) -> None:
        """Save a state, and then do something that returns a line for the page.

        Args:
            changes: a number that is another one whenever the state has changed.
        """
        if not self._page.writing:
            self._page.writing, self._page.written, self._page.problem = True, "writing…", ""
            task = asyncio.get_running_loop().create_task(self._written(state, changes, act))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _written(self, state: State, changes: int, act: Callable[[saving.Saved], str]) -> None:
        """What `write` does meanwhile."""
        page = self._page
        try:
            saved = self._saved[0] if self._saved is not None and self._saved[1] == changes else None
            if saved is None:
                saved = await asyncio.to_thread(saving.save, Path(str(page.directory)), state)
                self._saved = saved, changes
                page.commands = [saved.scores, saved.searches]
                page.directory = str(saving.free(saved.run))
            page.written = await asyncio.to_thread(act, saved)
        except UserError as error:
            page.problem, page.written = str(error), ""
        finally:
            page.writing = False
            page.flush()
