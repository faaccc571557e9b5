"""PLY in text and in binary of either byte order: x, y and z of the vertices are put in place, all else stays."""

from __future__ import annotations

import dataclasses
import re
from typing import NamedTuple

import numpy as np

from rbfevo.exchange.lines import WORD, Places
from rbfevo.exchange.mesh import FormatError, Mesh, fans, narrowed, sound, written_as
from rbfevo.record import Array

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class Property(NamedTuple):
    """A property of an element: its name, its type and, for a list, the type of the number of its entries."""

    name: str
    type: str
    counted: str | None


@dataclasses.dataclass(frozen=True)
class Element:
    """An element of the header: what it is called, how many there are, what each has."""

    name: str
    count: int
    properties: list[Property]


def read_ply(content: bytes) -> Mesh:
    """PLY: a mesh where it has faces, else a cloud.

    Raises:
        FormatError: if it is damaged.
    """
    order, elements, start = _header(content)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is None or not {"x", "y", "z"} <= {entry.name for entry in vertex.properties}:
        raise FormatError("it has no element vertex with x, y and z")
    if any(entry.counted for entry in vertex.properties):
        raise FormatError("its vertices have lists, which are not read")
    if vertex.count == 0:
        raise FormatError("there are no points in it: empty or damaged")
    names = {entry.name for entry in vertex.properties}
    notes = []
    if names & {"nx", "ny", "nz"}:
        notes.append("its vertex normals (nx, ny, nz) are kept as they were and do not fit the deformed shape")
    read = _text if order == "" else _binary
    return read(content, start, order, elements, notes)


def _header(content: bytes) -> tuple[str, list[Element], int]:
    end = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", content, re.MULTILINE)
    if not content.startswith(b"ply") or end is None:
        raise FormatError("it has no PLY header")
    order, elements = None, []
    for line in content[: end.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, *_]:
                order = ORDERS.get(name)
            case ["element", name, count] if count.isdecimal() and len(count) < 16:
                elements.append(Element(name, int(count), []))
            case ["property", "list", counted, kind, name] if elements and counted in TYPES and kind in TYPES:
                elements[-1].properties.append(Property(name, TYPES[kind], TYPES[counted]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append(Property(name, TYPES[kind], None))
            case ["ply"] | ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise FormatError(f"its header has a line that is not understood: {line[:60]!r}")
    if order is None:
        raise FormatError("its header does not say which format it has")
    return order, elements, end.end()


def _text(content: bytes, start: int, order: str, elements: list[Element], notes: list[str]) -> Mesh:
    places, polygons, offset = Places(content), [], start
    lines = iter(content[start:].splitlines(keepends=True))
    for element in elements:
        names = [entry.name for entry in element.properties]
        for _ in range(element.count):
            line = next(lines, None)
            while line is not None and not line.strip():
                offset += len(line)
                line = next(lines, None)
            if line is None:
                raise FormatError("cut off: elements are missing")
            if element.name == "vertex":
                words = list(WORD.finditer(line))
                if len(words) != len(names):
                    raise FormatError(f"vertex {len(places.points)} (from 0) does not have {len(names)} numbers")
                places.add([words[names.index(axis)] for axis in "xyz"], offset)
            elif element.name == "face":
                polygons.append(_text_corners(line, element.properties))
            offset += len(line)
    return places.mesh(fans(polygons), notes)


def _text_corners(line: bytes, properties: list[Property]) -> list[int]:
    words = line.split()
    try:
        for entry in properties:
            if entry.counted is None:
                words = words[1:]
                continue
            count = int(words[0])
            if entry.name in ("vertex_indices", "vertex_index"):
                corners = [int(word) for word in words[1 : 1 + count]]
                if len(corners) != count:
                    raise FormatError("a face has fewer corners than it announces")
                return corners
            words = words[1 + count :]
    except (ValueError, IndexError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError("a face has a corner that is no number") from None
    return []


def _binary(content: bytes, start: int, order: str, elements: list[Element], notes: list[str]) -> Mesh:
    offset, where, polygons = start, None, np.empty((0, 3), np.int64)
    for element in elements:
        if element.name == "vertex":
            where = offset, _row(element, order), element.count
        if not any(entry.counted for entry in element.properties):
            offset += element.count * _row(element, order).itemsize
        else:
            offset, found = _lists(content, offset, element, order)
            polygons = found if element.name == "face" else polygons
        if offset > len(content):
            raise FormatError("cut off: elements are missing")
    if where is None:
        raise FormatError("it announces no vertices")
    begin, row, count = where
    vertices = np.frombuffer(content, row, count, begin)
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)

    def rewritten(moved: Array) -> bytes:
        changed = bytearray(content)
        rows = np.frombuffer(changed, row, count, begin)
        for column, axis in enumerate("xyz"):
            rows[axis] = narrowed(moved[:, column], row[axis])
        return bytes(changed)

    if any(row[axis].kind != "f" for axis in "xyz"):
        raise FormatError("its coordinates are whole numbers; save them as float or double")
    return Mesh(points, sound(polygons, count), None, 3, notes, written_as(rewritten))


def _row(element: Element, order: str) -> np.dtype:
    names = [entry.name for entry in element.properties]
    if len(set(names)) != len(names):
        raise FormatError(f"its element {element.name} has two properties of one name")
    return np.dtype([(entry.name, order + entry.type) for entry in element.properties])


def _lists(content: bytes, offset: int, element: Element, order: str) -> tuple[int, Array]:
    """Where an element with lists ends, and the triangles of its lists vertex_indices."""
    fast = _triangles_only(content, offset, element, order)
    if fast is not None:
        return fast
    polygons = []
    for _ in range(element.count):
        for entry in element.properties:
            count = 1
            if entry.counted is not None:
                (found,), offset = _numbers(content, offset, order + entry.counted, 1)
                count = int(found)
            numbers, offset = _numbers(content, offset, order + entry.type, count)
            if entry.counted is not None and entry.name in ("vertex_indices", "vertex_index"):
                polygons.append([int(number) for number in numbers])
    return offset, fans(polygons)


def _triangles_only(content: bytes, offset: int, element: Element, order: str) -> tuple[int, Array] | None:
    """The same for the usual file, in which the only list is that of three corners: read as a table."""
    lists = [entry for entry in element.properties if entry.counted]
    if len(lists) != 1 or lists[0].name not in ("vertex_indices", "vertex_index") or element.count == 0:
        return None
    row: list[tuple] = []
    for place, entry in enumerate(element.properties):
        if entry.counted:
            row += [("count", order + entry.counted), ("corners", order + entry.type, (3,))]
        else:
            row.append((f"other {place}", order + entry.type))
    dtype = np.dtype(row)
    if offset + element.count * dtype.itemsize > len(content):
        return None
    faces = np.frombuffer(content, dtype, element.count, offset)
    if not (faces["count"] == 3).all():
        return None
    return offset + element.count * dtype.itemsize, faces["corners"].astype(np.int64)


def _numbers(content: bytes, offset: int, kind: str, count: int) -> tuple[Array, int]:
    end = offset + count * np.dtype(kind).itemsize
    if count < 0 or end > len(content):
        raise FormatError("cut off: elements are missing")
    return np.frombuffer(content, kind, count, offset), end
