"""The mesh that the sections of a file make together."""

from __future__ import annotations

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.gmsh.elements import CORNERS, ORDERS, TYPES, nodes_of
from rbfevo.meshes.gmsh.parsed import Parsed
from rbfevo.meshes.gmsh.rewriting import rewriter
from rbfevo.meshes.mesh import Cells, FormatError, Mesh, written_as
from rbfevo.meshes.numbered import places_of
from rbfevo.meshes.places import Places


def mesh_of(content: bytes, parsed: Parsed, places: Places) -> Mesh:
    """The mesh of a file: points and cells in its order, patches by physical group or else by entity."""
    if not parsed.numbers:
        raise FormatError("it holds no points; is it empty or damaged?")
    points = np.concatenate(parsed.points) if parsed.points else places.points()
    numbers = np.concatenate(parsed.numbers)
    if len(numbers) != len(points):
        raise FormatError(f"it has {len(numbers)} numbers of nodes for {len(points)} nodes")
    twice = len(numbers) - len(np.unique(numbers))
    if twice:
        raise FormatError(f"{twice} numbers of nodes are there twice")
    cells, patches, entities, count, curved = [], {}, {}, 0, 0
    for block in parsed.blocks:
        vtk = TYPES[block.kind][0]
        nodes = np.array(block.nodes, np.int64).reshape(len(block.nodes), nodes_of(block.kind))
        corners, there = places_of(nodes, numbers)
        if not there.all():
            raise FormatError(f"its elements refer to {int((~there).sum())} nodes that are not there")
        if vtk in CORNERS and corners.shape[1] > CORNERS[vtk]:
            curved += len(corners)
            corners = corners[:, : CORNERS[vtk]]
        cells.append((vtk, corners[:, ORDERS[vtk]] if vtk in ORDERS else corners))
        own = np.arange(count, count + len(corners))
        count += len(corners)
        groups = parsed.physical.get((block.dimension, block.tag), []) if block.group is None else [block.group]
        for group in groups:
            if group:
                name = parsed.names.get((block.dimension, abs(group)), f"physical {abs(group)}")
                patches.setdefault(name, []).append(own)
        name = f"{('point', 'curve', 'surface', 'volume')[block.dimension]} {block.tag}"
        entities.setdefault(name, []).append(own)
    chosen = patches or (entities if len(entities) > 1 else {})
    notes = {"curved elements": f"{curved} elements of third or higher order are taken as straight"} if curved else {}
    elements = np.array([number for block in parsed.blocks for number in block.numbers], np.int64)
    return Mesh(
        points,
        written_as(rewriter(content, parsed, places)),
        Cells.blocks(cells),
        {name: _array(*values, numbers) for name, values in parsed.arrays.items()},
        {name: _array(*values, elements) for name, values in parsed.cell_arrays.items()},
        {name: np.concatenate(own) for name, own in chosen.items()},
        numbers=numbers,
        notes=notes,
    )


def _array(numbers: Ints, values: Array, own: Ints) -> Array:
    """Values in the order of a mesh's own numbers; NaN where there is none."""
    table = np.full((len(own), values.shape[1]), np.nan)
    place, there = places_of(numbers, own)
    table[place[there]] = values[there]
    return table[:, 0] if table.shape[1] == 1 else table
