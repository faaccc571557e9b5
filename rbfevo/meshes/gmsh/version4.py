"""The sections of entities, nodes and elements of version 4.1, which come in blocks, one an entity."""

from __future__ import annotations

import numpy as np

from rbfevo.meshes.gmsh.elements import nodes_of
from rbfevo.meshes.gmsh.parsed import Block, Parsed
from rbfevo.meshes.gmsh.section import Section, finish, next_line
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.places import Places, integers


def entities(section: Section, parsed: Parsed, _places: Places) -> None:
    """The physical groups of the entities of a file in text."""
    rows = section.lines()
    counts = integers(next_line(rows, section.name)[1], "a count")
    for dimension, count in enumerate(counts):
        for _ in range(count):
            fields = next_line(rows, section.name)[1].split()
            first = 4 if dimension == 0 else 7
            tags = fields[first + 1 : first + 1 + int(fields[first])]
            parsed.physical[dimension, int(fields[0])] = [int(tag) for tag in tags]


def entities_binary(section: Section, parsed: Parsed, _places: Places) -> int:
    """The physical groups of the entities of a binary file; return where they end."""
    at = section.begin
    counts = section.numbers(at, "u8", 4).tolist()
    at += 32
    for dimension, count in enumerate(counts):
        for _ in range(count):
            tag = int(section.numbers(at, "i4", 1)[0])
            at += 4 + 8 * (3 if dimension == 0 else 6)
            several = int(section.numbers(at, "u8", 1)[0])
            parsed.physical[dimension, tag] = section.numbers(at + 8, "i4", several).tolist()
            at += 8 + 4 * several
            if dimension:
                at += 8 + 4 * int(section.numbers(at, "u8", 1)[0])
    return at


def nodes(section: Section, parsed: Parsed, places: Places) -> None:
    """The nodes of a file in text: of each block the numbers, then the coordinates."""
    rows = section.lines()
    blocks = integers(next_line(rows, section.name)[1], "a count")[0]
    for _ in range(blocks):
        *_, count = integers(next_line(rows, section.name)[1], "a block of nodes")
        numbers = [integers(next_line(rows, section.name)[1], "a node")[0] for _ in range(count)]
        for _ in range(count):
            places.add(*next_line(rows, section.name))
        parsed.numbers.append(np.array(numbers, np.int64))
    finish(rows, section.name)


def nodes_binary(section: Section, parsed: Parsed, _places: Places) -> int:
    """The nodes of a binary file; return where they end."""
    at = section.begin
    blocks = int(section.numbers(at, "u8", 4)[0])
    at += 32
    for _ in range(blocks):
        dimension, _, parametric = section.numbers(at, "i4", 3).tolist()
        count = int(section.numbers(at + 12, "u8", 1)[0])
        at += 20
        parsed.numbers.append(section.numbers(at, "u8", count).astype(np.int64))
        at += 8 * count
        row = [("place", section.order + "f8", 3)] + [("u", section.order + "f8", dimension)] * bool(parametric)
        dtype = np.dtype(row)
        parsed.points.append(section.numbers(at, dtype, count)["place"].astype(np.float64))
        parsed.where.append((at, dtype, count))
        at += count * dtype.itemsize
    return at


def elements(section: Section, parsed: Parsed, _places: Places) -> None:
    """The elements of a file in text: number and nodes a line, in blocks of one type."""
    rows = section.lines()
    for _ in range(integers(next_line(rows, section.name)[1], "a count")[0]):
        dimension, tag, kind, count = integers(next_line(rows, section.name)[1], "a block of elements")
        listed = [integers(next_line(rows, section.name)[1], "an element") for _ in range(count)]
        if any(len(row) != 1 + nodes_of(kind) for row in listed):
            raise FormatError(f"elements of the type {kind} do not have {nodes_of(kind)} nodes each")
        table = np.array(listed, np.int64).reshape(count, 1 + nodes_of(kind))
        parsed.blocks.append(Block(kind, dimension, tag, None, table[:, 0].tolist(), table[:, 1:].tolist()))
    finish(rows, section.name)


def elements_binary(section: Section, parsed: Parsed, _places: Places) -> int:
    """The elements of a binary file; return where they end."""
    at = section.begin
    blocks = int(section.numbers(at, "u8", 4)[0])
    at += 32
    for _ in range(blocks):
        dimension, tag, kind = section.numbers(at, "i4", 3).tolist()
        count, width = int(section.numbers(at + 12, "u8", 1)[0]), 1 + nodes_of(kind)
        at += 20
        table = section.numbers(at, "u8", count * width).astype(np.int64).reshape(count, width)
        parsed.blocks.append(Block(kind, dimension, tag, None, table[:, 0].tolist(), table[:, 1:].tolist()))
        at += 8 * count * width
    return at
