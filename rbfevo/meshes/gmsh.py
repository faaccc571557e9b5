"""Gmsh's MSH format, versions 2 and 4, in text and binary: coordinates are put in place, all other bytes stay."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.mesh import Cells, FormatError, Mesh, written_as
from rbfevo.meshes.numbered import places_of
from rbfevo.meshes.places import Places, integers, lines
from rbfevo.meshes.places import numbers as floats
from rbfevo.meshes.precision import narrowed

# Gmsh's type of an element: VTK's kind, its number of nodes, and VTK's order of them where it is another one.
_TYPES: dict[int, tuple[int, int]] = {
    1: (3, 2),
    2: (5, 3),
    3: (9, 4),
    4: (10, 4),
    5: (12, 8),
    6: (13, 6),
    7: (14, 5),
    8: (21, 3),
    9: (22, 6),
    10: (28, 9),
    11: (24, 10),
    12: (29, 27),
    13: (32, 18),
    14: (14, 14),
    15: (1, 1),
    16: (23, 8),
    17: (25, 20),
    18: (26, 15),
    19: (27, 13),
    20: (5, 9),
    21: (5, 10),
    22: (5, 12),
    23: (5, 15),
    24: (5, 15),
    25: (5, 21),
    26: (3, 4),
    27: (3, 5),
    28: (3, 6),
    29: (10, 20),
    30: (10, 35),
    31: (10, 56),
    36: (9, 16),
    37: (9, 25),
    38: (9, 36),
    92: (12, 64),
    93: (12, 125),
}
_ORDERS = {
    24: [0, 1, 2, 3, 4, 5, 6, 7, 9, 8],
    25: [0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15],
    26: [0, 1, 2, 3, 4, 5, 6, 9, 7, 12, 14, 13, 8, 10, 11],
    27: [0, 1, 2, 3, 4, 5, 8, 10, 6, 7, 9, 11, 12],
    29: [*range(8), 8, 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15, 22, 23, 21, 24, 20, 25, 26],
    32: [0, 1, 2, 3, 4, 5, 6, 9, 7, 12, 14, 13, 8, 10, 11, 15, 17, 16],
}
_CORNERS = {3: 2, 5: 3, 9: 4, 10: 4, 12: 8, 13: 6, 14: 5}
_SECTION = re.compile(rb"^\$(\w+)[ \t]*\r?\n", re.MULTILINE)


@dataclasses.dataclass
class _Block:
    """Elements of one of Gmsh's types: their numbers, their nodes, their entity and, in version 2, physical group."""

    kind: int
    dimension: int
    tag: int
    group: int | None
    numbers: list[int]
    nodes: list[list[int]]


@dataclasses.dataclass
class _Found:
    """What the sections of a file hold, as they are read."""

    numbers: list[Ints] = dataclasses.field(default_factory=list)
    points: list[Array] = dataclasses.field(default_factory=list)
    where: list[tuple[int, np.dtype, int]] = dataclasses.field(default_factory=list)  # binary rows: begin, type, count
    blocks: list[_Block] = dataclasses.field(default_factory=list)
    physical: dict[tuple[int, int], list[int]] = dataclasses.field(default_factory=dict)  # of an entity
    names: dict[tuple[int, int], str] = dataclasses.field(default_factory=dict)
    arrays: dict[str, tuple[Ints, Array]] = dataclasses.field(default_factory=dict)
    cell_arrays: dict[str, tuple[Ints, Array]] = dataclasses.field(default_factory=dict)


def read_gmsh(content: bytes) -> Mesh:
    """A Gmsh mesh: points in the order of the file, cells in the order of its elements.

    Patches are its physical groups, by name, or else its entities. Elements of third and higher order are taken as
    straight ones.

    Raises:
        FormatError: if it is damaged, or of another version.
    """
    head = re.match(rb"\s*\$MeshFormat\s+(\S+)\s+(\d)\s+(\d)[ \t]*\r?\n", content)
    if head is None:
        raise FormatError("it does not begin with $MeshFormat")
    version, binary = head[1].decode("latin-1"), head[2] == b"1"
    if version.split(".")[0] not in ("2", "4") or version.startswith("4.0"):
        raise FormatError(f"it is of version {version}; versions 2 and 4.1 are read: save it as one of these")
    if head[3] != b"8":
        raise FormatError(f"it has numbers of {head[3].decode()} bytes; 8 are expected")
    order = "<"
    if binary:
        order = "<" if content[head.end() : head.end() + 4] == b"\1\0\0\0" else ">"
    new = version.startswith("4")
    places = Places(content, (0, 1, 2) if new else (1, 2, 3))
    found = _Found()
    at = head.end()
    while section := _SECTION.search(content, at):
        name, begin = section[1].decode("latin-1"), section.end()
        if name.startswith("End"):
            at = section.end()
            continue
        read: Callable[..., int | None] | None = {
            "PhysicalNames": _physical_names,
            "Entities": _entities_binary if binary else _entities,
            "Nodes": (_nodes_4b if binary else _nodes_4) if new else (_nodes_2b if binary else _nodes_2),
            "ParametricNodes": None if binary else _nodes_2,
            "Elements": (_elements_4b if binary else _elements_4) if new else (_elements_2b if binary else _elements_2),
            "NodeData": _values,
            "ElementData": _values,
        }.get(name)
        if name == "ParametricNodes" and binary:
            raise FormatError("it has binary $ParametricNodes, which are not read; save it in text")
        if read is None:
            at = begin
            continue
        end = content.find(b"$End" + section[1], begin)
        if end < 0:
            raise FormatError(f"cut off: $End{name} is missing")
        stop = read(_Section(content, begin, end, order, binary, name), found, places)
        end = content.find(b"$End" + section[1], stop) if stop is not None else end
        if end < 0 or (stop is not None and content[stop:end].strip()):
            raise FormatError(f"its section ${name} has more or less in it than it announces")
        at = end
    return _mesh(content, found, places)


