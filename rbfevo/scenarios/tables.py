"""Numbers in lines of text: comma, semicolon or space between them, with or without a header."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of a text file, not yet numbers.

    Attributes:
        header: the columns' names in lower case; None without a header.
        rows: the lines of numbers; delimiter: what stands between them, None for space.
    """

    header: list[str] | None
    rows: list[str]
    delimiter: str | None

    def numbers(self, columns: Sequence[int] | None = None) -> NDArray[np.float64]:
        """Return the `columns` (all without) as float64 [rows, columns]; ValueError says where that fails."""
        return np.loadtxt(
            self.rows,
            dtype=np.float64,
            delimiter=self.delimiter,
            usecols=columns,
            ndmin=2,
            comments=None,
            quotechar='"',
        )


def read_table(content: bytes, looked_at: int | None = None, counted: bool = False) -> Table:
    """Split text into rows; lines that begin with # or // are comments.

    The first line is a header unless each of its first `looked_at` fields (all without) is a number. With `counted`, a
    first line that is one whole number is the number of rows, and is passed over. With semicolons between the fields a
    decimal comma is understood.

    Raises:
        ValueError: if there are no rows.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    rows = [row.strip() for row in text.splitlines()]
    rows = [row for row in rows if row and not row.startswith(("#", "//"))]
    if counted and rows and rows[0].isdigit():
        rows = rows[1:]
    if not rows:
        raise ValueError("no lines with points in it" if counted else "no lines with numbers in it")
    delimiter = ";" if ";" in rows[0] else "," if "," in rows[0] else None
    first = rows[0].split() if delimiter is None else next(csv.reader([rows[0]], delimiter=delimiter))
    if delimiter == ";":
        rows = [row.replace(",", ".") for row in rows]
        first = [field if not _is_number(field.replace(",", ".")) else field.replace(",", ".") for field in first]
    if all(_is_number(field) for field in first[:looked_at]):
        return Table(None, rows, delimiter)
    if len(rows) == 1:
        raise ValueError(f"a header, but no lines with {'points' if counted else 'numbers'}")
    return Table([field.strip().strip("\"'").strip().lower() for field in first], rows[1:], delimiter)


def _is_number(field: str) -> bool:
    try:
        float(field.strip().strip('"'))
    except ValueError:
        return False
    return True
