"""`python -m rbfevo.meshes FILE [--json]`: what rbfevo sees in a file."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from rbfevo.commands import parsers

DESCRIPTION = """Report what rbfevo sees in a mesh file: its points, cells, arrays and patches, the surface that a
template would have, and what is odd about it. Nothing is written."""


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.Parser("rbfevo.meshes", DESCRIPTION)
    made.add_argument("file", type=Path, metavar="FILE", help="a mesh or a cloud")
    made.add_argument("--patches", nargs="+", metavar="NAME", help="patches of it, as scenario.patches takes them")
    made.add_argument("--json", action="store_true", help="for programs")
    return made


def carry_out(options: argparse.Namespace) -> None:
    """Print the report.

    Raises:
        UserError: if the file cannot be read.
    """
    from rbfevo.commands.mesh_report import lines, reported

    found = reported(options.file, options.patches)
    if options.json:
        json.dump(found, sys.stdout, indent=2, allow_nan=False)
        print(flush=True)
    else:
        print("\n".join(lines(found)), flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, or 2 for a user's mistake."""
    return parsers.carried_out(parser, carry_out, arguments)


if __name__ == "__main__":
    parsers.start(main)
