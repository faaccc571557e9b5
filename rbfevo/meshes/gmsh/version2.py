"""The sections of nodes and elements of version 2, whose elements name their physical group and entity themselves."""

from __future__ import annotations

import numpy as np

from rbfevo.meshes.gmsh.elements import TYPES, dimension_of, nodes_of
from rbfevo.meshes.gmsh.parsed import Block, Parsed
from rbfevo.meshes.gmsh.section import Section, finish, next_line
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.places import Places, integers


def nodes(section: Section, parsed: Parsed, places: Places) -> None:
    """The nodes of a file in text: a number and three coordinates a line, and what follows them of parametric ones."""
    rows = section.lines()
    count = integers(next_line(rows, section.name)[1], "a count")[0]
    numbers = []
    for _ in range(count):
        offset, line = next_line(rows, section.name)
        places.add(offset, line)
        numbers.append(integers(line.split(None, 1)[0], "a node")[0])
    finish(rows, section.name)
    parsed.numbers.append(np.array(numbers, np.int64))


def nodes_binary(section: Section, parsed: Parsed, _places: Places) -> int:
    """The nodes of a binary file; return where they end."""
    at = section.content.index(b"\n", section.begin) + 1
    count = int(section.content[section.begin : at])
    dtype = np.dtype([("number", section.order + "i4"), ("place", section.order + "f8", 3)])
    rows = section.numbers(at, dtype, count)
    parsed.numbers.append(rows["number"].astype(np.int64))
    parsed.points.append(rows["place"].astype(np.float64))
    parsed.where.append((at, dtype, count))
    return at + count * dtype.itemsize


def elements(section: Section, parsed: Parsed, _places: Places) -> None:
    """The elements of a file in text: number, type, tags and nodes a line."""
    rows = section.lines()
    for _ in range(integers(next_line(rows, section.name)[1], "a count")[0]):
        number, kind, tags, *remaining = integers(next_line(rows, section.name)[1], "an element")
        _add(parsed, number, kind, remaining[tags:], remaining[0] if tags else 0, remaining[1] if tags > 1 else 0)
    finish(rows, section.name)


def elements_binary(section: Section, parsed: Parsed, _places: Places) -> int:
    """The elements of a binary file, in blocks of one type; return where they end."""
    at = section.content.index(b"\n", section.begin) + 1
    total, done = int(section.content[section.begin : at]), 0
    while done < total:
        kind, count, tags = section.numbers(at, "i4", 3).tolist()
        width = 1 + tags + nodes_of(kind)
        rows = section.numbers(at + 12, "i4", count * width).reshape(count, width).astype(np.int64)
        for row in rows.tolist():
            _add(parsed, row[0], kind, row[1 + tags :], row[1] if tags else 0, row[2] if tags > 1 else 0)
        at, done = at + 12 + 4 * count * width, done + count
        if count == 0:
            raise FormatError("its $Elements are damaged")
    return at


def _add(parsed: Parsed, number: int, kind: int, nodes: list[int], group: int, tag: int) -> None:
    """One element of version 2, which names its physical group and its entity itself."""
    if len(nodes) != nodes_of(kind):
        raise FormatError(f"an element of the type {kind} has {len(nodes)} nodes instead of {nodes_of(kind)}")
    last = parsed.blocks[-1] if parsed.blocks else None
    if last is None or (last.kind, last.tag, last.group) != (kind, tag, group):
        parsed.blocks.append(Block(kind, dimension_of(TYPES[kind][0]), tag, group, [], []))
    parsed.blocks[-1].numbers.append(number)
    parsed.blocks[-1].nodes.append(nodes)
