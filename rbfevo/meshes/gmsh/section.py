"""A section of a file, from `$Name` to `$EndName`: its lines, or its binary numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.places import lines


@dataclasses.dataclass(frozen=True)
class Section:
    """Where a section of the file begins and ends, and how its numbers are written."""

    content: bytes
    begin: int
    end: int
    order: str
    binary: bool
    name: str

    def lines(self) -> Iterator[tuple[int, bytes]]:
        """The lines of a section in text, with where each begins in the file."""
        return lines(self.content[: self.end], start=self.begin)

    def numbers(self, at: int, dtype: str | np.dtype, count: int) -> Any:
        """Numbers of a binary section; FormatError if the file ends before."""
        dtype = np.dtype(dtype if isinstance(dtype, np.dtype) else self.order + dtype)
        if count < 0 or at + count * dtype.itemsize > len(self.content):
            raise FormatError(f"cut off in ${self.name}")
        return np.frombuffer(self.content, dtype, count, at)


def next_line(rows: Iterator[tuple[int, bytes]], name: str) -> tuple[int, bytes]:
    """The next of the lines of the section `name`; FormatError if there is none."""
    row = next(rows, None)
    if row is None:
        raise FormatError(f"cut off: ${name} announces more than it has")
    return row


def finish(rows: Iterator[tuple[int, bytes]], name: str) -> None:
    """Raise FormatError if the section `name` has lines left."""
    if next(rows, None) is not None:
        raise FormatError(f"its section ${name} has more lines than it announces")
