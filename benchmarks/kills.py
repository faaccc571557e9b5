"""`python -m benchmarks.kills`: kills every search method at random moments, resumes it, and compares the results.

Each method first runs once without interruption. Then it runs again with a checkpoint after every generation, is killed
with SIGKILL at a random moment (anywhere in the run, file writes included), resumed and killed again until it finishes.
After every kill all existing files must be intact. At the end the arrays, the history and the counts must be those of
the uninterrupted run, bit for bit.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from rbfevo.methods.method import HistoryLine
from rbfevo.runs import checkpoint
from rbfevo.runs.config import CONF, Settings, check
from rbfevo.runs.run import carry_out

OUTPUT = Path(__file__).parent / "kills.csv"
COMMON = (
    "scenario=plane",
    "scenario.resolution=[30,30]",
    "centers=8",
    "figures=false",
    "quiet=true",
    "checkpoint.every=0",
)
GRADIENT = ("method=gradient", "method.starts=16", "method.population=16", "method.generations=24", "method.polish=6")
PANEL = ("method=panel", "method.nsga2.generations=25", "method.cmaes.generations=8", "method.blend.climbs=3")
METHODS: dict[str, tuple[str, ...]] = {
    "nsga2": ("method=nsga2", "method.generations=60", "method.population=40"),
    "cmaes": ("method=cmaes", "method.generations=40", "preference=[0,0.5,1]", "manipulation=direct"),
    "gradient": (*GRADIENT, "method.coarse=300"),
    "gradient, preferences": (*GRADIENT, "method.coarse=300", "preference=[0.2,0.8]"),
    "panel": (*PANEL, "kernel=triharmonic"),
}


class Report(NamedTuple):
    """The result for one method.

    Attributes:
        kills: processes killed.
        before_first: how many of them before the first checkpoint.
        while_writing: how many of them while a file was being written.
        damaged: kills after which a file was damaged.
        different: finished runs whose results differ from those of the uninterrupted run.
    """

    method: str
    kills: int
    before_first: int
    while_writing: int
    damaged: int
    different: int


def settings_of(overrides: tuple[str, ...]) -> Settings:
    """The checked settings of a run with these Hydra overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return check(compose("config", overrides=[*COMMON, *overrides]))


def apart(work: Callable[[], Any], moment: float | None) -> int | None:
    """Call `work` in a child process, kill it after `moment` seconds; return its exit code, None if it was killed."""
    child = os.fork()
    if child == 0:
        code = 1
        with contextlib.suppress(BaseException):
            work()
            code = 0
        os._exit(code)
    if moment is not None:
        end = time.monotonic() + moment
        while time.monotonic() < end:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(min(0.001, max(0.0, end - time.monotonic())))
        os.kill(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return None if code == -signal.SIGKILL else code


def damaged(directory: Path) -> list[str]:
    """The files of a run directory that cannot be read."""
    wrong = []
    for path in directory.glob("*.*"):
        if path.name.startswith("."):
            continue
        try:
            if path.suffix == ".npz":
                with np.load(path, allow_pickle=False) as archive:
                    for name in archive.files:
                        archive[name]
            elif path.suffix == ".json":
                json.loads(path.read_text())
            elif not path.read_text().endswith("\n"):
                wrong.append(path.name)
        except Exception as error:
            wrong.append(f"{path.name} ({error})")
    return wrong


def end_of(directory: Path) -> dict[str, Any]:
    """The arrays, history and counts of a run, without its times."""
    with np.load(directory / "setups.npz") as archive:
        arrays = {name: (archive[name].dtype.str, archive[name].tobytes()) for name in archive.files}
    at = HistoryLine._fields.index("seconds")
    lines = list(csv.reader(io.StringIO((directory / "history.csv").read_text())))
    summary = json.loads((directory / "summary.json").read_text())
    counts = {key: value for key, value in summary.items() if key not in ("seconds", "evaluations_per_second")}
    return {"arrays": arrays, "history": [line[:at] + line[at + 1 :] for line in lines], "counts": counts}


def torture(name: str, overrides: tuple[str, ...], kills: int, chance: random.Random) -> Report:
    """Run and resume a method until it has been killed `kills` times.

    Raises:
        RuntimeError: if a process fails without being killed.
    """
    settings = settings_of(overrides)
    before_first = while_writing = wrong = different = killed = 0
    with tempfile.TemporaryDirectory() as place:
        calm = Path(place) / "calm"
        start = time.monotonic()
        if apart(lambda: carry_out(settings, calm), None) != 0:
            raise RuntimeError(f"{name}: the uninterrupted run failed")
        whole, expected, number = time.monotonic() - start, end_of(calm), 0
        while killed < kills:
            number += 1
            directory, code = Path(place) / str(number), None
            while code is None:
                resume = (directory / checkpoint.NAME).exists()
                moment = chance.uniform(0, whole) if killed < kills else None

                def work(directory: Path = directory, resume: bool = resume) -> int:
                    """Start or resume the run."""
                    return carry_out(settings, directory, resume=resume)

                code = apart(work, moment)
                if code is None:
                    killed += 1
                    before_first += not (directory / checkpoint.NAME).exists()
                    while_writing += any(directory.glob(".*.????????"))
                    wrong += bool(damaged(directory)) if directory.is_dir() else 0
                    if (directory / checkpoint.NAME).exists() and checkpoint.head(directory)["finished"]:
                        code = 0  # killed after its last checkpoint: nothing is left to resume
                elif code != 0:
                    raise RuntimeError(f"{name}: resuming failed (exit code {code}) after kill {killed}")
            different += end_of(directory) != expected
    return Report(name, killed, before_first, while_writing, wrong, different)


def main(arguments: list[str] | None = None) -> int:
    """Test all methods, print and write the results; return 0 if nothing was damaged or different."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="kills of each method; default: 50")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments; default: 0")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="CSV file; default: kills.csv in benchmarks/")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    reports = []
    for name, overrides in METHODS.items():
        reports.append(torture(name, overrides, options.kills, random.Random(f"{options.seed} {name}")))
        print(reports[-1], flush=True)
    with options.output.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([Report._fields, *reports])
    return int(any(report.damaged or report.different for report in reports))


if __name__ == "__main__":
    sys.exit(main())
