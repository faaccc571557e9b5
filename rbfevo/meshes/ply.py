"""PLY in text and in binary of either byte order: x, y and z of the vertices are put in place, all else stays."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.meshes.mesh import Cells, FormatError, Mesh, stale_normals, written_as
from rbfevo.meshes.places import Places, numbers
from rbfevo.meshes.precision import narrowed

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


_CORNERS = ("vertex_indices", "vertex_index")


@dataclasses.dataclass
class _Found:
    """What the elements of a file hold: cells by kind and corners, and arrays of vertices and of cells."""

    kinds: list[int] = dataclasses.field(default_factory=list)
    corners: list[list[int]] = dataclasses.field(default_factory=list)
    triangles: Array | None = None
    arrays: dict[str, Array] = dataclasses.field(default_factory=dict)
    cell_arrays: dict[str, Array] = dataclasses.field(default_factory=dict)

    def cells(self) -> Cells:
        """The cells that were found, in the order of the file."""
        if self.triangles is None:
            return Cells.of(self.kinds, self.corners)
        return Cells.blocks([(5, self.triangles), *((6, np.array([strip])) for strip in self.corners)])

    def add(self, element: str, corners: list[int]) -> None:
        """A polygon of the element `face`, or strips of `tristrips`, which -1 ends."""
        if element == "face":
            self.kinds.append(7)
            self.corners.append(corners)
            return
        strip: list[int] = []
        for corner in [*corners, -1]:
            if corner >= 0:
                strip.append(corner)
            elif strip:
                self.kinds.append(6)
                self.corners.append(strip)
                strip = []


def read_ply(content: bytes) -> Mesh:
    """PLY: a mesh where it has faces or triangle strips, else a cloud.

    Arrays are the properties of its vertices beside x, y and z, cell arrays those of its faces that are no lists.

    Raises:
        FormatError: if it is damaged.
    """
    order, elements, start = _header(content)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    names = [entry.name for entry in vertex.properties] if vertex else []
    if vertex is None or not {"x", "y", "z"} <= set(names):
        raise FormatError("it has no element vertex with x, y and z")
    if any(entry.counted for entry in vertex.properties):
        raise FormatError("its vertices have lists, which are not read")
    if len(set(names)) != len(names):
        raise FormatError("its element vertex has two properties of one name")
    if vertex.count == 0:
        raise FormatError("it holds no points; is it empty or damaged?")
    for element in elements:
        if element.name in ("face", "tristrips") and element.count:
            lists = [entry for entry in element.properties if entry.counted and entry.name in _CORNERS]
            if len(lists) != 1:
                raise FormatError(f"its {element.count} elements {element.name} have no list vertex_indices")
    found = _Found()
    points, rewritten = (_text if order == "" else _binary)(content, start, order, elements, found)
    if found.kinds and not all(kind == 7 for kind in found.kinds):
        found.cell_arrays.clear()  # strips and faces together: the arrays are of the faces only
    kept = stale_normals(bool({"nx", "ny", "nz"} & set(names)))
    return Mesh(points, written_as(rewritten), found.cells(), found.arrays, found.cell_arrays, kept=kept)


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


def _text(
    content: bytes, start: int, order: str, elements: list[Element], found: _Found
) -> tuple[Array, Callable[[Array], bytes]]:
    names = [entry.name for element in elements if element.name == "vertex" for entry in element.properties]
    places, offset = Places(content, [names.index(axis) for axis in "xyz"]), start
    lines = iter(content[start:].splitlines(keepends=True))
    for element in elements:
        rows = []
        for _ in range(element.count):
            line = next(lines, None)
            while line is not None and not line.strip():
                offset += len(line)
                line = next(lines, None)
            if line is None:
                raise FormatError(f"cut off: elements are missing of the {element.count} of {element.name}")
            if element.name == "vertex":
                places.add(offset, line)
                rows.append(line.split())
                if len(rows[-1]) != len(names):
                    raise FormatError(f"vertex {len(rows) - 1} (from 0) does not have {len(names)} numbers")
            elif element.name in ("face", "tristrips"):
                rows.append(_text_cell(line, element, found))
            offset += len(line)
        own = [entry.name for entry in element.properties if entry.counted is None]
        if element.name in ("vertex", "face") and rows and own:
            table = numbers([field for row in rows for field in row], element.name, len(own)).reshape(len(rows), -1)
            arrays = found.arrays if element.name == "vertex" else found.cell_arrays
            arrays |= {name: table[:, column] for column, name in enumerate(own) if not _is_axis(element, name)}
    if any(line.strip() for line in lines):
        raise FormatError("it has more lines than its header announces")
    return places.points(), places.rewritten


def _is_axis(element: Element, name: str) -> bool:
    return element.name == "vertex" and name in ("x", "y", "z")


def _text_cell(line: bytes, element: Element, found: _Found) -> list[bytes]:
    """Note the corners of a face or strip, and return its numbers that are no lists."""
    fields, place, single = line.split(), 0, []
    try:
        for entry in element.properties:
            if entry.counted is None:
                single.append(fields[place])
                place += 1
                continue
            count = int(fields[place])
            entries = fields[place + 1 : place + 1 + count]
            place += 1 + count
            if len(entries) != count or count < 0:
                raise FormatError("a face has fewer corners than it announces")
            if entry.name in _CORNERS:
                found.add(element.name, [int(corner) for corner in entries])
    except (ValueError, IndexError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError("a face has a corner that is no number") from None
    if place != len(fields):
        raise FormatError("a face has more numbers on its line than the header announces")
    return single


def _binary(
    content: bytes, start: int, order: str, elements: list[Element], found: _Found
) -> tuple[Array, Callable[[Array], bytes]]:
    offset, where = start, None
    for element in elements:
        if element.name == "vertex":
            where = offset, _row(element, order), element.count
        if not any(entry.counted for entry in element.properties):
            offset += element.count * _row(element, order).itemsize
        else:
            offset = _lists(content, offset, element, order, found)
        if offset > len(content):
            raise FormatError(f"cut off: elements are missing of the {element.count} of {element.name}")
    if where is None:
        raise FormatError("it announces no vertices")
    begin, row, count = where
    if any(row[axis].kind != "f" for axis in "xyz"):
        raise FormatError("its coordinates are whole numbers; save them as float or double")
    vertices = np.frombuffer(content, row, count, begin)
    points = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    found.arrays |= {name: vertices[name].astype(np.float64) for name in row.names or () if name not in ("x", "y", "z")}

    def rewritten(moved: Array) -> bytes:
        """The bytes of the file with moved points [n, 3]."""
        changed = bytearray(content)
        rows = np.frombuffer(changed, row, count, begin)
        for column, axis in enumerate("xyz"):
            rows[axis] = narrowed(moved[:, column], row[axis])
        return bytes(changed)

    return points, rewritten


def _row(element: Element, order: str) -> np.dtype:
    names = [entry.name for entry in element.properties]
    if len(set(names)) != len(names):
        raise FormatError(f"its element {element.name} has two properties of one name")
    return np.dtype([(entry.name, order + entry.type) for entry in element.properties])


def _lists(content: bytes, offset: int, element: Element, order: str, found: _Found) -> int:
    """Where an element with lists ends, after its cells are noted."""
    if element.name == "face":
        end = _triangles_only(content, offset, element, order, found)
        if end is not None:
            return end
    singles: dict[str, list[float]] = {entry.name: [] for entry in element.properties if entry.counted is None}
    for _ in range(element.count):
        for entry in element.properties:
            count = 1
            if entry.counted is not None:
                (counted,), offset = _numbers(content, offset, order + entry.counted, 1)
                count = int(counted)
            values, offset = _numbers(content, offset, order + entry.type, count)
            if entry.counted is None:
                singles[entry.name].append(float(values[0]))
            elif entry.name in _CORNERS and element.name in ("face", "tristrips"):
                found.add(element.name, values.astype(np.int64).tolist())
    if element.name == "face":
        found.cell_arrays |= {name: np.array(values) for name, values in singles.items()}
    return offset


def _triangles_only(content: bytes, offset: int, element: Element, order: str, found: _Found) -> int | None:
    """The same for the usual file, in which the only list is that of three corners: read as a table."""
    lists = [entry for entry in element.properties if entry.counted]
    if len(lists) != 1 or lists[0].name not in _CORNERS or element.count == 0:
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
    if not (faces["count"] == 3).all() or found.kinds:
        return None
    found.triangles = faces["corners"].astype(np.int64)
    for place, entry in enumerate(element.properties):
        if not entry.counted:
            found.cell_arrays[entry.name] = faces[f"other {place}"].astype(np.float64)
    return offset + element.count * dtype.itemsize


def _numbers(content: bytes, offset: int, kind: str, count: int) -> tuple[Array, int]:
    end = offset + count * np.dtype(kind).itemsize
    if count < 0 or end > len(content):
        raise FormatError("cut off: elements are missing")
    return np.frombuffer(content, kind, count, offset), end
