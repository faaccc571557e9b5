"""Sections that are alike in versions 2 and 4: names of physical groups, and arrays of nodes and elements."""

from __future__ import annotations

import numpy as np

from rbfevo.meshes.gmsh.parsed import Parsed
from rbfevo.meshes.gmsh.section import Section, next_line
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.places import Places, integers
from rbfevo.meshes.places import numbers as floats


def physical_names(section: Section, parsed: Parsed, _places: Places) -> None:
    """The names of physical groups."""
    rows = section.lines()
    for _ in range(integers(next_line(rows, section.name)[1], "a count")[0]):
        fields = next_line(rows, section.name)[1].decode("utf-8", "replace").split(None, 2)
        parsed.names[int(fields[0]), int(fields[1])] = fields[2].strip().strip('"')


def values(section: Section, parsed: Parsed, _places: Places) -> int | None:
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
        numbers, array = rows["number"].astype(np.int64), rows["value"].astype(np.float64).reshape(count, width)
        stop = at + count * dtype.itemsize
    else:
        fields = section.content[at : section.end].split()
        if len(fields) != count * (1 + width):
            raise FormatError(f"its section ${section.name} has more or less in it than it announces")
        table = floats(fields, "row", 1 + width).reshape(count, 1 + width)
        numbers, array = table[:, 0].astype(np.int64), table[:, 1:]
    arrays = parsed.arrays if section.name == "NodeData" else parsed.cell_arrays
    arrays[name] = (numbers, array)
    return stop
