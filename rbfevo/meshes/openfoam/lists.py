"""Lists of numbers in OpenFOAM's files: ASCII or binary, labels of 32 or 64 bits, scalars of 32 or 64, gzip or not."""

from __future__ import annotations

import gzip
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.mesh import FormatError

BETWEEN = re.compile(rb"(?:\s+|//[^\n]*(?:\n|\Z)|/\*.*?\*/)*", re.DOTALL)  # what may stand between two tokens
_HEADER = re.compile(rb"FoamFile\s*\{(.*?)\}", re.DOTALL)
_ENTRY = re.compile(rb'(\w+)\s+("[^"]*"|[^;"]*);')
_NUMBER = re.compile(rb"\d+")
_GZIP = b"\x1f\x8b"
_SHOWN = 40  # characters of what was not expected


class File(NamedTuple):
    """A file's bytes, and what its header says of them.

    Attributes:
        content: all bytes; start: where the header ends; name: for messages.
        kind: the class of what it holds (`vectorField`, `faceList`, ...); binary: whether lists are binary.
        label, scalar: how a binary file writes whole and real numbers.
    """

    content: bytes
    start: int
    name: str
    kind: str
    binary: bool
    label: np.dtype
    scalar: np.dtype


def exists(path: Path) -> bool:
    """Whether there is a file, plain or compressed."""
    return path.is_file() or path.with_name(f"{path.name}.gz").is_file()


def modified(path: Path) -> float:
    """When a file, plain or compressed, was written last; seconds."""
    return max(one.stat().st_mtime for one in (path, path.with_name(f"{path.name}.gz")) if one.is_file())


def read(path: Path) -> File:
    """A file of a case, plain or with `.gz` behind its name.

    Raises:
        OSError: if there is none, or it cannot be read.
        FormatError: if there are both, or it has no header.
    """
    packed = path.with_name(f"{path.name}.gz")
    if path.is_file() and packed.is_file():
        raise FormatError(f"there are {path} and {packed.name}; remove the one that is out of date")
    found = packed if packed.is_file() else path
    content = found.read_bytes()
    if content.startswith(_GZIP):
        try:
            content = gzip.decompress(content)
        except (EOFError, gzip.BadGzipFile, OSError) as error:
            raise FormatError(f"{found.name} is cut off or damaged ({error})") from None
    header = _HEADER.search(content, 0, 1 << 14)
    if header is None:
        raise FormatError(f"{found.name} has no FoamFile header")
    entries = {key.decode(): value.strip(b'" ').decode("latin-1") for key, value in _ENTRY.findall(header[1])}
    form = entries.get("format", "ascii")
    if form not in ("ascii", "binary"):
        raise FormatError(f"{found.name} has the format {form}; ascii or binary is expected")
    arch = entries.get("arch", "")
    order = ">" if arch.startswith("MSB") else "<"
    bits = {key: int(value) for key, value in re.findall(r"(label|scalar)=(\d+)", arch)}
    label, scalar = bits.get("label", 32), bits.get("scalar", 64)
    if label not in (32, 64) or scalar not in (32, 64):
        raise FormatError(f"{found.name} has labels of {label} and scalars of {scalar} bits; 32 or 64 are expected")
    types = np.dtype(f"{order}i{label // 8}"), np.dtype(f"{order}f{scalar // 8}")
    return File(content, header.end(), found.name, entries.get("class", ""), form == "binary", *types)


def skip(file: File, at: int) -> int:
    """Where the next token begins."""
    found = BETWEEN.match(file.content, at)
    return at if found is None else found.end()


def count_at(file: File, at: int) -> tuple[int, int]:
    """The number of entries that a list announces, and where it goes on.

    Raises:
        FormatError: if there is none.
    """
    at = skip(file, at)
    found = _NUMBER.match(file.content, at)
    if found is None:
        shown = file.content[at : at + _SHOWN].decode("latin-1")
        raise FormatError(f"{file.name}: the length of a list is expected, not {shown!r}")
    return int(found[0]), found.end()


