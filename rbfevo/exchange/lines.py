"""OBJ, OFF, XYZ and CSV: the three coordinates of every point are put in place, all other bytes stay as they are."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from rbfevo.exchange.mesh import FormatError, Mesh, fans, sound, written_as
from rbfevo.record import Array

WORD = re.compile(rb"[^\s]+")
CELLS = {b",": re.compile(rb"[^,\r\n]+"), b";": re.compile(rb"[^;\r\n]+"), b" ": WORD}


class Places:
    """Where in the bytes of a file the coordinates of its points stand."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.points: list[tuple[float, ...]] = []
        self._spans: list[tuple[int, int]] = []

    def add(self, words: list[re.Match[bytes]], offset: int, comma: bool = False) -> None:
        """One point, by the words of its coordinates and where their line begins; `comma` reads decimal commas."""
        texts = [word[0].replace(b",", b".") if comma else word[0] for word in words]
        try:
            self.points.append(tuple(float(text.strip(b' \t"')) for text in texts))
        except ValueError:
            raise FormatError(f"point {len(self.points)} (from 0) has a coordinate that is no number") from None
        self._spans.extend((offset + word.start(), offset + word.end()) for word in words)

    def rewritten(self, moved: Array, comma: bool = False) -> bytes:
        """The file with moved points [q, 3], each number with all its digits."""
        pieces, end = [], 0
        numbers = moved[:, : len(self.points[0])].ravel().tolist()
        for (start, stop), number in sorted(zip(self._spans, numbers, strict=True)):  # columns may stand in any order
            text = repr(number).replace(".", ",") if comma else repr(number)
            pieces += [self.content[end:start], text.encode()]
            end = stop
        return b"".join([*pieces, self.content[end:]])

    def mesh(self, triangles: Array | None, notes: list[str], comma: bool = False) -> Mesh:
        """The mesh that these points belong to.

        Raises:
            FormatError: if there are no points, or a triangle refers to one that is not there.
        """
        if not self.points:
            raise FormatError("there are no points in it: empty or damaged")
        points = np.array(self.points, dtype=np.float64)
        flat = points.shape[1] == 2
        if flat:
            points = np.column_stack([points, np.zeros(len(points))])
        triangles = None if triangles is None else sound(triangles, len(points))
        write = written_as(lambda moved: self.rewritten(moved, comma))
        return Mesh(points, triangles, None, 2 if flat else 3, notes, write)


def read_obj(content: bytes) -> Mesh:
    """Wavefront OBJ: the `v` lines count; a fourth coordinate and vertex colours stay."""
    places, polygons, offset, normals = Places(content), [], 0, False
    for line in content.splitlines(keepends=True):
        key = line.lstrip()[:2]
        if key[:1] == b"v" and key[1:].isspace():
            words = list(WORD.finditer(line))
            if len(words) < 4 or words[-1][0].endswith(b"\\"):
                raise FormatError(f"vertex {len(places.points)} (from 0) is not three coordinates on one line")
            places.add(words[1:4], offset)
        elif key[:1] == b"f" and key[1:].isspace():
            polygons.append(_corners(line, len(places.points)))
        elif key == b"vn":
            normals = True
        offset += len(line)
    return places.mesh(fans(polygons), _stale(normals))


def _corners(line: bytes, count: int) -> list[int]:
    """Corners from 0 of an OBJ's face; those below zero count back from the last vertex so far."""
    try:
        corners = [int(word.split(b"/")[0]) for word in line.split()[1:] if word != b"\\"]
    except ValueError:
        raise FormatError("a face has a corner that is no number") from None
    return [corner - 1 if corner > 0 else corner + count for corner in corners]


