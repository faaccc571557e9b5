"""`python -m rbfevo.show RUN`: show a run's setups in a window, or write pictures of them."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rbfevo.commands import parsers
from rbfevo.errors import UserError
from rbfevo.figures import processes
from rbfevo.figures.scene import COLOURS, KEYS, SHAPES, SOFTWARE, State
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read

LONGEST = 14 * 86_400.0  # seconds that a window may stay open
DEFAULT, WITHOUT_FRONT = "knee", "best-improvement-potential"
DESCRIPTION = f"""Show the setups of a run on the template, in a window with a slider for the preference and these keys:

{chr(10).join(f"{keys:<11}{what}" for keys, what in KEYS)}

Without a display, or with --pictures or --out, a picture is written instead: RUN/show-PICK.png, with the other choices
in its name (show-knee-vs-best-regularity-left.png)."""
EPILOG = """Existing pictures are not overwritten, except those in RUN that this command named and wrote itself."""


class BrokenError(Exception):
    """A window or a picture that could not be drawn, through no mistake of the user's."""


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.PickParser("rbfevo.show", DESCRIPTION, EPILOG, default=DEFAULT)
    made.add_argument("--compare", metavar="PICK", help="a second setup, shown beside the first")
    made.add_argument(
        "--colour",
        choices=COLOURS,
        default="wanted",
        help="wanted: the wanted displacement (default); left: the residual, what the setup cannot reach",
    )
    made.add_argument("--shape", choices=SHAPES, default="template", help="the shape to show (default: template)")
    made.add_argument("--objective", metavar="NAME", help="of several objectives, the one to show (default: the first)")
    made.add_argument("--out", type=Path, metavar="OUT", help="the .png file to write, or a directory for it")
    made.add_argument(
        "--pictures", "--no-display", action="store_true", help="write a picture, even where there is a display"
    )
    made.add_argument("--here", action="store_true", help=argparse.SUPPRESS)  # in this very process
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, 2 for a user's mistake, or 1 where nothing can be drawn."""
    try:
        return parsers.carried_out(parser, carry_out, arguments)
    except BrokenError as error:
        parsers.complain("rbfevo.show", str(error))
        return 1


def carry_out(options: argparse.Namespace) -> None:
    """Open the window, or write the picture.

    Raises:
        UserError: for a user's mistake.
        BrokenError: if there is no OpenGL, or it broke down.
    """
    record = read(options.run)
    chosen = options.pick.strip() if options.pick is not None else _first(record)
    other = _compared(record, options.compare)
    state = State(record, chosen, other, options.colour, options.shape, options.objective)
    if options.here:
        _draw(options, record, state)
        return
    displayed = has_display(os.environ)
    command = [sys.executable, "-m", "rbfevo.show", os.path.abspath(options.run), "--here", "--pick", chosen]  # noqa: PTH100
    command += ["--colour", options.colour, "--shape", options.shape]
    command += [] if options.compare is None else ["--compare", options.compare]
    command += [] if options.objective is None else ["--objective", options.objective]
    if displayed and options.out is None and not options.pictures:
        print("opening a window: press h to list the keys, q to close it", flush=True)
        _run(command, LONGEST, "the window", options.run)
        return
    out = _place(options, chosen)
    if not displayed and options.out is None and not options.pictures:
        print("there is no display: writing a picture instead of opening a window", flush=True)
    size = (options.run / "scenario.npz").stat().st_size
    command += ["--out", os.path.abspath(out)]  # noqa: PTH100
    _run(command, processes.TIMEOUT + processes.TIMEOUT_PER_BYTE * size, "the picture", options.run)
    for row in state.rows:
        print("; ".join(state.titles(row)))
    print(f"written: {out}", flush=True)


def has_display(environment: Mapping[str, str], platform: str = sys.platform) -> bool:
    """Whether a window may open: always on macOS and Windows, elsewhere if a display is named."""
    named = environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY")
    return platform in ("darwin", "win32") or bool(named)


def picture_name(chosen: str, compare: str | None, colour: str, shape: str, objective: str | None = None) -> str:
    """The name of a picture: the picks, and the colouring, the shape and the objective where they are asked for."""
    parts = [chosen.strip(), *(["vs", compare.strip()] if compare is not None else [])]
    parts += [colour] if colour != next(iter(COLOURS)) else []
    parts += [f"{shape}-shape"] if shape != next(iter(SHAPES)) else []
    parts += [] if objective is None else [objective]
    return f"show-{'-'.join(parts).replace(':', '-').replace('/', '-')}.png"


def _first(record: Record) -> str:
    """The pick where none is given: the knee, if there is one."""
    try:
        pick(record, DEFAULT)
    except UserError:
        return WITHOUT_FRONT
    return DEFAULT


def _compared(record: Record, chosen: str | None) -> int | None:
    try:
        return None if chosen is None else pick(record, chosen)
    except UserError as error:
        raise UserError(f"--compare: {error}") from None


def _place(options: argparse.Namespace, chosen: str) -> Path:
    """Where the picture goes.

    Raises:
        UserError: if something is there that is not to be overwritten, or no directory can be made.
    """
    name = picture_name(chosen, options.compare, options.colour, options.shape, options.objective)
    out = options.run / name
    if options.out is not None:
        if options.out.suffix.lower() not in ("", ".png") and not options.out.is_dir():
            raise UserError(f"--out {options.out}: give a .png file or an existing directory")
        named = options.out.suffix.lower() == ".png" and not options.out.is_dir()
        out = options.out if named else options.out / name
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"--out {options.out} cannot be written: {error.strerror or error}") from None
    if os.path.lexists(out) and (options.out is not None or not _own(out)):
        raise UserError(f"{out} already exists and is not overwritten: choose another --out, or move it away")
    return out


def _own(path: Path) -> bool:
    """Whether a file is a picture that this command wrote."""
    try:
        return f"Software\0{SOFTWARE}".encode() in path.read_bytes()
    except OSError:
        return False


def _run(command: list[str], timeout: float, what: str, run: Path) -> None:
    """Draw in a process of its own, which a missing OpenGL may kill."""
    code, reason = processes.attempt(command, timeout)
    reason = reason.removeprefix("rbfevo.show: ")
    if code == processes.USER_ERROR:
        raise UserError(reason)
    if code != 0:
        pictures = "use --pictures, " if what == "the window" else ""
        raise BrokenError(
            f"{what} could not be drawn: {reason}; {pictures}open the run's report.html in a browser, or draw without "
            f"OpenGL by python -m rbfevo.figures {shlex.quote(str(run))}"
        )


def _draw(options: argparse.Namespace, record: Record, state: State) -> None:
    """Draw in this process: a picture if there is --out, else a window."""
    from rbfevo.figures.window import Window, png  # with OpenGL
    from rbfevo.files import write_whole

    try:
        window = Window(options.run, record, state, off_screen=options.out is not None)
        if options.out is None:
            window.open()
        else:
            write_whole(options.out, png(window.picture(bare=True)))
    except RuntimeError as error:
        raise BrokenError(str(error)) from None


if __name__ == "__main__":
    parsers.start(main)
