"""What all commands share: how arguments are read, the exit code, and the one line for an error.

0 is success, 2 a user's mistake, 130 Ctrl-C, 143 SIGTERM, 1 a fault of the program or of the machine. A closed pipe
(`| head`) silences a command and nothing else: its work goes on to the end, and the exit code is that of the work.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, cast

from rbfevo.errors import UserError

SUCCESS, MISTAKE, INTERRUPTED = 0, 2, 130


class Parser(argparse.ArgumentParser):
    """A parser of `python -m NAME ...` that reports an error in one line."""

    def __init__(self, name: str, description: str, epilog: str = "") -> None:
        super().__init__(
            prog=f"python -m {name}",
            description=description,
            epilog=epilog,
            allow_abbrev=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.name = name

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; see {self.prog} --help")


class PickParser(Parser):
    """A parser of `python -m NAME RUN --pick ...`."""

    def __init__(self, name: str, description: str, epilog: str = "", default: str | None = None) -> None:
        from rbfevo.recorded.picks import PICKS  # with NumPy

        super().__init__(name, description, epilog)
        self.add_argument("run", type=Path, metavar="RUN", help="a run directory, made by python -m rbfevo")
        which = f"the setup: {', '.join(PICKS)}"
        which += "" if default is None else f" (default: {default})"
        self.add_argument("--pick", required=default is None, help=which)


def fraction(text: str) -> float:
    """A number, or a percentage of 1."""
    from rbfevo.geometry.lengths import number_or_percentage

    number, percent = number_or_percentage(text)
    if number != number:
        raise argparse.ArgumentTypeError(
            f"{text} is neither a fraction above 0 and at most 1 nor a percentage such as 5%"
        )
    return number / 100.0 if percent else number


def carried_out(
    parser: Callable[[], Parser],
    carry_out: Callable[[argparse.Namespace], int | None],
    arguments: Sequence[str] | None,
) -> int:
    """Parse a command line and carry it out; return the exit code."""
    made = parser()
    return outcome(made.name, lambda: carry_out(made.parse_args(arguments)))


def outcome(name: str, work: Callable[[], int | None]) -> int:
    """Do some work and return its exit code (0 for None); a mistake and Ctrl-C print one line."""
    try:
        return work() or SUCCESS
    except UserError as error:
        complain(name, str(error))
        return MISTAKE
    except KeyboardInterrupt:
        complain(name, "interrupted")
        return INTERRUPTED


def complain(name: str, message: str) -> None:
    """One line on stderr."""
    print(f"{name}: {' '.join(message.split())}", file=sys.stderr, flush=True)


def start(main: Callable[[], int]) -> NoReturn:
    """Carry out a command and end the process with its exit code."""
    steady_streams()
    sys.exit(main())


def steady_streams() -> None:
    """Keep stdout and stderr from ending this process when a pipe is closed or a character cannot be encoded.

    What is written to a closed pipe is lost. File names that are not valid text are written as their bytes.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and stream is getattr(sys, f"__{name}__"):  # none else put it there
            stream.flush()
            raw = _Pipe(stream.fileno(), "wb", closefd=False)
            escaped = "surrogateescape" if stream.encoding.lower().startswith("utf") else "backslashreplace"
            steady = io.TextIOWrapper(
                cast(BinaryIO, raw) if stream.write_through else io.BufferedWriter(raw),
                encoding=stream.encoding,
                errors=escaped if stream.errors == "strict" else stream.errors,
                line_buffering=stream.line_buffering,
                write_through=stream.write_through,
            )
            setattr(sys, name, steady)


class _Pipe(io.FileIO):
    """A file that is replaced by the null device once it is a closed pipe."""

    def write(self, content: Any) -> int:
        try:
            return super().write(content)
        except BrokenPipeError:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.fileno())
            os.close(null)
            return memoryview(content).nbytes