@dataclasses.dataclass(frozen=True)
class _Section:
    """Where a section of the file begins and ends, and how its numbers are written."""

    content: bytes
    begin: int
    end: int
    order: str
    binary: bool
    name: str

    def lines(self) -> Iterator[tuple[int, bytes]]:
        return lines(self.content[: self.end], start=self.begin)

    def numbers(self, at: int, dtype: str | np.dtype, count: int) -> Any:
        """Numbers of a binary section; FormatError if the file ends before."""
        dtype = np.dtype(dtype if isinstance(dtype, np.dtype) else self.order + dtype)
        if count < 0 or at + count * dtype.itemsize > len(self.content):
            raise FormatError(f"cut off in ${self.name}")
        return np.frombuffer(self.content, dtype, count, at)


def _next(rows: Iterator[tuple[int, bytes]], name: str) -> tuple[int, bytes]:
    row = next(rows, None)
    if row is None:
        raise FormatError(f"cut off: ${name} announces more than it has")
    return row


def _finish(rows: Iterator[tuple[int, bytes]], name: str) -> None:
    if next(rows, None) is not None:
        raise FormatError(f"its section ${name} has more lines than it announces")


def _physical_names(section: _Section, found: _Found, _places: Places) -> None:
    rows = section.lines()
    for _ in range(integers(_next(rows, section.name)[1], "a count")[0]):
        words = _next(rows, section.name)[1].decode("utf-8", "replace").split(None, 2)
        found.names[int(words[0]), int(words[1])] = words[2].strip().strip('"')


def _entities(section: _Section, found: _Found, _places: Places) -> None:
    rows = section.lines()
    counts = integers(_next(rows, section.name)[1], "a count")
    for dimension, count in enumerate(counts):
        for _ in range(count):
            words = _next(rows, section.name)[1].split()
            first = 4 if dimension == 0 else 7
            tags = words[first + 1 : first + 1 + int(words[first])]
            found.physical[dimension, int(words[0])] = [int(tag) for tag in tags]


def _entities_binary(section: _Section, found: _Found, _places: Places) -> int:
    at = section.begin
    counts = section.numbers(at, "u8", 4).tolist()
    at += 32
    for dimension, count in enumerate(counts):
        for _ in range(count):
            tag = int(section.numbers(at, "i4", 1)[0])
            at += 4 + 8 * (3 if dimension == 0 else 6)
            several = int(section.numbers(at, "u8", 1)[0])
            found.physical[dimension, tag] = section.numbers(at + 8, "i4", several).tolist()
            at += 8 + 4 * several
            if dimension:
                at += 8 + 4 * int(section.numbers(at, "u8", 1)[0])
    return at


def _nodes_2(section: _Section, found: _Found, places: Places) -> None:
    rows = section.lines()
    count = integers(_next(rows, section.name)[1], "a count")[0]
    numbers = []
    for _ in range(count):
        offset, line = _next(rows, section.name)
        places.add(offset, line)
        numbers.append(integers(line.split(None, 1)[0], "a node")[0])
    _finish(rows, section.name)
    found.numbers.append(np.array(numbers, np.int64))


def _nodes_4(section: _Section, found: _Found, places: Places) -> None:
    rows = section.lines()
    blocks = integers(_next(rows, section.name)[1], "a count")[0]
    for _ in range(blocks):
        *_, count = integers(_next(rows, section.name)[1], "a block of nodes")
        numbers = [integers(_next(rows, section.name)[1], "a node")[0] for _ in range(count)]
        for _ in range(count):
            places.add(*_next(rows, section.name))
        found.numbers.append(np.array(numbers, np.int64))
    _finish(rows, section.name)


