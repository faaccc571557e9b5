"""Threads over slices of a population: few large pieces of work, instead of every small operation cut in pieces."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import torch

_workers: int | None = None


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rbfevo")


def run_in_slices(work: Callable[[int, int], None], count: int) -> None:
    """Call work(begin, end) on slices that make up range(count), on as many threads as torch would use.

    Every element's result must not depend on the slice that it falls in.
    """
    threads = torch.get_num_threads() if _workers is None else _workers
    if threads == 1 or count <= 1:
        work(0, count)
        return
    step = max(1, -(-count // (4 * threads)))
    futures = [_pool(threads).submit(work, i, min(i + step, count)) for i in range(0, count, step)]
    for future in futures:
        future.result()


@contextlib.contextmanager
def coarse() -> Iterator[int]:
    """Leave torch one thread for each operation and give the others to `run_in_slices`; yields their number.

    The operations of a generation are so small that waking threads for each of them costs more than it brings, and on
    a busy machine many times more.
    """
    global _workers
    before, threads = _workers, torch.get_num_threads()
    _workers = threads
    torch.set_num_threads(1)
    try:
        yield threads
    finally:
        _workers = before
        torch.set_num_threads(threads)
