"""Gmsh's types of elements: what VTK calls them, how many nodes they have, and in which order VTK wants these."""

from __future__ import annotations

from rbfevo.meshes.mesh import FormatError

TYPES: dict[int, tuple[int, int]] = {  # VTK's kind, and the number of nodes
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
ORDERS = {  # of the nodes in VTK, by its kind, where it is another one
    24: [0, 1, 2, 3, 4, 5, 6, 7, 9, 8],
    25: [0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15],
    26: [0, 1, 2, 3, 4, 5, 6, 9, 7, 12, 14, 13, 8, 10, 11],
    27: [0, 1, 2, 3, 4, 5, 8, 10, 6, 7, 9, 11, 12],
    29: [*range(8), 8, 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15, 22, 23, 21, 24, 20, 25, 26],
    32: [0, 1, 2, 3, 4, 5, 6, 9, 7, 12, 14, 13, 8, 10, 11, 15, 17, 16],
}
CORNERS = {3: 2, 5: 3, 9: 4, 10: 4, 12: 8, 13: 6, 14: 5}  # of the straight cells, by VTK's kind


def nodes_of(kind: int) -> int:
    """The number of nodes of an element of Gmsh's type `kind`.

    Raises:
        FormatError: if the type is not known.
    """
    if kind not in TYPES:
        raise FormatError(f"it has elements of Gmsh's type {kind}, which is not known here")
    return TYPES[kind][1]


def dimension_of(kind: int) -> int:
    """The dimension of a cell of VTK's kind `kind`, 0 to 3."""
    if kind in (1,):
        return 0
    if kind in (3, 21):
        return 1
    return 2 if kind in (5, 9, 22, 23, 28) else 3
