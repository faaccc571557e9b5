"""Read a mesh file in a process of its own, so that whatever a reader does, this process lives on.

VTK's readers end the whole process on some damaged files (a segmentation fault, an allocation that nobody catches),
meshio's raise what they like, print, exit, or never come back. So this file is also a program, `python separate.py
READER FILE ENDING`: it runs `read` of READER, one of the files `vtk_files.py` and `meshio_files.py` beside this one,
and writes what that returns to standard output. It imports NumPy and the reader only.
"""

from __future__ import annotations

import contextlib
import io
import os
import runpy
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

READERS = ("vtk_files", "meshio_files")
_SECONDS, _SECONDS_PER_BYTE, _MOST_SECONDS = 20.0, 1e-5, 300.0
_PARTS = ("points", "kinds", "sizes", "corners")


def read(reader: str, path: Path, ending: str) -> dict[str, Any]:
    """Return what the `reader`, one of READERS, finds in the file: points, cells, arrays and notes.

    Keys: `points` [n, 3] float64; `kinds` [c] uint8 (VTK's numbers), `sizes` [c] and `corners` of the cells;
    `arrays`, a dict of [n] or [n, k] float64; `cell_arrays` and `notes`, lists of str.

    Raises:
        ValueError: if the file cannot be read, or not in the time that its size allows (20 s and 10 s more for every
            megabyte, at most 300 s).
    """
    script = Path(__file__).with_name(f"{reader}.py")
    command = [sys.executable, "-P", __file__, str(script), str(path.absolute()), ending]
    limit = min(_SECONDS + _SECONDS_PER_BYTE * path.stat().st_size, _MOST_SECONDS)
    try:
        reply = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=limit)
    except subprocess.TimeoutExpired:
        raise ValueError(f"damaged or too large: no end of it after {limit:.0f} s") from None
    if reply.returncode != 0:
        raise ValueError("damaged: it cannot be read")
    return unpack(reply.stdout)


def unpack(reply: bytes) -> dict[str, Any]:
    """Return what `answer` has packed; ValueError with its one line if that is a problem."""
    with np.load(io.BytesIO(reply), allow_pickle=False) as packed:
        if "problem" in packed:
            raise ValueError(str(packed["problem"]))
        found: dict[str, Any] = {name: packed[name] for name in _PARTS}
        found["arrays"] = {str(name): packed[f"array {i}"] for i, name in enumerate(packed["arrays"])}
        found["cell_arrays"] = [str(name) for name in packed["cell_arrays"]]
        found["notes"] = [str(note) for note in packed["notes"]]
        return found


def answer(script: str, path: str, ending: str) -> bytes:
    """Run `read` of the reader `script` on a file and pack what it returns, or the one line of its problem."""
    reply, printed = io.BytesIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = runpy.run_path(script)["read"](path, ending)
        packed = {name: found[name] for name in _PARTS}
        names = sorted(found["arrays"])
        packed |= {f"array {i}": np.asarray(found["arrays"][name], np.float64) for i, name in enumerate(names)}
        packed |= {"arrays": np.array(names, np.str_), "cell_arrays": np.array(found["cell_arrays"], np.str_)}
        packed["notes"] = np.array(found["notes"], np.str_)
        np.savez(reply, allow_pickle=False, **packed)
    except ModuleNotFoundError as error:
        said = f"reading it needs the package {error.name}, which is not installed: pip install {error.name}"
        np.savez(reply, problem=said)
    except (Exception, SystemExit) as error:
        lines = (printed.getvalue() if isinstance(error, SystemExit) else str(error)).split("\n")
        said = next((line.strip() for line in lines if line.strip()), "")[:160]
        np.savez(reply, problem=said or f"damaged, or not of this format ({type(error).__name__})")
    return reply.getvalue()


def _main() -> None:
    output = os.dup(1)
    os.dup2(2, 1)  # what a reader prints, from C++ too, must not mix with the answer
    with os.fdopen(output, "wb") as file:
        file.write(answer(*sys.argv[1:]))


if __name__ == "__main__":
    _main()
