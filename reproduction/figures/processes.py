"""Each figure is drawn by a process of its own, as `rbfevo.figures` does: a missing OpenGL can kill that process."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from rbfevo.errors import UserError
from rbfevo.figures.processes import USER_ERROR, Outcome, _attempt
from reproduction.figures.wording import FIGURES
from reproduction.study import Study

RENDERED = ("figure1", "figure4-face", "figure5-face", "figure7-face")  # by OpenGL, where there is one


def draw(out: Path) -> list[str]:
    """Draw all figures of the results in `out`; return one line for each thing that went wrong; never raises."""
    try:
        Study(out)
    except UserError as error:
        return [f"no figure could be drawn: {error}"]
    return [outcome.warning for outcome in (draw_one(out, figure) for figure in FIGURES) if outcome.warning]


def draw_one(out: Path, figure: str, opengl: bool = True) -> Outcome:
    """Draw `figure` in a process of its own, and once more without OpenGL where the first attempt broke down."""
    plain = ("--no-opengl",)
    code, reason = _attempt(command(out, figure, *(() if opengl else plain)))
    if code == 0:
        return Outcome(0, None)
    again = opengl and figure in RENDERED and code != USER_ERROR
    if again and _attempt(command(out, figure, *plain))[0] == 0:
        return Outcome(0, f"{figure}.png was drawn without OpenGL: {reason}")
    return Outcome(USER_ERROR if code == USER_ERROR else 1, f"{figure}.png could not be drawn: {reason}")


def command(out: Path, figure: str, *options: str) -> list[str]:
    """The command that draws one figure in its own process."""
    return [sys.executable, "-m", "reproduction.figures", os.path.abspath(out), "--only", figure, *options]  # noqa: PTH100