def _nodes_2b(section: _Section, found: _Found, _places: Places) -> int:
    at = section.content.index(b"\n", section.begin) + 1
    count = int(section.content[section.begin : at])
    dtype = np.dtype([("number", section.order + "i4"), ("place", section.order + "f8", 3)])
    rows = section.numbers(at, dtype, count)
    found.numbers.append(rows["number"].astype(np.int64))
    found.points.append(rows["place"].astype(np.float64))
    found.where.append((at, dtype, count))
    return at + count * dtype.itemsize


def _nodes_4b(section: _Section, found: _Found, _places: Places) -> int:
    at = section.begin
    blocks = int(section.numbers(at, "u8", 4)[0])
    at += 32
    for _ in range(blocks):
        dimension, _, parametric = section.numbers(at, "i4", 3).tolist()
        count = int(section.numbers(at + 12, "u8", 1)[0])
        at += 20
        found.numbers.append(section.numbers(at, "u8", count).astype(np.int64))
        at += 8 * count
        row = [("place", section.order + "f8", 3)] + [("u", section.order + "f8", dimension)] * bool(parametric)
        dtype = np.dtype(row)
        found.points.append(section.numbers(at, dtype, count)["place"].astype(np.float64))
        found.where.append((at, dtype, count))
        at += count * dtype.itemsize
    return at


def _elements_2(section: _Section, found: _Found, _places: Places) -> None:
    rows = section.lines()
    for _ in range(integers(_next(rows, section.name)[1], "a count")[0]):
        number, kind, tags, *rest = integers(_next(rows, section.name)[1], "an element")
        _add(found, number, kind, rest[tags:], rest[0] if tags else 0, rest[1] if tags > 1 else 0)
    _finish(rows, section.name)


def _elements_2b(section: _Section, found: _Found, _places: Places) -> int:
    at = section.content.index(b"\n", section.begin) + 1
    total, done = int(section.content[section.begin : at]), 0
    while done < total:
        kind, count, tags = section.numbers(at, "i4", 3).tolist()
        width = 1 + tags + _nodes_of(kind)
        rows = section.numbers(at + 12, "i4", count * width).reshape(count, width).astype(np.int64)
        for row in rows.tolist():
            _add(found, row[0], kind, row[1 + tags :], row[1] if tags else 0, row[2] if tags > 1 else 0)
        at, done = at + 12 + 4 * count * width, done + count
        if count == 0:
            raise FormatError("its $Elements are damaged")
    return at


def _elements_4(section: _Section, found: _Found, _places: Places) -> None:
    rows = section.lines()
    for _ in range(integers(_next(rows, section.name)[1], "a count")[0]):
        dimension, tag, kind, count = integers(_next(rows, section.name)[1], "a block of elements")
        listed = [integers(_next(rows, section.name)[1], "an element") for _ in range(count)]
        if any(len(row) != 1 + _nodes_of(kind) for row in listed):
            raise FormatError(f"elements of the type {kind} do not have {_nodes_of(kind)} nodes each")
        table = np.array(listed, np.int64).reshape(count, 1 + _nodes_of(kind))
        found.blocks.append(_Block(kind, dimension, tag, None, table[:, 0].tolist(), table[:, 1:].tolist()))
    _finish(rows, section.name)


def _elements_4b(section: _Section, found: _Found, _places: Places) -> int:
    at = section.begin
    blocks = int(section.numbers(at, "u8", 4)[0])
    at += 32
    for _ in range(blocks):
        dimension, tag, kind = section.numbers(at, "i4", 3).tolist()
        count, width = int(section.numbers(at + 12, "u8", 1)[0]), 1 + _nodes_of(kind)
        at += 20
        table = section.numbers(at, "u8", count * width).astype(np.int64).reshape(count, width)
        found.blocks.append(_Block(kind, dimension, tag, None, table[:, 0].tolist(), table[:, 1:].tolist()))
        at += 8 * count * width
    return at


def _nodes_of(kind: int) -> int:
    if kind not in _TYPES:
        raise FormatError(f"it has elements of Gmsh's type {kind}, which is not known here")
    return _TYPES[kind][1]


def _add(found: _Found, number: int, kind: int, nodes: list[int], group: int, tag: int) -> None:
    """One element of version 2, which names its physical group and its entity itself."""
    if len(nodes) != _nodes_of(kind):
        raise FormatError(f"an element of the type {kind} has {len(nodes)} nodes instead of {_nodes_of(kind)}")
    last = found.blocks[-1] if found.blocks else None
    if last is None or (last.kind, last.tag, last.group) != (kind, tag, group):
        found.blocks.append(_Block(kind, _dimension(_TYPES[kind][0]), tag, group, [], []))
    found.blocks[-1].numbers.append(number)
    found.blocks[-1].nodes.append(nodes)


