"""`python -m rbfevo.studio [MESH|RUN]`: paint on a mesh where it should move, and see the front of setups follow."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rbfevo.commands import parsers
from rbfevo.errors import UserError

if TYPE_CHECKING:
    from rbfevo.studio.app import Studio

LOCAL = "127.0.0.1"
DESCRIPTION = """Open a local page on a mesh: paint where it should move and what must stay, see the front of setups
follow, choose one, pull its control points, and save all as a run directory.

The page is at the address that is printed, on this machine alone; its token keeps others out. docs/studio.md explains
it."""


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.Parser("rbfevo.studio", DESCRIPTION)
    made.add_argument(
        "path", type=Path, nargs="?", metavar="MESH|RUN", help="a surface mesh, a run directory, or a saved painting"
    )
    made.add_argument(
        "--patch", action="append", default=[], metavar="NAME", help="of a mesh with patches: only this one"
    )
    made.add_argument(
        "--directory", type=Path, metavar="DIR", help="where the painting is kept (default: outputs/studio/NAME)"
    )
    made.add_argument("--port", type=int, default=0, help="the port to listen on (default: a free one)")
    made.add_argument(
        "--host", default=LOCAL, help=f"the address to listen on (default: {LOCAL}, which this machine alone can reach)"
    )
    made.add_argument("--open", action="store_true", help="open the page in a browser")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, 2 for a user's mistake, 130 for Ctrl-C."""
    return parsers.carried_out(parser, carry_out, arguments)


def carry_out(options: argparse.Namespace) -> int:
    """Serve the page until it is stopped.

    Raises:
        UserError: for a user's mistake.
    """
    try:
        import trame.widgets.plotly
        import trame.widgets.vtk  # noqa: F401
    except ImportError:
        raise UserError("the studio needs trame: pip install 'rbfevo[studio]'") from None
    from rbfevo.names import existing_home
    from rbfevo.runs.lock import locked
    from rbfevo.studio import keeping
    from rbfevo.studio.opening import example, opened

    if not 0 <= options.port < 65536:
        raise UserError(f"--port {options.port}: give a number from 0 (a free port) to 65535")
    path = None if options.path is None else existing_home(options.path)
    state, template = example() if path is None else opened(path, options.patch or None)
    name = "example" if path is None else path.resolve().name if path.is_dir() else path.stem
    directory = options.directory or Path("outputs") / "studio" / name
    with locked(directory):
        from rbfevo.studio.app import Studio

        before = None if path is not None and path.resolve() == directory.resolve() else keeping.kept(directory)
        studio = Studio(state, directory, template, options.host, options.port)
        if before is not None and before.begun:
            if not before.same_surface(state):
                raise UserError(
                    f"{directory} keeps a painting of another surface ({before.source}); choose another --directory"
                )
            when = time.strftime("%Y-%m-%d %H:%M", time.localtime((directory / keeping.FILE).stat().st_mtime))
            studio.offer(before, when)
        os.environ["WSLINK_READY_MSG"] = ""  # which wslink would print
        if options.host != LOCAL:
            parsers.complain(
                "rbfevo.studio",
                f"warning: --host {options.host}: other machines can reach this page, unencrypted; whoever sees its "
                "address can paint and write files here",
            )
        try:
            stopped = asyncio.run(served(studio, lambda address: announce(address, options.open)))
        except OSError as error:
            raise UserError(f"--host {options.host} --port {options.port}: {error.strerror or error}") from None
    if stopped == signal.SIGINT:
        raise KeyboardInterrupt
    return 128 + stopped


async def served(studio: Studio, announce: Callable[[str], None]) -> int:
    """Serve a page until SIGINT or SIGTERM; return the signal's number."""
    serving, heard = asyncio.create_task(studio.run(announce)), []

    def stop(number: signal.Signals) -> None:
        """End it; what was painted is kept on the way out."""
        heard.append(number)
        serving.cancel()

    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(NotImplementedError):  # Windows has none: Ctrl-C is then a KeyboardInterrupt
            asyncio.get_running_loop().add_signal_handler(number, stop, number)
    with contextlib.suppress(asyncio.CancelledError):
        await serving
    return int(heard[0]) if heard else 0


def announce(address: str, in_browser: bool) -> None:
    """Print the address, and open it if asked."""
    print(f"studio: {address}", flush=True)
    if in_browser:
        import webbrowser

        webbrowser.open(address)


if __name__ == "__main__":
    parsers.start(main)
