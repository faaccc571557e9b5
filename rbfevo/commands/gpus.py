"""One GPU for each job that runs beside others: which one, CUDA learns from CUDA_VISIBLE_DEVICES."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import filelock

VISIBLE = "CUDA_VISIBLE_DEVICES"
_held: list[filelock.BaseFileLock] = []  # until this process ends


def take(place: Path) -> None:
    """Take one GPU for this process and all its jobs, one that fewest of the processes that share `place` have taken.

    Nothing happens where there is one GPU or none. CUDA must not be in use yet.
    """
    gpus = visible()
    if len(gpus) < 2 or _held:
        return
    for turn in itertools.count():
        for number, gpu in enumerate(gpus):
            lock = filelock.FileLock(place / f"gpu-{number}-{turn}", timeout=0)
            try:
                lock.acquire()
            except filelock.Timeout:
                continue
            _held.append(lock)
            os.environ[VISIBLE] = gpu
            return


def choose(number: int) -> None:
    """Choose one GPU for the job of this number, where SLURM shows several to it."""
    gpus = visible()
    if len(gpus) > 1:
        os.environ[VISIBLE] = gpus[number % len(gpus)]


def visible() -> list[str]:
    """The GPUs that CUDA shows to this process, as CUDA_VISIBLE_DEVICES names them."""
    if VISIBLE in os.environ:
        return [gpu.strip() for gpu in os.environ[VISIBLE].split(",") if gpu.strip()]
    import torch

    return [str(gpu) for gpu in range(torch.cuda.device_count())]  # which does not start CUDA
