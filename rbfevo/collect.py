"""`python -m rbfevo.collect DIR`: all runs of a sweep in two tables, and which setting is best for the mesh."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rbfevo.commands import parsers
from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.recorded import sweep

DESCRIPTION = """Collect the runs at and below a directory, and print which setting is best for their mesh.

runs.csv     a line for each run and each of its series (all its setups, and those of each method)
medians.csv  medians and quartiles over the seeds, a line for each setting and series
report.html  a page with both, to compare settings and to choose a setup"""
EPILOG = "After adding runs, collect again: the files are rewritten."


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.Parser("rbfevo.collect", DESCRIPTION, EPILOG)
    made.add_argument("directory", type=Path, metavar="DIR", help="the directory of a sweep, or one that holds several")
    made.add_argument("--out", type=Path, metavar="DIR", help="the directory to write to (default: DIR)")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, or 2 for a user's mistake."""
    return parsers.carried_out(parser, carry_out, arguments)


def carry_out(options: argparse.Namespace) -> None:
    """Write the tables and the page of a sweep, and print which settings are best.

    Raises:
        UserError: for a user's mistake.
    """
    members, unread = sweep.members(options.directory)
    out: Path = options.out or options.directory
    if any(member.name == "." for member in members) and out.resolve() == options.directory.resolve():
        raise UserError(
            f"{out} is a single run, whose report.html would be replaced: give the directory above, or --out"
        )
    groups = sweep.groups(members)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {out} cannot be created: {error.strerror or error}") from None
    write_whole(out / "runs.csv", sweep.table_of_runs(sweep.lines(members)))
    write_whole(out / "medians.csv", sweep.table_of_medians(groups))
    files, warnings = ["runs.csv", "medians.csv"], [*(f"left out: {line}" for line in unread), *sweep.warnings(members)]
    from rbfevo.figures.report import page_of_sweep  # with Matplotlib: only once the runs are known

    try:
        write_whole(out / "report.html", page_of_sweep(members, options.directory, out).encode())
        files.append("report.html")
    except UserError as error:
        warnings.append(f"report.html could not be written: {error}")
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr, flush=True)
    for sentence in sweep.best(groups):
        print(sentence)
    runs = f"{len(members)} run{'s' * (len(members) != 1)}"
    print(f"{runs}; written in {out}: {', '.join(files)}", flush=True)


if __name__ == "__main__":
    parsers.start(main)
