"""Threads over slices of a population: few large pieces of work, instead of every small operation cut in pieces."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import torch

_place = threading.local()  # threads: how many the caller of `coarse` in this thread had


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rbfevo")


def run_in_slices(work: Callable[[int, int], None], count: int) -> None:
    """Call work(begin, end) on slices that make up range(count), on as many threads as torch would use.

    Every element's result must not depend on the slice that it falls in. Within a slice, further slices are not cut.
    """
    with coarse() as threads:
        if threads == 1 or count <= 1:
            work(0, count)
            return

        def piece(begin: int, end: int) -> None:
            if not hasattr(_place, "threads"):  # a thread of the pool, which never has more than one
                torch.set_num_threads(1)
                _place.threads = 1
            work(begin, end)

        step = max(1, -(-count // (4 * threads)))
        futures = [_pool(threads).submit(piece, i, min(i + step, count)) for i in range(0, count, step)]
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
