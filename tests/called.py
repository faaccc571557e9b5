"""Commands within the process of a test: starting Python and importing torch would be most of their time."""

from __future__ import annotations

import contextlib
import importlib
import io
import runpy
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest


class Called(NamedTuple):
    """What a command leaves: its exit code, and what it printed."""

    returncode: int
    stdout: str
    stderr: str


def command(name: str, *arguments: str) -> Called:
    """Carry out `python -m NAME ARGUMENTS` by the function that it calls."""
    module: Any = importlib.import_module(name)
    if hasattr(module, "__path__"):  # a package
        module = importlib.import_module(f"{name}.__main__")
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = module.main(list(arguments))
    return Called(code, out.getvalue(), err.getvalue())


def script(path: Path, *arguments: str) -> Called:
    """Carry out `python PATH ARGUMENTS`."""
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(sys, "argv", [str(path), *arguments])
        patch.setattr(sys, "path", [str(path.parent), *sys.path])
        code: Any = 0
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            code = end.code or 0
    return Called(code if isinstance(code, int) else 1, out.getvalue(), err.getvalue())


def line(words: list[str]) -> Called:
    """Carry out `python WORDS`, such as `-m NAME ARGUMENTS` or `PATH ARGUMENTS`."""
    return command(*words[1:]) if words[0] == "-m" else script(Path(words[0]), *words[1:])
