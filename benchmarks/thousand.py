"""`python -m benchmarks.thousand DIR`: a sweep of 1,000 finished jobs is started again, and its runs are collected.

One run is carried out, with 200 setups of 25 centers on 22,500 vertices. The others are copies of it with another seed
in all files that name it, so that the sweep takes them for its own.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from omegaconf import DictConfig, OmegaConf

from rbfevo.files import write_whole
from rbfevo.recorded import hydra_files
from rbfevo.runs import checkpoint
from rbfevo.runs.config import check
from rbfevo.runs.identity import identity

RUN = ("scenario=plane", "method=nsga2", "method.generations=5", "quiet=true", "figures=false")
CHANGED = ("summary.json", checkpoint.NAME)
RESTARTED, COLLECTED = 20.0, 60.0  # seconds that they may take


def made(directory: Path, count: int) -> None:
    """Make the runs of a sweep over the seeds 0, 1, ..."""
    rbfevo("rbfevo", "-m", *RUN, "seed=0", f"hydra.sweep.dir={directory}")
    first = directory / "0"
    config, overrides = OmegaConf.load(first / ".hydra" / "config.yaml"), hydra_files.overrides(first)
    assert isinstance(config, DictConfig)
    assert overrides is not None
    settings, state = check(config.copy(), overrides), checkpoint.load(first)
    summary = json.loads((first / "summary.json").read_text())
    for seed in range(1, count):
        run = directory / str(seed)
        (run / ".hydra").mkdir(parents=True)
        for path in first.iterdir():
            if path.is_file() and path.name not in CHANGED:
                shutil.copyfile(path, run / path.name)
        own = [f"seed={seed}" if override == "seed=0" else override for override in overrides]
        config.seed = seed
        changed = dataclasses.replace(settings, seed=seed)
        hashes = {"settings": identity(changed), "whole": identity(changed, whole=True)}
        checkpoint.save(run, {**state, **hashes, "overrides": own})
        write_whole(run / "summary.json", json.dumps({**summary, "seed": seed}).encode())
        write_whole(run / ".hydra" / "config.yaml", OmegaConf.to_yaml(config).encode())
        write_whole(run / ".hydra" / "overrides.yaml", OmegaConf.to_yaml(own).encode())


class Measured(NamedTuple):
    """How long a command took, in seconds by the clock and of the processor, and what it printed."""

    seconds: float
    processor: float
    text: str


def rbfevo(*overrides: str) -> Measured:
    """Carry out a command of the package."""
    begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", *overrides], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"python -m {' '.join(overrides)}: {done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Measured(time.perf_counter() - begun, processor, done.stdout + done.stderr)


def measured(directory: Path, count: int) -> tuple[Measured, Measured]:
    """Start the sweep again, and collect its runs."""
    restarted = rbfevo("rbfevo", "-m", *RUN, f"seed=range({count})", f"hydra.sweep.dir={directory}")
    if f"{count} of {count} jobs were already done" not in restarted.text:
        raise SystemExit(f"jobs have begun anew: {restarted.text[-500:]}")
    collected = rbfevo("rbfevo.collect", str(directory))
    if f"{count} runs; written in" not in collected.text:
        raise SystemExit(f"runs were left out: {collected.text[-500:]}")
    return restarted, collected


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both; return 1 if one of them takes too long."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path, metavar="DIR", help="where the runs are made; it is left there")
    parser.add_argument("--runs", type=int, default=1000, metavar="N", help="how many (1000)")
    options = parser.parse_args(arguments)
    if not (options.directory / str(options.runs - 1)).is_dir():
        made(options.directory, options.runs)
    restarted, collected = measured(options.directory, options.runs)
    print(f"{options.runs} runs; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs")
    for what, took, most in (("started again", restarted, RESTARTED), ("collected", collected, COLLECTED)):
        print(f"{what}: {took.seconds:.1f} s, {took.processor:.1f} s of the processor (at most {most:.0f} s)")
    return int(restarted.seconds > RESTARTED or collected.seconds > COLLECTED)


if __name__ == "__main__":
    sys.exit(main())
