"""All measurements on one machine in one run: scoring, searches and heuristics, compared with their floors and peers.

A ratio is the median over rounds that time both sides in turn; a missed target does not change the exit code.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch

from benchmarks import bench_fronts, bench_heuristics, bench_memory, bench_scoring, bench_searches
from benchmarks.bench_rows import Row, Screen, machine, record
from rbfevo.errors import UserError
from rbfevo.runs import storage
from rbfevo.scoring.threads import coarse

OUTPUT = Path(__file__).parent / "bench.json"
QUICK = Path(__file__).parent / "bench-quick.json"  # not committed

Group = Callable[[bool], Iterator[Row]]  # quick -> rows, yielded as they are measured

GROUPS: dict[str, Group] = {
    "scoring": bench_scoring.scoring,
    "floor": bench_scoring.floor,
    "gradient": bench_scoring.gradient,
    "memory": bench_memory.memory,
    "nsga2": bench_searches.nsga2,
    "cmaes": bench_searches.cmaes,
    "heuristics": bench_heuristics.heuristics,
    "fronts": bench_fronts.fronts,
    "cuda": bench_scoring.cuda,
}


def run(groups: Sequence[str], quick: bool, screen: Screen, output: Path | None) -> list[Row]:
    """Measure the groups, show every row once it is measured, and write all rows to `output` if it is given.

    Raises:
        UserError: if the file cannot be written.
    """
    start, rows = time.perf_counter(), []
    facts = machine(torch.get_num_threads())
    with coarse():  # as a run does
        for name in groups:
            for row in GROUPS[name](quick):
                rows.append(row)
                screen.show(row)
    seconds = time.perf_counter() - start
    if output is not None:
        storage.write_whole(output, record(rows, groups, quick, seconds, facts))
    met, missed = (sum(row.met is value for row in rows) for value in (True, False))
    place = "" if output is None else f"; {output}"
    screen.console.print(f"{met} targets met, {missed} missed, {seconds:.0f} s{place}", markup=False)
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Print the table and write the JSON file."""
    parser = argparse.ArgumentParser(prog="scripts/bench", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer rounds, some groups on the plane only: 3 minutes")
    parser.add_argument(
        "--only", nargs="+", metavar="GROUP", choices=GROUPS, help=f"only these groups of {', '.join(GROUPS)}"
    )
    default = f"{OUTPUT.name}, or {QUICK.name} with --quick, in benchmarks/; none with --only"
    parser.add_argument("--output", type=Path, help=f"JSON file; default: {default}")
    chosen = parser.parse_args(arguments)
    groups = [name for name in GROUPS if chosen.only is None or name in chosen.only]
    output = chosen.output or (None if chosen.only else QUICK if chosen.quick else OUTPUT)
    try:
        run(groups, chosen.quick, Screen(), output)
    except UserError as error:
        print(f"scripts/bench: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