def _dimension(kind: int) -> int:
    if kind in (1,):
        return 0
    if kind in (3, 21):
        return 1
    return 2 if kind in (5, 9, 22, 23, 28) else 3


def _values(section: _Section, found: _Found, _places: Places) -> int | None:
    """An array of nodes or elements; of several with one name (steps in time) the last."""
    at, tags = section.begin, []
    for _ in range(3):
        count_end = section.content.index(b"\n", at) + 1
        own = []
        for _ in range(int(section.content[at:count_end])):
            end = section.content.index(b"\n", count_end) + 1
            own.append(section.content[count_end:end].strip())
            count_end = end
        tags.append(own)
        at = count_end
    name = tags[0][0].decode("utf-8", "replace").strip('"') if tags[0] else "values"
    width, count = int(tags[2][1]), int(tags[2][2])
    stop = None
    if section.binary:
        dtype = np.dtype([("number", section.order + "i4"), ("value", section.order + "f8", width)])
        rows = section.numbers(at, dtype, count)
        numbers, values = rows["number"].astype(np.int64), rows["value"].astype(np.float64).reshape(count, width)
        stop = at + count * dtype.itemsize
    else:
        words = section.content[at : section.end].split()
        if len(words) != count * (1 + width):
            raise FormatError(f"its section ${section.name} has more or less in it than it announces")
        table = floats(words, "row", 1 + width).reshape(count, 1 + width)
        numbers, values = table[:, 0].astype(np.int64), table[:, 1:]
    arrays = found.arrays if section.name == "NodeData" else found.cell_arrays
    arrays[name] = (numbers, values)
    return stop


def _mesh(content: bytes, found: _Found, places: Places) -> Mesh:
    if not found.numbers:
        raise FormatError("there are no points in it: empty or damaged")
    points = np.concatenate(found.points) if found.points else places.points()
    numbers = np.concatenate(found.numbers)
    if len(numbers) != len(points):
        raise FormatError(f"it has {len(numbers)} numbers of nodes for {len(points)} nodes")
    twice = len(numbers) - len(np.unique(numbers))
    if twice:
        raise FormatError(f"{twice} numbers of nodes are there twice")
    cells, patches, entities, count, curved = [], {}, {}, 0, 0
    for block in found.blocks:
        vtk = _TYPES[block.kind][0]
        nodes = np.array(block.nodes, np.int64).reshape(len(block.nodes), _nodes_of(block.kind))
        corners, there = places_of(nodes, numbers)
        if not there.all():
            raise FormatError(f"its elements refer to {int((~there).sum())} nodes that are not there")
        if vtk in _CORNERS and corners.shape[1] > _CORNERS[vtk]:
            curved += len(corners)
            corners = corners[:, : _CORNERS[vtk]]
        cells.append((vtk, corners[:, _ORDERS[vtk]] if vtk in _ORDERS else corners))
        own = np.arange(count, count + len(corners))
        count += len(corners)
        groups = found.physical.get((block.dimension, block.tag), []) if block.group is None else [block.group]
        for group in groups:
            if group:
                name = found.names.get((block.dimension, abs(group)), f"physical {abs(group)}")
                patches.setdefault(name, []).append(own)
        name = f"{('point', 'curve', 'surface', 'volume')[block.dimension]} {block.tag}"
        entities.setdefault(name, []).append(own)
    chosen = patches or (entities if len(entities) > 1 else {})
    notes = {"curved elements": f"{curved} elements of third or higher order are taken as straight"} if curved else {}
    elements = np.array([number for block in found.blocks for number in block.numbers], np.int64)
    return Mesh(
        points,
        written_as(_rewriter(content, found, places)),
        Cells.blocks(cells),
        {name: _array(*values, numbers) for name, values in found.arrays.items()},
        {name: _array(*values, elements) for name, values in found.cell_arrays.items()},
        {name: np.concatenate(own) for name, own in chosen.items()},
        numbers=numbers,
        notes=notes,
    )


def _rewriter(content: bytes, found: _Found, places: Places) -> Callable[[Array], bytes]:
    def rewritten(moved: Array) -> bytes:
        if not found.where:
            return places.rewritten(moved)
        changed, start = bytearray(content), 0
        for begin, dtype, count in found.where:
            rows = np.frombuffer(changed, dtype, count, begin)
            rows["place"] = narrowed(moved[start : start + count], np.dtype("f8"))
            start += count
        return bytes(changed)

    return rewritten


def _array(numbers: Ints, values: Array, own: Ints) -> Array:
    """Values in the order of a mesh's own numbers; NaN where there is none."""
    table = np.full((len(own), values.shape[1]), np.nan)
    place, there = places_of(numbers, own)
    table[place[there]] = values[there]
    return table[:, 0] if table.shape[1] == 1 else table
