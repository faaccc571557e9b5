"""Draws each figure in a separate process, as `rbfevo.figures` does, because a missing OpenGL can kill it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from rbfevo.errors import UserError
from rbfevo.figures.processes import Outcome, draw_apart
from reproduction.figures.wording import FIGURES
from reproduction.study import Study

RENDERED = ("figure1", "figure4-face", "figure5-face", "figure7-face")  # by OpenGL if it is available


def draw(out: Path) -> list[str]:
    """Draw all figures of the results in `out`; return one line for each problem; never raises."""
    try:
        Study(out)
    except UserError as error:
        return [f"no figure could be drawn: {error}"]
    return [outcome.warning for outcome in (draw_one(out, figure) for figure in FIGURES) if outcome.warning]


def draw_one(out: Path, figure: str, opengl: bool = True) -> Outcome:
    """Draw `figure` in a separate process, and again without OpenGL if the first attempt crashes."""
    arguments = command(out, figure, *(() if opengl else ("--no-opengl",)))
    return draw_apart(figure, arguments, opengl and figure in RENDERED)


def command(out: Path, figure: str, *options: str) -> list[str]:
    """The command that draws one figure."""
    return [sys.executable, "-m", "reproduction.figures", os.path.abspath(out), "--only", figure, *options]  # noqa: PTH100
