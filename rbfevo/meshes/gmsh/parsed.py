"""What the sections of a file hold, before it becomes a mesh."""

from __future__ import annotations

import dataclasses

import numpy as np

from rbfevo.arrays import Array, Ints


@dataclasses.dataclass
class Block:
    """Elements of one of Gmsh's types: their numbers, their nodes, their entity and, in version 2, physical group."""

    kind: int
    dimension: int
    tag: int
    group: int | None
    numbers: list[int]
    nodes: list[list[int]]


@dataclasses.dataclass
class Parsed:
    """What the sections of a file hold, as they are read.

    Attributes:
        numbers: of nodes, for each block of them; points: their coordinates [n, 3], of a binary file.
        where: the rows of nodes in a binary file: where they begin, their type and their count.
        blocks: the elements; physical: the groups of an entity, by its dimension and tag.
        names: of physical groups, by dimension and number.
        arrays: of nodes by name, their numbers and values; cell_arrays: the same of elements.
    """

    numbers: list[Ints] = dataclasses.field(default_factory=list)
    points: list[Array] = dataclasses.field(default_factory=list)
    where: list[tuple[int, np.dtype, int]] = dataclasses.field(default_factory=list)
    blocks: list[Block] = dataclasses.field(default_factory=list)
    physical: dict[tuple[int, int], list[int]] = dataclasses.field(default_factory=dict)
    names: dict[tuple[int, int], str] = dataclasses.field(default_factory=dict)
    arrays: dict[str, tuple[Ints, Array]] = dataclasses.field(default_factory=dict)
    cell_arrays: dict[str, tuple[Ints, Array]] = dataclasses.field(default_factory=dict)
