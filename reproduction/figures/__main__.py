"""`python -m reproduction.figures OUT` draws figure1.png to figure7-face.png and fits.png from the results in OUT,
into OUT."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rbfevo.errors import UserError
from rbfevo.figures.processes import USER_ERROR
from rbfevo.runs import storage
from reproduction.figures import exhibits, processes
from reproduction.figures.wording import FIGURES, captions
from reproduction.study import Study

TABLES = ("figure4", "figure4-face", "figure5", "figure5-face", "figure7", "figure7-face")


def draw_here(study: Study, figure: str, opengl: bool) -> None:
    """Draw one figure in this process, and write the centers that it shows into `centers/`.

    Raises:
        UserError: if a result cannot be read, or a picture or table cannot be written.
    """
    # Importing matplotlib takes a while, so it waits until there is something to draw.
    from reproduction.figures import fitted, fronts, functions, layout, setups, shapes

    caption = captions(study)[f"{figure}.png"]
    if figure == "figure1":
        picture = shapes.picture(study, caption, opengl)
    elif figure == "figure2":
        picture = functions.picture(caption)
    elif figure in ("figure3", "figure6"):
        picture = fronts.picture(study, "plane" if figure == "figure3" else "face", caption)
    elif figure == "fits":
        picture = fitted.picture(study, caption)
    else:
        picture = setups.picture(study, figure, caption, opengl)
    layout.save(picture, study.out / f"{figure}.png")
    if figure in TABLES:
        shown = [exhibit for row in exhibits.of_figure(study, figure) for exhibit in row if exhibit is not None]
        (study.out / "centers").mkdir(exist_ok=True)
        storage.write_whole(study.out / "centers" / f"{figure}.csv", exhibits.table(shown))


def main(arguments: list[str] | None = None) -> int:
    """Draw the figures of the command line and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m reproduction.figures", description="Draw the paper's figures.")
    parser.add_argument("out", type=Path, help="a directory of scripts/reproduce")
    parser.add_argument("--only", choices=FIGURES, help="draw one figure, in this process")
    parser.add_argument("--no-opengl", action="store_true", help="draw surfaces without OpenGL")
    options = parser.parse_args(arguments)
    try:
        study = Study(options.out)
        if options.only is not None:
            draw_here(study, options.only, opengl=not options.no_opengl)
            return 0
    except (UserError, OSError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return USER_ERROR
    outcomes = [processes.draw_one(options.out, figure, not options.no_opengl) for figure in FIGURES]
    for outcome in outcomes:
        if outcome.warning:
            print(outcome.warning, file=sys.stderr)
    return max(outcome.exit_code for outcome in outcomes)


if __name__ == "__main__":
    sys.exit(main())
