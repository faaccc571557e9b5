"""Numbers in the text of a file: the coordinates of its points, and where in the bytes they stand.

Numbers are read from the fields of a line; where exactly they stand is looked up only when the file is written back, in
the lines that were kept for it. So a file of a million points is read at the speed of `bytes.split`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from rbfevo.arrays import Array
from rbfevo.meshes.mesh import FormatError

FIELD = re.compile(rb"\S+")


def lines(content: bytes, comment: bytes | None = None, start: int = 0) -> Iterator[tuple[int, bytes]]:
    """Lines of a text that have something on them, with where each begins; ends of lines may be CR, LF or CRLF.

    What follows `comment` on a line is left out.
    """
    offset = start
    for line in (content[start:] if start else content).splitlines(keepends=True):
        text = line.split(comment, 1)[0] if comment is not None and comment in line else line
        if not text.isspace() and text:
            yield offset, text
        offset += len(line)


class Places:
    """The coordinates of a file's points, as they are found: `add` takes one point after another."""

    def __init__(
        self,
        content: bytes,
        columns: Sequence[int] = (0, 1, 2),
        separator: bytes | None = None,
        comma: bool = False,
    ) -> None:
        """Begin with no points.

        Args:
            content: the file; columns: which fields of a line hold x, y (and z).
            separator: what stands between fields, None for blanks; comma: whether numbers have decimal commas.
        """
        self._content, self._columns, self._separator, self._comma = content, tuple(columns), separator, comma
        self._rows: list[tuple[int, bytes]] = []
        self._numbers: list[bytes] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, offset: int, line: bytes) -> None:
        """One point: its line, and where that begins in the file.

        Raises:
            FormatError: if the line has too few fields.
        """
        fields = line.split(self._separator)
        try:
            self._numbers.extend([fields[column] for column in self._columns])
        except IndexError:
            raise FormatError(
                f"point {len(self)} (from 0) has too few numbers: {_shown(line)}; "
                f"{max(self._columns) + 1} are expected on its line"
            ) from None
        self._rows.append((offset, line))

    def points(self) -> Array:
        """The points [n, 3]; z = 0 where lines have two coordinates.

        Raises:
            FormatError: if there are none, or a coordinate is not a number.
        """
        if not self._rows:
            raise FormatError("it holds no points; is it empty or damaged?")
        found = numbers(self._numbers, "point", len(self._columns)).reshape(len(self), -1)
        return np.pad(found, ((0, 0), (0, 3 - len(self._columns))))

    def rewritten(self, moved: Array, others: Sequence[tuple[int, int, bytes]] = ()) -> bytes:
        """The file with moved points [n, 3], each number with all its digits, and `others` put in place as well.

        Every other byte stays.
        """
        pieces, end = [], 0
        for begin, stop, text in sorted([*self.rewritings(moved), *others]):
            pieces += [self._content[end:begin], text]
            end = stop
        return b"".join([*pieces, self._content[end:]])

    def rewritings(self, moved: Array) -> list[tuple[int, int, bytes]]:
        """What to put where for moved points [n, 3]: begin, end and the number's text, each number with all digits."""
        found = []
        for (offset, line), point in zip(self._rows, moved[:, : len(self._columns)].tolist(), strict=True):
            if self._separator is None:
                spans = [field.span() for field in FIELD.finditer(line)]
            else:
                spans = _separated(line, self._separator)
            for column, number in zip(self._columns, point, strict=True):
                begin, stop = spans[column]
                text = repr(number).replace(".", ",") if self._comma else repr(number)
                found.append((offset + begin, offset + stop, text.encode()))
        return found


def numbers(fields: Sequence[bytes], what: str, each: int) -> Array:
    """Floats from fields; FormatError names the first that is none, as part of the `what` that has `each` of them."""
    try:
        return np.array([float(field) for field in fields])
    except ValueError:
        pass
    for place, text in enumerate(fields):
        try:
            float(text)
        except ValueError:
            shown, number = text[:40].decode("latin-1"), f"{what} {place // each} (from 0)"
            if re.fullmatch(rb"[-+]?\d+,\d+(e[-+]?\d+)?", text, re.IGNORECASE):
                raise FormatError(f"{number} has a decimal comma, {shown!r}; write numbers with a point") from None
            raise FormatError(f"{number} has {shown!r} where a coordinate is expected") from None
    raise FormatError(f"a {what} has something that is no number")


def integers(line: bytes, what: str) -> list[int]:
    """Whole numbers of a line; FormatError names the `what` in which something else stands."""
    try:
        return [int(field) for field in line.split()]
    except ValueError:
        raise FormatError(f"{what} has something that is no whole number: {_shown(line)}") from None


def _separated(line: bytes, separator: bytes) -> list[tuple[int, int]]:
    """Where the fields between separators stand, without blanks around them; an empty field counts."""
    spans, begin = [], 0
    for field in line.split(separator):
        text = field.strip()
        at = begin + (field.find(text) if text else 0)
        spans.append((at, at + len(text)))
        begin += len(field) + 1
    return spans


def _shown(line: bytes) -> str:
    return repr(line.strip()[:40].decode("latin-1"))