def read_off(content: bytes) -> Mesh:
    """OFF with its variants COFF, NOFF and STOFF in text: the first three numbers of every vertex count."""
    lines, offset = [], 0
    for line in content.splitlines(keepends=True):
        words = list(WORD.finditer(line.split(b"#")[0]))
        if words:
            lines.append((offset, words))
        offset += len(line)
    if not lines:
        raise FormatError("the file is empty")
    header, first = b"", lines[0][1]
    if not first[0][0].isdigit():
        header = first[0][0].upper()
        if not re.fullmatch(rb"(ST)?C?N?OFF", header) or any(word[0].upper() == b"BINARY" for word in first):
            raise FormatError("only text files with three coordinates a point are read")
        lines[0] = (lines[0][0], first[1:])
        lines = lines if first[1:] else lines[1:]
    try:
        n, f = (int(word[0]) for word in lines[0][1][:2])
    except (IndexError, ValueError):
        raise FormatError("the numbers of vertices and faces are missing") from None
    if n < 0 or f < 0 or len(lines) < 1 + n + f:
        raise FormatError(f"cut off: it announces {n} vertices and {f} faces, a line each, and has {len(lines) - 1}")
    places = Places(content)
    for offset, words in lines[1 : 1 + n]:
        if len(words) < 3:
            raise FormatError(f"vertex {len(places.points)} (from 0) has fewer than three coordinates")
        places.add(words[:3], offset)
    polygons = []
    for _, words in lines[1 + n : 1 + n + f]:
        try:
            corners = [int(word[0]) for word in words[: 1 + max(int(words[0][0]), 0)]]
        except ValueError:
            raise FormatError("a face has a corner that is no number") from None
        if len(corners) != 1 + corners[0]:
            raise FormatError("a face has fewer corners than it announces")
        polygons.append(corners[1:])
    return places.mesh(fans(polygons), _stale(header[:-3].endswith(b"N")))


def read_table(content: bytes) -> Mesh:
    """XYZ and CSV clouds: the columns x, y, z of a header, or the first three; all other columns stay.

    Separated by comma, semicolon (then a decimal comma is understood) or space; a first line may be the number of
    points.
    """
    places, offset, columns = Places(content), 0, None
    delimiter, comma = b" ", False  # comma: whether the file's numbers have decimal commas
    for line in content.splitlines(keepends=True):
        text = line.removeprefix(b"\xef\xbb\xbf") if offset == 0 else line
        begin, offset = offset + len(line) - len(text), offset + len(line)
        if not text.strip() or text.lstrip().startswith((b"#", b"//")):
            continue
        if columns is None:
            if text.strip().isdigit():
                continue
            delimiter = b";" if b";" in text else b"," if b"," in text else b" "
            columns, is_header = _table_columns(list(CELLS[delimiter].finditer(text)), delimiter == b";")
            if is_header:
                continue
        words = list(CELLS[delimiter].finditer(text))
        if max(columns) >= len(words):
            raise FormatError(f"point {len(places.points)} (from 0) has fewer than {max(columns) + 1} columns")
        comma = comma or (delimiter == b";" and any(b"," in words[c][0] for c in columns))
        places.add([words[c] for c in columns], begin, delimiter == b";")
    return places.mesh(None, [], comma)


def _table_columns(words: list[re.Match[bytes]], comma: bool) -> tuple[tuple[int, ...], bool]:
    """Which columns hold x, y and z by the first line of a table, and whether that line is a header."""
    names = [word[0].strip().strip(b"\"'").lower() for word in words]
    for name in names[:3]:
        try:
            float(name.replace(b",", b".") if comma else name)
        except ValueError:
            if {b"x", b"y", b"z"} <= set(names):
                return tuple(names.index(axis) for axis in (b"x", b"y", b"z")), True
            return (0, 1, 2), True
    if len(names) < 3:
        raise FormatError("a point needs three coordinates")
    return (0, 1, 2), False


def _stale(normals: bool) -> list[str]:
    return ["its vertex normals are kept as they were and do not fit the deformed shape"] if normals else []


READERS: dict[str, Callable[[bytes], Mesh]] = {
    ".obj": read_obj,
    ".off": read_off,
    ".xyz": read_table,
    ".csv": read_table,
}
