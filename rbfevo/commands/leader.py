"""What SIGINT and SIGTERM do to the main process of a sweep, and to the processes that it has started."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from pathlib import Path
from types import FrameType
from typing import Any

from rbfevo.commands import jobs


class Leader:
    """What SIGINT and SIGTERM do to the main process of a sweep, where no job runs in this process.

    The first one stops the jobs in the processes that a launcher has started on this machine, and waits until they have
    saved what they have found; a second one does not wait.

    Args:
        place: for the outcomes of this start of the sweep.

    Attributes:
        code: 128 and the number of the first of them, None without one.
    """

    def __init__(self, place: Path) -> None:
        self.code: int | None = None
        self._place = place
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Leader:
        with contextlib.suppress(ValueError):  # not the main thread
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.code is None:
            self.code = 128 + number
            if multiprocessing.active_children():
                with contextlib.suppress(OSError):  # the jobs have ended already, and their place is gone
                    (self._place / jobs.STOP).touch()
            if self._running():
                os.write(2, b"rbfevo: stopping; the jobs that run save their results so far\n")
            while self._running():
                time.sleep(0.1)
        raise KeyboardInterrupt

    def _running(self) -> bool:
        alive = {child.pid for child in multiprocessing.active_children()}
        return any(outcome.code is None and outcome.process in alive for outcome in jobs.outcomes(self._place))
