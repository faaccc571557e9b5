"""Meshes that VTK or meshio reads and writes, in a process that may die: the parent of `rbfevo/meshes/worker`."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.meshes import vtk_datasets
from rbfevo.meshes.mesh import Cells, Faces, FormatError, Mesh
from rbfevo.meshes.worker import messages

WORKER = Path(messages.__file__).with_name("__main__.py")
PATIENCE, SPEED = 30.0, 2e5  # seconds, and bytes a second: meshio reads some damaged files for ever
SOLVER = "written anew by meshio, which keeps points, cells and the arrays and sets that it knows, and nothing else"


@contextlib.contextmanager
def foreign(kind: str, path: Path) -> Iterator[Mesh]:
    """A mesh that `kind` (`vtk` or `meshio`) reads, open until the end of the block.

    Raises:
        FormatError: if it cannot be read; UserError by `write` if it cannot be written.
    """
    patience = PATIENCE + path.stat().st_size / SPEED
    command = [sys.executable, "-P", str(WORKER), kind, str(path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL) as process:
        try:
            try:
                found = _reply(process, kind, patience)
            except ValueError as error:
                raise FormatError(str(error)) from None

            def write(moved: Array, displacement: Array, out: Path) -> list[str]:
                """Have the worker write moved points [n, 3] and displacements [n, 3] to a file; return notes."""
                return _write(process, {"moved": moved, "displacement": displacement}, out, kind, 2 * patience)

            yield mesh_of(found, write, [SOLVER] if kind == "meshio" else [])
        finally:
            process.kill()


def mesh_of(found: dict[str, Any], write: Callable[[Array, Array, Path], list[str]], kept: list[str]) -> Mesh:
    """The mesh that a reply of the worker describes."""
    faces = (found["face cells"], found["face sizes"], found["face corners"])
    return Mesh(
        found["points"].astype(np.float64),
        write,
        Cells(found["kinds"], found["sizes"], found["corners"], Faces(*faces) if len(faces[0]) else None),
        messages.unpacked("array", found),
        messages.unpacked("cell array", found),
        messages.unpacked("patch", found),
        dimension=int(found.get("dimension", 3)),
        kept=kept,
    )


def _reply(process: subprocess.Popen[bytes], kind: str, patience: float) -> dict[str, Any]:
    if process.stdout is None:
        raise ValueError("the process that reads it has no output")
    name, late = {"vtk": "VTK", "meshio": "meshio"}[kind], threading.Event()

    def stop() -> None:
        """End the process, and note that it was too slow."""
        late.set()
        process.kill()

    clock = threading.Timer(patience, stop)
    clock.start()
    try:
        reply = messages.receive(process.stdout)
    except EOFError:
        endless = f"did not finish reading within {patience:.0f} s: damaged"
        raise ValueError(f"{name} {endless if late.is_set() else 'dies of it: damaged, or too large'}") from None
    finally:
        clock.cancel()
    if "problem" in reply:
        raise ValueError(str(reply["problem"]))
    return reply


def _write(
    process: subprocess.Popen[bytes], arrays: dict[str, Any], out: Path, kind: str, patience: float
) -> list[str]:
    if process.stdin is None:
        raise ValueError("the process that writes it has no input")
    with _beside(out) as place:
        try:
            messages.send(process.stdin, {**arrays, "out": str(place)})
            notes = _reply(process, kind, patience)["notes"]
        except (ValueError, OSError) as error:
            raise UserError(f"{out} cannot be written: {error}") from None
    return [str(note) for note in notes]


@contextlib.contextmanager
def _beside(out: Path) -> Iterator[Path]:
    """A place of the same name in a directory of its own; what lies there at the end moves to `out`, whole.

    Some formats keep their arrays in a second file beside the first.
    """
    try:
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as directory:
            place = Path(directory) / out.name
            yield place
            for written in sorted(Path(directory).iterdir(), key=lambda path: path == place):
                written.chmod(0o644)
                written.replace(out.parent / written.name)
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror or error}") from error


def write_dataset(dataset: Any, out: Path) -> None:
    """Write a VTK dataset of our own, whole.

    Raises:
        UserError: if it cannot be written there.
    """
    with _beside(out) as place:
        try:
            vtk_datasets.write_dataset(dataset, place)
        except ValueError as error:
            raise UserError(f"{out} cannot be written: {error}") from None
