"""What the worker does: read one file, answer with what it holds, wait for moved points, write them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

from rbfevo.meshes.worker.meshio_file import MeshioFile
from rbfevo.meshes.worker.messages import receive, send
from rbfevo.meshes.worker.vtk_file import VtkFile

KINDS = {"vtk": VtkFile, "meshio": MeshioFile}


def serve(kind: str, path: Path) -> None:
    """Answer the parent's messages about one file, which `kind` (`vtk` or `meshio`) reads, until it is written."""
    # What a library prints must not get between the messages.
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        file = KINDS[kind](path)
        send(replies, file.reply)
        request = receive(sys.stdin.buffer)
        notes = file.write(request["moved"], request["displacement"], Path(str(request["out"])))
        send(replies, {"notes": np.array(notes, dtype=np.str_)})
    except EOFError:
        return
    except (Exception, SystemExit) as error:  # loaders raise whatever they like on a damaged file
        send(replies, {"problem": problem(error)})


def problem(error: BaseException) -> str:
    """What a library's error means to the user of the file, in one line."""
    if isinstance(error, ModuleNotFoundError):
        return f"meshio needs {error.name} for this format: pip install {error.name}"
    message = " ".join(str(error).split())[:300] or type(error).__name__
    return message if isinstance(error, ValueError) else f"damaged, or not of this format ({message})"