def reals(file: File, at: int, width: int) -> tuple[Array, int]:
    """The list [c, width] of scalars (width 1: [c]) or vectors that begins at a place, float64, and where it ends.

    Raises:
        FormatError: if it is cut off, or has another length than it announces.
    """
    values, end = _list(file, at, width, file.scalar)
    return np.ascontiguousarray(values, np.float64), end


def labels(file: File, at: int) -> tuple[Ints, int]:
    """The list [c] of labels that begins at a place, int64, and where it ends. Raises as `reals`."""
    values, end = _list(file, at, 1, file.label)
    return values.astype(np.int64), end


def polygons(file: File) -> tuple[Ints, Ints]:
    """The faces of a file: their sizes [f], and all corners one face after another.

    Raises:
        FormatError: as `reals`.
    """
    if file.kind == "faceCompactList":
        starts, at = labels(file, file.start)
        corners, _ = labels(file, at)
        sizes = np.diff(starts)
        if not len(starts) or starts[0] != 0 or (sizes < 0).any() or starts[-1] != len(corners):
            raise FormatError(f"{file.name}: the faces and their corners do not match")
        return sizes, corners
    if file.binary:
        raise FormatError(f"{file.name} is binary and of the class {file.kind}; faceCompactList is expected")
    count, at = count_at(file, file.start)
    body, _ = _body(file, at)
    plain = np.array(body.replace(b"(", b" ").replace(b")", b" ").split(), np.int64)
    sizes, place = np.empty(count, np.int64), 0
    for face in range(count):
        if place >= len(plain):
            raise FormatError(f"{file.name} announces {count} faces, but holds {face}")
        sizes[face] = plain[place]
        place += 1 + int(plain[place])
    if place != len(plain):
        raise FormatError(f"{file.name} announces {count} faces, but holds others, or parts of one")
    corners = np.delete(plain, np.cumsum(sizes + 1) - sizes - 1)
    return sizes, corners


def _list(file: File, at: int, width: int, kind: np.dtype) -> tuple[Array, int]:
    count, at = count_at(file, at)
    begin = skip(file, at)
    opening = file.content[begin : begin + 1]
    if opening == b"{":  # all entries are alike
        end = file.content.index(b"}", begin)
        entry = np.array(file.content[begin + 1 : end].translate(None, b"()").split(), np.float64)
        return np.tile(entry, (count, 1)) if width > 1 else np.repeat(entry, count), end + 1
    if file.binary and count:
        begin = file.content.find(b"(", at) + 1
        end = begin + count * width * kind.itemsize
        if not begin or file.content[end : end + 1] != b")":
            raise FormatError(
                f"{file.name} is cut off or damaged: a list of {count} entries does not end where it should"
            )
        values = np.frombuffer(file.content, kind, count * width, begin)
        return values.reshape(count, width) if width > 1 else values, end + 1
    body, end = _body(file, at)
    parts = body.translate(bytes.maketrans(b"()", b"  ")).split()
    if len(parts) != count * width:
        raise FormatError(f"{file.name} announces {count} entries of {width} numbers, but holds {len(parts)} numbers")
    try:
        values = np.array(parts, np.float64 if kind.kind == "f" else np.int64)
    except ValueError as error:
        raise FormatError(f"{file.name}: {error}") from None
    return values.reshape(count, width) if width > 1 else values, end


def _body(file: File, at: int) -> tuple[bytes, int]:
    """What stands between the parentheses of an ASCII list, without comments, and where it ends."""
    begin = skip(file, at)
    if file.content[begin : begin + 1] != b"(":
        raise FormatError(
            f"{file.name}: a list is expected, not {file.content[begin : begin + _SHOWN].decode('latin-1')!r}"
        )
    depth, place = 0, begin
    for found in re.compile(rb"[()]").finditer(file.content, begin):
        depth += 1 if found[0] == b"(" else -1
        if depth == 0:
            place = found.end()
            break
    if depth or place == begin:
        raise FormatError(f"{file.name} is cut off: a list does not end")
    body = file.content[begin + 1 : place - 1]
    return (re.sub(rb"//[^\n]*|/\*.*?\*/", b" ", body, flags=re.DOTALL) if b"/" in body else body), place
