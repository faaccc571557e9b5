"""`python -m rbfevo.figures RUN` redraws front.png and centers.png of a run directory."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rbfevo.errors import UserError
from rbfevo.figures import processes
from rbfevo.figures.record import read


def draw_here(run: Path, figure: str, opengl: bool) -> None:
    """Draw one figure in this process.

    Raises:
        UserError: if the run directory cannot be drawn.
        OSError: if the picture cannot be written.
    """
    record = read(run)
    from rbfevo.figures import style  # matplotlib takes a while: only once there is something to draw

    if figure == "front":
        from rbfevo.figures import front

        picture = front.picture(record)
    else:
        from rbfevo.figures import centers

        picture = centers.picture(record, opengl=opengl)
    style.save(picture, run / f"{figure}.png")


def main(arguments: list[str] | None = None) -> int:
    """Draw what the command line asks for and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m rbfevo.figures", description="Redraw the figures of a run.")
    parser.add_argument("run", type=Path, help="a run directory, with setups.npz, scenario.npz and summary.json")
    parser.add_argument("--only", choices=processes.FIGURES, help="draw one figure, in this very process")
    parser.add_argument("--no-opengl", action="store_true", help="with --only: draw surfaces without OpenGL")
    options = parser.parse_args(arguments)
    if options.only is None:
        outcomes = [processes.draw_one(options.run, figure) for figure in processes.FIGURES]
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
