"""Times and memory on a noisy machine: interleaved rounds, medians of ratios, and child processes for peak memory."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

Task = Callable[[], float]  # does its work once and returns the measured seconds

# BLAS threads spin for some tens of milliseconds after their last product and would slow down the next task.
PAUSE = 0.05


def timed(work: Callable[[], object]) -> Task:
    """The task that calls `work` and returns its seconds."""

    def task() -> float:
        """Call `work` once and return its seconds."""
        start = time.perf_counter()
        work()
        return time.perf_counter() - start

    return task


def interleaved(tasks: Sequence[Task], rounds: int, pause: float = PAUSE) -> NDArray[np.float64]:
    """Seconds [tasks, rounds]; every round does all tasks, in alternating order, after one warm-up round.

    Other load on the machine affects all tasks of a round about equally, so compare them within the rounds.
    """
    seconds = np.empty((len(tasks), rounds + 1))
    for i in range(rounds + 1):
        numbers = range(len(tasks))
        for j in numbers if i % 2 else reversed(numbers):
            time.sleep(pause)
            seconds[j, i] = tasks[j]()
    return seconds[:, 1:]


def one_blas_thread(task: Task) -> Task:
    """The same task with one BLAS thread: much faster on a busy machine, where threads would wait for each other."""

    def limited() -> float:
        """Do the task with one BLAS thread."""
        with threadpoolctl.threadpool_limits(1, user_api="blas"):
            return task()

    return limited


def fastest(seconds: NDArray[np.float64]) -> int:
    """The index of the task with the smallest median; `seconds` is [tasks, rounds]."""
    return int(np.median(seconds, axis=1).argmin())


def median(values: NDArray[np.float64]) -> float:
    """The median as a float."""
    return float(np.median(values))


def in_child(function: Callable[..., Any], **arguments: Any) -> Any:
    """Call a module's function in a new process; arguments and result must be JSON values.

    Raises:
        subprocess.CalledProcessError: if the child fails; its messages go to stderr.
    """
    code = (
        "import importlib, json, sys\n"
        "module, name, arguments = json.load(sys.stdin)\n"
        "print(json.dumps(getattr(importlib.import_module(module), name)(**arguments)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps([function.__module__, function.__name__, arguments]),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        cwd=Path(__file__).parents[1],
    )
    return json.loads(done.stdout.splitlines()[-1])


def peak_memory() -> float:
    """The peak resident memory of this process in MB (10^6 bytes)."""
    # ru_maxrss survives exec on Linux: a child would start with its parent's peak.
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
