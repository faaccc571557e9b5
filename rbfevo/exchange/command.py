"""What the command lines of export and apply share: complaints are one line, exit code 2."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from rbfevo.errors import UserError
from rbfevo.picks import PICKS


class Parser(argparse.ArgumentParser):
    """A parser of `python -m NAME RUN --pick ...` whose complaints are one line."""

    def __init__(self, name: str, description: str, epilog: str) -> None:
        formatter = argparse.RawDescriptionHelpFormatter
        super().__init__(
            prog=f"python -m {name}",
            description=description,
            epilog=epilog,
            allow_abbrev=False,
            formatter_class=formatter,
        )
        self.add_argument("run", type=Path, metavar="RUN", help="a run directory, as python -m rbfevo leaves it")
        self.add_argument("--pick", required=True, help=f"which of its setups: {', '.join(PICKS)}")

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; see {self.prog} --help")


def carried_out(
    parser: Parser, carry_out: Callable[[argparse.Namespace], None], arguments: Sequence[str] | None
) -> int:
    """Carry out a command line; return 0, 2 for a user's mistake, or 130 after Ctrl-C."""
    try:
        carry_out(parser.parse_args(arguments))
    except UserError as error:
        name = parser.prog.removeprefix("python -m ")
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0
