"""Threads over slices of a population: few large pieces of work, instead of every small operation cut in pieces."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Result = TypeVar("Result")
_place = threading.local()  # threads: how many the caller of `coarse` in this thread had


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rbfevo")


def run_in_slices(work: Callable[[int, int], None], count: int) -> None:
    """Call work(begin, end) on slices that make up range(count), on as many threads as torch would use.

    Every element's result must not depend on the slice that it falls in. Within a slice, further slices are not cut.
    """
    with coarse() as threads:
        step = count if threads == 1 else -(-count // (4 * threads))
        _run(work, count, step, threads)


def results_of_slices(work: Callable[[slice], Result], count: int, most: int) -> list[Result]:
    """The results of work(rows) on slices of range(count), in order; `most` elements need no slices.

    Work is as of `run_in_slices`, but consists of many small operations. Threads that share these wait for each other
    more than they gain until the elements are large.
    """
    found: dict[int, Result] = {}

    def piece(begin: int, end: int) -> None:
        found[begin] = work(slice(begin, end))

    with coarse() as threads:
        _run(piece, count, count if count <= most else min(most, -(-count // threads)), threads)
    return [found[begin] for begin in sorted(found)]


def _run(work: Callable[[int, int], None], count: int, step: int, threads: int) -> None:
    """Call work(begin, end) on slices of `step` elements; with nothing to do, or one slice, on the calling thread."""
    if count <= max(step, 1):
        work(0, count)
        return
    cuts = [(begin, min(begin + step, count)) for begin in range(0, count, step)]
    if threads == 1:
        for begin, end in cuts:
            work(begin, end)
        return

    def piece(begin: int, end: int) -> None:
        if not hasattr(_place, "threads"):  # a thread of the pool, which never has more than one
            torch.set_num_threads(1)
            _place.threads = 1
        work(begin, end)

    futures = [_pool(threads).submit(piece, begin, end) for begin, end in cuts]
    for future in futures:
        future.result()


@contextlib.contextmanager
def coarse() -> Iterator[int]:
    """Leave torch one thread for each operation and give the others to `run_in_slices`; yields their number.

    The operations of a generation are so small that waking threads for each of them costs more than it brings, and on
    a busy machine many times more. And an operation that threads share may round by how it is cut between them: so
    whatever has to be the same for any number of threads, and for any batch, runs inside. Torch and MKL count the
    threads of an operation for each thread that calls it: so does this.
    """
    if hasattr(_place, "threads"):
        yield _place.threads
        return
    threads = _place.threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield threads
    finally:
        del _place.threads
        torch.set_num_threads(threads)
