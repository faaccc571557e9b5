"""A line for whoever waits for a compiler: numba translates the evaluator once for each kind of processor."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

WORDS = "compiling the evaluator for this processor: about 10 s, once"
_listeners: list[Callable[[str], None]] = []


@contextlib.contextmanager
def heard(listener: Callable[[str], None]) -> Iterator[None]:
    """Call `listener` with one line when a compilation begins within the block; once, however many there are."""
    _listeners.append(listener)
    try:
        yield
    finally:
        if listener in _listeners:
            _listeners.remove(listener)


def begins() -> None:
    """Tell all listeners; `rbfevo.scoring.fused` calls it where nothing is found in numba's cache."""
    while _listeners:
        _listeners.pop()(WORDS)
