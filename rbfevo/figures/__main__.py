"""`python -m rbfevo.figures DIR` redraws front.png, centers.png and report.html of a run, or fit.png of a fit."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rbfevo.commands import parsers
from rbfevo.errors import UserError
from rbfevo.figures import processes
from rbfevo.files import write_whole
from rbfevo.recorded.record import FitRecord, Record, read, read_fit


def draw_here(run: Path, figure: str, opengl: bool) -> None:
    """Draw one figure in this process.

    Raises:
        UserError: if the directory cannot be drawn.
        OSError: if the picture cannot be written.
    """
    record = read_fit(run) if figure == "fit" else read(run)
    if figure == "report" and isinstance(record, Record):
        from rbfevo.figures.report import page

        write_whole(run / processes.file_of(figure), page(record, run).encode())
        return
    from rbfevo.figures import style  # matplotlib takes long to import: only once there is something to draw

    if isinstance(record, FitRecord):
        from rbfevo.figures import fit

        picture = fit.picture(record, opengl=opengl)
    elif figure == "front":
        from rbfevo.figures import front

        picture = front.picture(record)
    else:
        from rbfevo.figures import centers

        picture = centers.picture(record, opengl=opengl)
    style.save(picture, run / processes.file_of(figure))


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.Parser("rbfevo.figures", "Redraw the figures of a run or a fit.")
    made.add_argument("run", type=Path, metavar="DIR", help="the directory of a run or of a fit")
    made.add_argument(
        "--only", choices=(*processes.FIGURES, *processes.FIT_FIGURES), help="draw one figure, in this process"
    )
    made.add_argument("--no-opengl", action="store_true", help="with --only: draw surfaces without OpenGL")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, 2 for a user's mistake, or 1 where a figure could not be drawn."""
    return parsers.carried_out(parser, carry_out, arguments)


def carry_out(options: argparse.Namespace) -> int:
    """Draw one figure here, or each in a process of its own; the exit code.

    Raises:
        UserError: for a user's mistake.
    """
    if not options.run.is_dir():
        raise UserError(f"{options.run}: there is no such directory")
    if options.only is None:
        outcomes = [processes.draw_one(options.run, figure) for figure in processes.figures_of(options.run)]
        for outcome in outcomes:
            if outcome.warning:
                print(outcome.warning, file=sys.stderr)
        return max(outcome.exit_code for outcome in outcomes)
    try:
        draw_here(options.run, options.only, opengl=not options.no_opengl)
    except (UserError, OSError) as error:  # `processes` names the figure
        print(" ".join(str(error).split()), file=sys.stderr)
        return processes.USER_ERROR
    return 0


if __name__ == "__main__":
    parsers.start(main)
