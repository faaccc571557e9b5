"""What Ctrl-C, a batch system's signals and the main process of a sweep do to a run."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

WARNING = getattr(signal, "SIGUSR2", None)  # submitit's, before SLURM ends a job; there is none on Windows
LOOK = 0.2  # seconds between two questions whether to stop


class Interruption:
    """Turns the first SIGINT or SIGTERM into a flag that a run looks at between steps; the second ends the process.

    SIGUSR2 does the same where something handles it, as submitit does to put a job into SLURM's queue again: that is
    left to whoever started the run. Other signals come along with it, and do not end the process.

    Args:
        stop: says whether to stop, which counts as SIGTERM; it can come along with signals.
    """

    def __init__(self, stop: Callable[[], bool] | None = None) -> None:
        self._received: int | None = None
        self._before: dict[int, Any] = {}
        self._stop, self._stopped, self._looked = stop, False, -LOOK

    @property
    def signal(self) -> int | None:
        """The signal that asks the run to stop, None without one."""
        if self._stop is not None and not self._stopped and time.monotonic() - self._looked >= LOOK:
            self._stopped, self._looked = self._stop(), time.monotonic()
        return signal.SIGTERM if self._received is None and self._stopped else self._received

    @signal.setter
    def signal(self, number: int) -> None:
        self._received = number

    def __enter__(self) -> Interruption:
        numbers = [signal.SIGINT, signal.SIGTERM]
        if WARNING is not None and callable(signal.getsignal(WARNING)):
            numbers.append(WARNING)
        try:
            for number in numbers:
                self._before[number] = signal.signal(number, self._note)
        except ValueError:  # not the main thread: whoever runs us there decides
            pass
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if number == WARNING or self._received is None:
            self._received = number
        elif self._received != WARNING:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
