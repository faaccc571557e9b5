"""Displacements or RBF weights of the centers, read from a CSV, NPY or NPZ file, and written as CSV."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.files import csv_text
from rbfevo.meshes.text_table import read_table

_SAME = 1e-6  # of the largest coordinate: spreadsheets round
LETTERS = {"displacements": "d", "weights": "w"}
MOVED = ("moved_x", "moved_y", "moved_z")  # how far centers really move where regions are held: not read back


def numbered(names: list[str], places: Array, rows: Array) -> bytes:
    """A table of rows [m, 3] with the places of the centers, so that it cannot be mistaken for another setup's."""
    known = bool(np.isfinite(places).all())
    lines = enumerate(np.hstack([places, rows] if known else [rows]).tolist())
    return csv_text(["center", *("xyz" if known else ""), *names], [(center, *line) for center, line in lines])


def read_rows(path: Path, what: str, centers: Array, heights: bool) -> Array:
    """Rows [m, 3] of `what` (`displacements` or `weights`), one for each center, in their order.

    A CSV has three columns, or those that its header names: x, y, z, or dx, dy, dz or wx, wy, wz. With a column
    `center` the rows may be in any order. An NPY file holds [m, 3]; an NPZ file holds that under the name `what`.
    Columns x, y, z beside these say where the centers [m, d] are, and are compared with them. With `heights` (the
    plane) one column is taken too: it is z.

    Raises:
        UserError: if the file is missing or unreadable, has another shape, or numbers that are not finite.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"--{what} {path}: no such file") from None
    except (OSError, ValueError) as error:
        raise UserError(f"--{what} {path}: cannot be read ({error})") from None
    try:
        rows = _archive(content, what) if content[:6] == b"\x93NUMPY" or content[:2] == b"PK" else _csv(content, what)
        if rows.ndim == 2 and rows.shape[1] == 6:
            _refuse_others(rows[:, :3], centers)
            rows = rows[:, 3:]
        return _checked(rows, len(centers), heights)
    except UserError as error:
        raise UserError(f"--{what} {path}: {error}") from None
    except (OSError, ValueError, KeyError, EOFError, SyntaxError, MemoryError, zipfile.BadZipFile) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"--{what} {path}: cannot be read ({reason})") from None
    except Exception as error:  # an archive's members are decompressed by code that raises what it likes
        raise UserError(f"--{what} {path}: cannot be read ({type(error).__name__})") from None


def _archive(content: bytes, what: str) -> Array:
    loaded = np.load(io.BytesIO(content), allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return loaded
    with loaded:
        if what not in loaded:
            raise UserError(f"it has no array named {what}; its arrays: {', '.join(loaded) or 'none'}")
        return loaded[what]


def _csv(content: bytes, what: str) -> Array:
    if not content.strip():
        raise UserError("the file is empty")
    table = read_table(content)
    rows = table.numbers()
    return rows if table.header is None else _ordered(rows, [name.lower() for name in table.header], what)


def _ordered(rows: Array, header: list[str], what: str) -> Array:
    """Columns by the names of a header, rows by its column `center`."""
    names = [name for name in header if name != "center" and name not in MOVED]
    other = next(name for name in LETTERS if name != what)
    if names and all(name in [LETTERS[other] + axis for axis in "xyz"] for name in names):
        raise UserError(f"it holds {other}, as its header says ({', '.join(names)}): give it with --{other}")
    own = [LETTERS[what] + axis for axis in "xyz"]
    places = ["x", "y", "z"] if sorted(names) == sorted(["x", "y", "z", *own]) else []
    names = own if places else names
    axes = [name.removeprefix(LETTERS[what]) for name in names]
    if sorted(axes) not in (["x", "y", "z"], ["z"]) or header.count("center") > 1:
        letter = LETTERS[what]
        raise UserError(f"its header is {','.join(header)[:80]}, but must be center,{letter}x,{letter}y,{letter}z")
    columns = [header.index(names[axes.index(axis)]) for axis in ("x", "y", "z") if axis in axes]
    columns = [header.index(axis) for axis in places] + columns
    if "center" in header:
        number = rows[:, header.index("center")]
        if sorted(number.tolist()) != list(range(len(rows))):
            raise UserError(f"its column center must hold each number from 0 to {len(rows) - 1} once")
        rows = rows[np.argsort(number)]
    return rows[:, columns]


def _refuse_others(places: Array, centers: Array) -> None:
    """Raise UserError if the places in a table are not those of the centers: it was made for another setup."""
    own = np.zeros((len(centers), 3))
    own[:, : centers.shape[1]] = centers
    near = _SAME * max(float(np.abs(own).max()), 1e-300)
    if len(places) != len(own) or not np.allclose(places, own, rtol=0.0, atol=near):
        raise UserError("its columns x, y, z are not the centers of this setup: it was made for another pick")


def _checked(rows: Array, m: int, heights: bool) -> Array:
    if rows.dtype.kind not in "fiu":
        raise UserError("its values are not numbers")
    if rows.ndim == 1 and heights and len(rows) == m:
        rows = rows[:, None]
    widths = (1, 3) if heights else (3,)
    if rows.ndim != 2 or rows.shape[1] not in widths or len(rows) != m:
        expected = f"[{m}, 3]" + (f" or [{m}, 1]" if heights else "")
        hint = "; if one column numbers the centers, add the header center,dx,dy,dz"
        raise UserError(
            f"its shape is {list(rows.shape)}, but for {m} centers {expected} is expected"
            + (hint if rows.ndim == 2 and rows.shape[1] == 4 else "")
        )
    rows = rows.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        raise UserError(f"row {bad[0]} (counted from 0) is not finite (NaN or infinite)")
    if rows.shape[1] == 1:
        rows = np.column_stack([np.zeros((m, 2)), rows])
    return rows
