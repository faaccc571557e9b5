"""XYZ and CSV: clouds in text, one point a line; coordinates are put in place, all other bytes stay as they are."""

from __future__ import annotations

import math

from rbfevo.arrays import Array
from rbfevo.meshes.columns import recognized
from rbfevo.meshes.mesh import FormatError, Mesh, written_as
from rbfevo.meshes.places import Places
from rbfevo.meshes.text_table import read_table


def read_cloud(content: bytes) -> Mesh:
    """A cloud: the columns of a header that are x, y and z, or the first three; all other columns stay.

    Raises:
        FormatError: if a point has no three coordinates, or the file is a PLOT3D lattice.
    """
    lattice = plot3d(content)
    if lattice:
        raise FormatError(
            f"it is a PLOT3D lattice ({lattice}), as boxes for free-form deformation are stored: no cloud, and no mesh"
        )
    table = read_table(content)
    columns = (0, 1, 2)
    if table.header is not None:
        found = recognized(table.header)
        if set(found.coordinates) == {0, 1, 2}:
            columns = tuple(found.coordinates[axis] for axis in range(3))
        elif found.coordinates or table.width < 3:
            raise FormatError(f"its header, {', '.join(table.header)[:80]}, does not name x, y and z")
    if table.width < 3:
        raise FormatError(f"its rows have {table.width} numbers; a point needs three coordinates")
    table.numbers(columns)  # a coordinate that is no number is refused with its row
    places = Places(content, columns, table.separator, table.comma)
    for offset, line in table.rows:
        places.add(offset, line)

    def rewritten(moved: Array) -> bytes:
        """The bytes of the file with moved points [n, 3]; FormatError for UTF-16."""
        if not table.in_place:
            raise FormatError("it is in UTF-16; save it in UTF-8 or ASCII first")
        return places.rewritten(moved)

    notes = {"rows": "; ".join(table.notes)} if table.notes else {}
    return Mesh(table.numbers(columns), written_as(rewritten), notes=notes)


def plot3d(content: bytes) -> str:
    """A description of the blocks of a PLOT3D file in text; empty if the file is none."""
    tokens = content.split()
    for single in (True, False):
        head = tokens[:3] if single else tokens[: 1 + 3 * (int(tokens[0]) if tokens and tokens[0].isdigit() else 0)]
        if len(head) < 3 or not all(token.isdigit() for token in head):
            continue
        sizes = [int(token) for token in (head if single else head[1:])]
        blocks = [sizes[i : i + 3] for i in range(0, len(sizes), 3)]
        points = sum(math.prod(block) for block in blocks)
        if blocks and points > 1 and len(tokens) - len(head) == 3 * points:
            return ", ".join(" x ".join(map(str, block)) + " points" for block in blocks)
    return ""
