"""Each figure is drawn by a separate process: a missing OpenGL can crash it, and must not end the run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

FIGURES = ("front", "centers", "report")
FIT_FIGURES = ("fit",)
PAGES = ("report",)  # HTML; all others are PNG
SURFACES = ("centers", "fit")  # those that may need OpenGL
TIMEOUT = 120.0  # seconds for one process; a 3-D picture takes some five
TIMEOUT_PER_BYTE = 1e-5  # of scenario.npz more: a million vertices take a minute on a free machine
TOO_LONG = -1000
USER_ERROR = 2


class Outcome(NamedTuple):
    """The result of drawing one figure: the exit code (0: there is a new picture), and a warning or None."""

    exit_code: int
    warning: str | None


def figures_of(run: Path) -> tuple[str, ...]:
    """The figures of a directory: those of a fit where there is a fit.json, else those of a run."""
    return FIT_FIGURES if (run / "fit.json").exists() else FIGURES


def file_of(figure: str) -> str:
    """The name of the file of a figure."""
    return f"{figure}.html" if figure in PAGES else f"{figure}.png"


def draw(run: Path) -> list[str]:
    """Draw all figures of a run or a fit and return one line for each thing that went wrong; never raises."""
    return [outcome.warning for outcome in (draw_one(run, figure) for figure in figures_of(run)) if outcome.warning]


def draw_one(run: Path, figure: str) -> Outcome:
    """Draw `figure` in a process of its own, and once more without OpenGL if the first attempt fails."""
    try:
        size = (run / "scenario.npz").stat().st_size
    except OSError:
        size = 0
    return draw_apart(figure, command(run, figure), figure in SURFACES, TIMEOUT + TIMEOUT_PER_BYTE * size)


def draw_apart(figure: str, arguments: list[str], rendered: bool, timeout: float = TIMEOUT) -> Outcome:
    """Run the command that draws `figure`; once more with --no-opengl if it is `rendered` and fails."""
    code, reason = attempt(arguments, timeout)
    if code == 0:
        return Outcome(0, None)
    again = rendered and code not in (USER_ERROR, TOO_LONG)  # without OpenGL it takes no less time
    if again and attempt([*arguments, "--no-opengl"], timeout)[0] == 0:
        return Outcome(0, f"{file_of(figure)} was drawn without OpenGL: {reason}")
    return Outcome(USER_ERROR if code == USER_ERROR else 1, f"{file_of(figure)} could not be drawn: {reason}")


def command(run: Path, figure: str, *options: str) -> list[str]:
    """Return the command that draws one figure in its own process."""
    return [sys.executable, "-m", "rbfevo.figures", os.path.abspath(run), "--only", figure, *options]  # noqa: PTH100


def attempt(arguments: list[str], timeout: float) -> tuple[int, str]:
    """Run a command and return its exit code and, unless that is 0, the reason in one line."""
    package_root = str(Path(__file__).resolve().parents[2])
    inherited = os.environ.get("PYTHONPATH")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (inherited, package_root)))}
    try:
        with tempfile.TemporaryDirectory() as elsewhere:  # a crash may leave a core file in its directory
            done = subprocess.run(
                arguments,
                cwd=elsewhere,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=timeout,
            )
    except subprocess.TimeoutExpired:
        return TOO_LONG, f"it was not finished after {timeout:g} s"
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        return 1, " ".join(str(error).split())
    if done.returncode < 0:
        return done.returncode, f"the process was ended by {_signal_name(-done.returncode)}"
    lines = done.stderr.strip().splitlines()
    return done.returncode, lines[-1].strip() if lines else f"the process ended with exit code {done.returncode}"


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
