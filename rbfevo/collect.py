"""`python -m rbfevo.collect DIR`: all runs of a sweep in two tables, and which setting is best for the mesh."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rbfevo.commands import parsers
from rbfevo.commands.sequences import MOST, collected
from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.recorded import sweep
from rbfevo.recorded.sweep import Curve, Member, NestedSequence

DESCRIPTION = """Collect the runs at and below a directory, and print which setting is best for their mesh.

runs.csv     a line for each run and each of its series (all its setups, and those of each method)
medians.csv  medians and quartiles over the seeds, a line for each setting and series
report.html  a page with both, to compare settings and to choose a setup

and where settings were tried with several numbers of centers

curves.csv, curves.png  best potential and the knee over the number of centers
sequence.csv            what 1, 2, ... centers score that OLS places one after the other"""
EPILOG = """After adding runs, collect again: the files are rewritten. A sequence takes seconds to a minute, with
criterion.norm above 2 up to two minutes; it is kept in sequence.csv, and --sequence 0 leaves it out."""


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.Parser("rbfevo.collect", DESCRIPTION, EPILOG)
    made.add_argument("directory", type=Path, metavar="DIR", help="the directory of a sweep, or one that holds several")
    made.add_argument("--out", type=Path, metavar="DIR", help="the directory to write to (default: DIR)")
    made.add_argument(
        "--sequence",
        type=int,
        default=MOST,
        metavar="M",
        help=f"centers of the nested OLS sequence ({MOST})",
    )
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, or 2 for a user's mistake."""
    return parsers.carried_out(parser, carry_out, arguments)


def carry_out(options: argparse.Namespace) -> None:
    """Write the tables and the page of a sweep, and print which settings are best.

    Raises:
        UserError: for a user's mistake.
    """
    if options.sequence < 0:
        raise UserError(f"--sequence {options.sequence}: give a number of centers, or 0 for no sequence")
    members, unread = sweep.members(options.directory)
    out: Path = options.out or options.directory
    if any(member.name == "." for member in members) and out.resolve() == options.directory.resolve():
        raise UserError(
            f"{out} is a single run, whose report.html would be replaced: give the directory above, or --out"
        )
    lines = sweep.lines(members)
    groups = sweep.groups(members, lines)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {out} cannot be created: {error.strerror or error}") from None
    write_whole(out / "runs.csv", sweep.table_of_runs(lines))
    write_whole(out / "medians.csv", sweep.table_of_medians(groups))
    files, warnings = ["runs.csv", "medians.csv"], [*(f"left out: {line}" for line in unread), *sweep.warnings(members)]
    curves = sweep.curves(groups)
    nested, missing = nested_sequences(members, curves, options, out)
    files, warnings = [*files, *write_curves(curves, nested, options.directory, out)], [*warnings, *missing]
    from rbfevo.figures.report import page_of_sweep  # with Matplotlib: only once the runs are known

    try:
        write_whole(out / "report.html", page_of_sweep(members, options.directory, out, curves, nested).encode())
        files.append("report.html")
    except UserError as error:
        warnings.append(f"report.html could not be written: {error}")
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr, flush=True)
    for sentence in [*sweep.best(groups), *about_numbers(curves, nested)]:
        print(sentence)
    runs = f"{len(members)} run{'s' * (len(members) != 1)}"
    print(f"{runs}; written in {out}: {', '.join(files)}", flush=True)


def nested_sequences(
    members: Sequence[Member], curves: Sequence[Curve], options: argparse.Namespace, out: Path
) -> tuple[list[NestedSequence], list[str]]:
    """The nested sequences beside the curves, and a line for each that cannot be had; none without curves."""
    if not curves or not options.sequence:
        return [], []
    meshes = list(dict.fromkeys(curve.mesh for curve in curves))

    def report(line: str) -> None:
        print(line, flush=True)

    return collected(members, meshes, options.directory, out, options.sequence, report)


def write_curves(curves: Sequence[Curve], nested: Sequence[NestedSequence], directory: Path, out: Path) -> list[str]:
    """Write the tables and the picture over the number of centers, where there are curves; return the files' names."""
    if not curves:
        return []
    write_whole(out / "curves.csv", sweep.table_of_curves(curves))
    if nested:
        write_whole(out / "sequence.csv", sweep.table_of_sequences(nested))
    from rbfevo.figures import curves as figure
    from rbfevo.figures import style

    style.save(figure.picture(curves, nested, f"Sweep {directory.resolve().name}"), out / "curves.png")
    return ["curves.csv", *(["sequence.csv"] if nested else []), "curves.png"]


def about_numbers(curves: Sequence[Curve], nested: Sequence[NestedSequence]) -> list[str]:
    """Where another center stops paying, in sentences that begin with the mesh where there are several."""
    found = sweep.advice(curves, nested)
    several = len(found) > 1
    return [f"mesh {mesh}: {text}" if several else text for mesh, texts in found.items() for text in texts]


if __name__ == "__main__":
    parsers.start(main)
