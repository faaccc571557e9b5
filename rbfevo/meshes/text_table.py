"""Tables in text, as people's programs write them: what separates the fields, which line names them, which are rows."""

from __future__ import annotations

import codecs
import csv
import dataclasses
import re
from collections.abc import Sequence

import numpy as np

from rbfevo.arrays import Array
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.places import lines

_COMMENTS = (b"#", b"//", b"%", b"!")
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?|[-+]?(?:nan|inf(?:inity)?)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(rb"[-+]?\d*,\d+(?:[eEdD][-+]?\d+)?")


@dataclasses.dataclass(frozen=True)
class TextTable:
    """Rows of a text file, not yet numbers.

    Attributes:
        header: the columns' names as they stand, without quotes; None without a header.
        rows: each row's line, and where it begins in the file; width: how many fields a row has.
        separator: what stands between fields, None for blanks; comma: whether numbers have decimal commas.
        in_place: whether where a row begins is true of the file's own bytes (not of one in UTF-16).
        notes: what was left out, a line each.
    """

    header: list[str] | None
    rows: list[tuple[int, bytes]]
    width: int
    separator: bytes | None
    comma: bool
    in_place: bool
    notes: list[str]

    def numbers(self, columns: Sequence[int] | None = None) -> Array:
        """Return the `columns` (all without) as float64 [rows, columns].

        Raises:
            FormatError: where a field is no number.
        """
        columns = range(self.width) if columns is None else columns
        fields = []
        for _, line in self.rows:
            row = _fields(line, self.separator)
            fields.extend(row[column] for column in columns)
        if self.comma:
            fields = [field.replace(b",", b".") for field in fields]
        try:
            found = np.array([float(field) for field in fields])
        except ValueError:
            found = self._fortran(fields, len(columns))
        return found.reshape(len(self.rows), len(columns))

    def _fortran(self, fields: list[bytes], each: int) -> Array:
        """Numbers with D for E, or the first that is none."""
        found = []
        for place, field in enumerate(fields):
            if not _NUMBER.fullmatch(field):
                row = self.rows[place // each][1].strip()[:60].decode("latin-1")
                shown = field[:40].decode("latin-1")
                raise FormatError(f"row {place // each} (from 0) has {shown!r} where a number is expected: {row!r}")
            found.append(float(re.sub(rb"[dD]", b"e", field)))
        return np.array(found)


def read_table(content: bytes) -> TextTable:
    """Split a text into rows: comma, semicolon, tab or blanks between the fields, with or without a header.

    Comments begin with #, //, % or !; the last one before the rows is their header if it has as many names (COMSOL). A
    first line `sep=;` names the separator (Excel); `[Data]` begins the rows (CFD-Post); a first line with one whole
    number is their count, and names may follow, one on each line (Fluent), or it is the number of observables, one,
    whose name and the count of rows follow (Fluent's export of sensitivities). Numbers may have decimal commas where
    these separate nothing, and D in the place of E (Fortran). A last row that begins with text (`Total`) is left out,
    with a note.

    Raises:
        FormatError: if there are no rows, or not all have as many fields as the first.
    """
    text, shift = content, 0
    in_place = not content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if not in_place:
        try:
            text = content.decode("utf-16").encode()
        except UnicodeDecodeError:
            raise FormatError("it begins as a text in UTF-16, but is none: damaged") from None
    elif content.startswith(codecs.BOM_UTF8):
        shift = len(codecs.BOM_UTF8)
    if b"\0" in text:
        raise FormatError("it is not a table in text")
    listed, notes = list(lines(text, start=shift)), []
    separators: list[bytes | None] = [b";", b"\t", b",", None]
    if listed and (stated := re.fullmatch(rb"\s*sep=(.)\s*", listed[0][1], re.IGNORECASE)):
        separators, listed = [stated[1]], listed[1:]
    data = [place for place, (_, line) in enumerate(listed) if line.strip().lower() == b"[data]"]
    if len(data) > 1:
        raise FormatError(f"it has {len(data)} sections [Data]; a table has one")
    if data:
        listed = listed[data[0] + 1 :]
        end = [place for place, (_, line) in enumerate(listed) if line.lstrip().startswith(b"[")]
        listed = listed[: end[0]] if end else listed
    comment = None  # the last one before the rows
    kept = []
    for offset, line in listed:
        if line.lstrip().startswith(_COMMENTS):
            comment = line.lstrip().lstrip(b"#/%!") if not kept else comment
        else:
            kept.append((offset, line))
    header, rows = None, kept
    if rows and rows[0][1].strip().isdigit() and len(rows) > 1:
        count = int(rows[0][1])
        names = next((i for i, (_, line) in enumerate(rows[1:]) if line.strip().isdigit()), None)
        if names and int(rows[1 + names][1]) == count and not any(_split(line)[0] for _, line in rows[1 : 1 + names]):
            header, rows = [_name(line) for _, line in rows[1 : 1 + names]], rows[2 + names :]
        elif names is not None and names == count and not any(_split(line)[0] for _, line in rows[1 : 1 + names]):
            observables = ", ".join(_name(line) for _, line in rows[1 : 1 + names])
            if count > 1:
                raise FormatError(
                    f"it holds several observables ({observables}); export the sensitivities of one alone"
                )
            if int(rows[2][1]) != len(rows) - 3:
                raise FormatError(f"it announces {int(rows[2][1])} rows, but has {len(rows) - 3}")
            notes.append(f"observable {observables}")
            rows = rows[3:]
        elif len(rows) - 1 in (count, count + 1) and len(rows[-1][1].replace(b",", b" ").split()) > 1:
            rows = rows[1:]  # of rows with one number each, it could be the first
    if not rows:
        raise FormatError("there are no lines with numbers in it")

    first = next((place for place in (0, 1) if place < len(rows) and _split(rows[place][1], separators)[0]), None)
    if first is None:
        first = min(1, len(rows) - 1)
        if first == 0 or not any(_NUMBER.search(line) for _, line in rows[1:]):
            raise FormatError("there are no lines with numbers in it")
    separator, comma = _split(rows[first][1], separators)[1:]
    if first == 1:
        if header is not None:
            raise FormatError(f"two lines name its columns: {rows[0][1].strip()[:60].decode('latin-1')!r}")
        header = [_name(field) for field in _fields(rows[0][1], separator)]
    rows = rows[first:]
    width = len(_fields(rows[0][1], separator))
    if header is None and comment is not None:
        named = [_name(field) for field in _fields(comment, separator)]
        header = named if len(named) == width and not all(_NUMBER.fullmatch(name.encode()) for name in named) else None
    if header is not None and len(header) == width + 1 and not header[-1]:
        header = header[:-1]
    if header is not None and len(header) != width:
        raise FormatError(f"its header names {len(header)} columns, but its first row has {width} fields")
    last = _fields(rows[-1][1], separator)
    if len(rows) > 1 and last and last[0] and not _is_number(last[0]) and _is_number(_fields(rows[0][1], separator)[0]):
        notes.append(f"its last row, {rows[-1][1].strip()[:60].decode('latin-1')!r}, is left out")
        rows = rows[:-1]
    if separator != b"," and not comma:
        comma = any(b"," in line and any(map(_DECIMAL_COMMA.fullmatch, _fields(line, separator))) for _, line in rows)
    for number, (_, line) in enumerate(rows):
        if len(_fields(line, separator)) != width:
            raise FormatError(f"row {number} (from 0) has {len(_fields(line, separator))} fields instead of {width}")
    return TextTable(header, rows, width, separator, comma, in_place, notes)


def _split(
    line: bytes, separators: Sequence[bytes | None] = (b";", b"\t", b",", None)
) -> tuple[bool, bytes | None, bool]:
    """Whether a line holds numbers: the separator for which its first fields do, and whether they have commas."""
    for separator in separators:
        if separator is not None and separator not in line:
            continue
        fields = [field for field in _fields(line, separator) if field]
        leading = fields[: max(1, len(fields) - 1)] if len(fields) < 4 else fields[:3]
        if leading and all(map(_NUMBER.fullmatch, leading)):
            return True, separator, any(_DECIMAL_COMMA.fullmatch(field) for field in fields)
        if leading and separator != b"," and all(_is_number(field) for field in leading):
            return True, separator, True
    there = [separator for separator in separators if separator is not None and separator in line]
    return False, there[0] if there else separators[-1], False


def _fields(line: bytes, separator: bytes | None) -> list[bytes]:
    """The fields of a row without blanks and quotes around them; an empty one at the end is left out."""
    if separator is None:
        return [field.strip(b"\"'") for field in line.split()] if b'"' not in line else _quoted(line, " ")
    if b'"' in line:
        fields = _quoted(line, separator.decode("latin-1"))
    else:
        fields = [field.strip() for field in line.strip(b"\r\n").split(separator)]
    return fields[:-1] if len(fields) > 1 and not fields[-1] else fields


def _quoted(line: bytes, separator: str) -> list[bytes]:
    text = line.decode("utf-8", "replace").strip()
    (row,) = csv.reader([text], delimiter=separator, skipinitialspace=True)
    return [field.strip().encode() for field in row if field or separator != " "]


def _name(field: bytes) -> str:
    return field.decode("utf-8", "replace").strip().strip("\"'").strip()


def _is_number(field: bytes) -> bool:
    return bool(_NUMBER.fullmatch(field) or _DECIMAL_COMMA.fullmatch(field))
