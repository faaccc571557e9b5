"""The process that reads a mesh (rbfevo/meshes/worker), as a fork of a test's: it need not start Python and NumPy.

That is a fifth of a second for each of some hundred files. What it reads, answers and writes is the same; how it is
started is left to the tests of meshes' files, which use no fork.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import types
import warnings
from pathlib import Path
from typing import Any, NoReturn


class Fork:
    """What `rbfevo/meshes/foreign.py` needs of a `subprocess.Popen` of its worker."""

    def __init__(self, command: list[str], **_: Any) -> None:
        import pyvista  # noqa: F401  # with VTK's readers, so that not each fork loads them

        request, stdin = os.pipe()
        stdout, reply = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            _work(command[-2], Path(command[-1]), request, reply)
        os.close(request)
        os.close(reply)
        self.stdin, self.stdout = os.fdopen(stdin, "wb"), os.fdopen(stdout, "rb")

    def kill(self) -> None:
        """End it."""
        os.kill(self.pid, signal.SIGKILL)

    def __enter__(self) -> Fork:
        return self

    def __exit__(self, *_: object) -> None:
        self.stdout.close()
        with contextlib.suppress(BrokenPipeError):
            self.stdin.close()
        os.waitpid(self.pid, 0)


def _work(kind: str, path: Path, request: int, reply: int) -> NoReturn:
    """Do the worker's work on these pipes, and end; nothing else of the test's process goes on here."""
    try:
        nothing = os.open(os.devnull, os.O_WRONLY)
        for number, stream in enumerate((request, reply, nothing)):
            os.dup2(stream, number)
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))
        warnings.resetwarnings()
        warnings.simplefilter("ignore")
        sys.stdin, sys.stdout, sys.stderr = os.fdopen(0), os.fdopen(1, "w"), os.fdopen(2, "w")
        from rbfevo.meshes.worker.serve import serve

        serve(kind, path)
    finally:
        os._exit(0)


INSTEAD = types.SimpleNamespace(Popen=Fork, PIPE=subprocess.PIPE, DEVNULL=subprocess.DEVNULL)
