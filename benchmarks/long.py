"""`python -m benchmarks.long`: 200,000 generations of a cheap problem; memory and time per generation must not grow.

The run is a separate process. Once a second its resident memory and the progress of its history on disk are sampled.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfevo.runs.journal import GROWING

OUTPUT = Path(__file__).parent / "long.csv"
OVERRIDES = (
    *("scenario=plane", "scenario.resolution=[12,12]", "centers=2", "method=nsga2", "method.population=4"),
    *("figures=false", "quiet=true", "evaluator=eager", "checkpoint.every=5"),
)


class Sample(NamedTuple):
    """The progress of a run: seconds since its start, generation, resident memory in MB, bytes of its history."""

    seconds: float
    generation: int
    resident: float
    history: int


def watched(generations: int, directory: Path) -> list[Sample]:
    """Carry out the run and sample it once a second.

    Raises:
        RuntimeError: if it fails.
    """
    arguments = [*OVERRIDES, f"method.generations={generations}", f"hydra.run.dir={directory}"]
    samples, start = [], time.monotonic()
    with subprocess.Popen([sys.executable, "-m", "rbfevo", *arguments]) as process:
        while process.poll() is None:
            time.sleep(1.0)
            found = sample(process.pid, directory / GROWING, time.monotonic() - start)
            if found is not None:
                samples.append(found)
        if process.returncode != 0:
            raise RuntimeError(f"the run ended with exit code {process.returncode}")
    return samples


def sample(pid: int, history: Path, seconds: float) -> Sample | None:
    """The current progress of a run; None before its first generation or after its end."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        resident = next(int(line.split()[1]) / 1000 for line in status.splitlines() if line.startswith("VmRSS"))
        with history.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - 400))
            last = file.read().decode().splitlines()[-1]
        return Sample(seconds, int(last.split(",")[2]), resident, size)
    except (OSError, StopIteration, ValueError, IndexError):
        return None


def speed(samples: list[Sample], low: int, high: int) -> float:
    """Microseconds per generation between two generations, by a linear fit through the samples between them."""
    part = np.array([(s.generation, s.seconds) for s in samples if low <= s.generation <= high])
    return float(1e6 * np.polyfit(part[:, 0], part[:, 1], 1)[0])


def main(arguments: list[str] | None = None) -> int:
    """Carry out the run, print a summary and write the samples."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.long", description=__doc__)
    parser.add_argument("--generations", type=int, default=200_000, help="default: 200000")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="CSV file; default: long.csv in benchmarks/")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as place:
        samples = watched(options.generations, Path(place) / "run")
    n = options.generations
    tenth = [s for s in samples if s.generation >= n // 10]
    first, last = speed(samples, n // 20, 3 * n // 10), speed(samples, 7 * n // 10, n)
    print(f"resident memory: {tenth[0].resident:.1f} MB after a tenth, {samples[-1].resident:.1f} MB at the end")
    print(f"per generation: {first:.0f} us from 5 to 30 %, {last:.0f} us from 70 to 100 %: {last / first:.2f} times")
    print(f"history on disk: {samples[-1].history / 1e6:.1f} MB")
    with options.output.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([Sample._fields, *samples[:: max(1, len(samples) // 60)]])
    return 0


if __name__ == "__main__":
    sys.exit(main())
