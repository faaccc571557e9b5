"""`scripts/portability`: the numerical tests, and the results of one seed, on simulated processors.

Every line of the first table is one run of the numerical tests on a processor of `benchmarks.processors` with a number
of threads. The second table gives the differences between the results of one seed: scores of the same setups, and final
results of complete searches. The tables are written to portability.csv and spread.csv in benchmarks/, except with
--short.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import torch

from benchmarks import spread
from benchmarks.processors import PROCESSORS, SHORT, Processor, environment, missing

ROOT = Path(__file__).parents[1]
OUTPUT = ROOT / "benchmarks" / "portability.csv"
TESTS = (
    "matrices",
    "kernels",
    "deformation",
    "evolvability",
    "gram",
    "evaluator",
    "gradients",
    "mirrored",
    "tracing",
    "parameterization",
    "properties",
    "pareto",
    "coarse",
    "plane",
    "lbfgs",
    "nsga2",
    "cmaes",
    "lloyd",
    "ols",
    "gradient",
    "run",
    "mesh_runs",
    "resume",
)
FEW = ("matrices", "gram", "evaluator", "gradients", "mirrored", "cmaes")


class Outcome(NamedTuple):
    """One run of the tests; `note` names the first failures, or the reason why the tests did not run."""

    machine: str
    processor: str
    threads: int
    torch: str
    mkl: str
    numba: str
    passed: int
    failed: int
    seconds: float
    note: str


def tested(processor: Processor, threads: int, tests: Sequence[str], directory: Path) -> Outcome:
    """Run the tests on a simulated processor."""
    mkl = ", ".join(filter(None, (processor.mkl, processor.maker and f"maker: {processor.maker}")))
    described = (processor.torch, mkl, processor.numba)
    reason = missing(processor)
    if reason:
        return Outcome(described_here(), processor.name, threads, *described, 0, 0, 0.0, f"not run: {reason}")
    files = [f"tests/test_{name}.py" for name in tests]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no", *files]
    settings = {"OMP_NUM_THREADS": str(threads), "RBFEVO_TEST_THREADS": str(threads), "CUDA_VISIBLE_DEVICES": ""}
    start = time.perf_counter()
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | settings | environment(processor, directory),
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - start
    counts = {kind: int(count) for count, kind in re.findall(r"(\d+) (passed|failed|error)", done.stdout[-500:])}
    failures = re.findall(r"^(?:FAILED|ERROR) (?:tests/)?(\S+)", done.stdout, re.MULTILINE)
    note = ", ".join(failures[:3])
    if done.returncode not in (0, 1) or not counts.get("passed"):
        note = " ".join((done.stdout + done.stderr).split())[-200:] or f"exit code {done.returncode}"
    failed = counts.get("failed", 0) + counts.get("error", 0) + (done.returncode not in (0, 1))
    return Outcome(
        described_here(), processor.name, threads, *described, counts.get("passed", 0), failed, round(seconds, 1), note
    )


def described_here() -> str:
    """This machine's processor as the operating system names it, and the capability that torch detects."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        name = found[1] if found else name
    return f"{name}, {torch.backends.cpu.get_cpu_capability()}"


def written(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write outcomes into the table, replacing those of the same machine, processor and threads."""
    rows: dict[tuple[str, ...], tuple] = {}
    if path.exists():
        with path.open(newline="") as file:
            rows = {tuple(row[:3]): tuple(row) for row in list(csv.reader(file))[1:]}
    rows |= {(o.machine, o.processor, str(o.threads)): o for o in outcomes if not o.note.startswith("not run")}
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Outcome._fields)
        writer.writerows(rows.values())


def main() -> int:
    """Print both tables; return 1 if a test failed."""
    parser = argparse.ArgumentParser(prog="scripts/portability", description=(__doc__ or "").partition("\n\n")[2])
    parser.add_argument(
        "--short", action="store_true", help="three processors, one thread, the tests of small matrices"
    )
    parser.add_argument("--only", metavar="NAME", action="append", help="only processors whose name contains NAME")
    parser.add_argument("--threads", type=int, nargs="+", help="numbers of threads; default: 1 2")
    parser.add_argument("--no-spread", action="store_true", help="only the tests, not the second table")
    arguments = parser.parse_args()
    chosen = [p for p in PROCESSORS if not arguments.short or p.name in SHORT]
    chosen = [p for p in chosen if arguments.only is None or any(name in p.name for name in arguments.only)]
    if not chosen:
        parser.error(f"--only: no processor matches; choose from {', '.join(p.name for p in PROCESSORS)}")
    threads = arguments.threads or ([1] if arguments.short else [1, 2])
    whole = len(chosen) == len(PROCESSORS) and not arguments.threads
    print(f"this processor: {described_here()}; torch {torch.__version__}", flush=True)
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="rbfevo-portability-") as name:
        directory = Path(name)
        print(f"{'processor':26} threads  passed  failed  seconds")
        tests = FEW if arguments.short else TESTS
        for count in threads:
            at_once = max(1, (os.cpu_count() or 1) // count)
            with ThreadPoolExecutor(at_once) as pool:
                for outcome in pool.map(lambda processor: tested(processor, count, tests, directory), chosen):  # noqa: B023
                    outcomes.append(outcome)
                    numbers = f"{outcome.passed:7}  {outcome.failed:6}  {outcome.seconds:7.1f}"
                    print(f"{outcome.processor:26} {count:7}  {numbers}  {outcome.note}", flush=True)
        if not arguments.short:
            written(OUTPUT, outcomes)
        if not (arguments.short or arguments.no_spread):
            lines = spread.measured([p for p in chosen if not missing(p)], directory)
            print("\n" + spread.table(lines), flush=True)
            if whole:
                spread.written(lines)
    ran = [outcome for outcome in outcomes if not outcome.note.startswith("not run")]
    return int(not ran or any(outcome.failed for outcome in ran))


if __name__ == "__main__":
    sys.exit(main())
