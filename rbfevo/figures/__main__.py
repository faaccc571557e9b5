"""`python -m rbfevo.figures DIR` redraws front.png, centers.png and report.html of a run, or fit.png of a fit."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rbfevo.errors import UserError
from rbfevo.figures import processes
from rbfevo.files import write_whole
from rbfevo.record import FitRecord, Record, read, read_fit


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
    from rbfevo.figures import style  # matplotlib takes a while: only once there is something to draw

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


def main(arguments: list[str] | None = None) -> int:
    """Draw what the command line asks for and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m rbfevo.figures", description="Redraw the figures of a run or a fit."
    )
    parser.add_argument("run", type=Path, help="the directory of a run or of a fit")
    parser.add_argument(
        "--only", choices=(*processes.FIGURES, *processes.FIT_FIGURES), help="draw one figure, in this very process"
    )
    parser.add_argument("--no-opengl", action="store_true", help="with --only: draw surfaces without OpenGL")
    options = parser.parse_args(arguments)
    if not options.run.is_dir():
        print(f"rbfevo.figures: {options.run}: there is no such directory", file=sys.stderr)
        return processes.USER_ERROR
    if options.only is None:
        outcomes = [processes.draw_one(options.run, figure) for figure in processes.figures_of(options.run)]
        for outcome in outcomes:
            if outcome.warning:
                print(outcome.warning, file=sys.stderr)
        return max(outcome.exit_code for outcome in outcomes)
    try:
        draw_here(options.run, options.only, opengl=not options.no_opengl)
    except (UserError, OSError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return processes.USER_ERROR
    return 0


if __name__ == "__main__":
    sys.exit(main())
