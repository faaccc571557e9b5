"""What a case's sensitivities mean, by the entries of system/optimisationDict that made them.

OpenFOAM's adjoint writes dJ/dx, so that J falls against it; scalars are along the normal that points out of the fluid,
the way in which the faces of a patch are wound. Whether values are integrated depends on `includeSurfaceArea`, whose
default depends on the type: `surfacePoints` then divides by the sum of the areas of the faces about a point, which
`areas_about` makes undone; `surface` of v2306 and older is integrated over each face unless it is set to false.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.faces import areas
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.openfoam.case import Case
from rbfevo.meshes.openfoam.dictionary import UNKNOWN, boolean, read_dictionary

DICTIONARY = "system/optimisationDict"
UNCOUPLED = ("cyclic", "cyclicAMI", "cyclicACMI", "processor", "processorCyclic", "empty", "symmetry", "symmetryPlane")


class Entry(NamedTuple):
    """What optimisationDict says of the sensitivities.

    Attributes:
        kind: the type of sensitivity; area: includeSurfaceArea, or None where it is not set.
        patches: names or patterns of the design's patches; newer: whether the dictionary is that of v2312 and later.
    """

    kind: str
    area: bool | None
    patches: tuple[str, ...]
    newer: bool


def entries(case: Case) -> list[Entry]:
    """The sensitivities that optimisationDict asks for; none where there is no such dictionary, or it is unknown."""
    try:
        found = read_dictionary(case.root / DICTIONARY)
    except (OSError, FormatError, RecursionError):
        return []
    optimisation = found.get("optimisation")
    if not isinstance(optimisation, dict):
        return []
    newer = isinstance(optimisation.get("designVariables"), dict)
    node = optimisation["designVariables"] if newer else optimisation.get("sensitivities")
    return list(_listed(node, newer)) if isinstance(node, dict) else []


def _listed(node: dict[str, Any], newer: bool) -> Iterator[Entry]:
    kind = node.get("sensitivityType" if newer else "type", node.get("type"))
    if kind == "multiple":
        for key in ("sensTypes", "sensitivityTypes"):
            inner = node.get(key)
            several = list(inner.values()) if isinstance(inner, dict) else [node.get(str(name)) for name in inner or []]
            for one in several:
                if isinstance(one, dict):
                    yield from _listed({"patches": node.get("patches", []), **one}, newer)
        return
    area, patches = node.get("includeSurfaceArea"), node.get("patches", [])
    if kind in (None, UNKNOWN) or area == UNKNOWN or patches == UNKNOWN or (area is not None and boolean(area) is None):
        return
    names = tuple(str(name) for name in ([patches] if isinstance(patches, str) else patches))
    yield Entry(str(kind), None if area is None else boolean(area), names, newer)


def entry_of(found: list[Entry], name: str) -> Entry | None:
    """The one entry that makes a field of this name; None where none or several do."""
    wanted = "surfacePoints" if name.startswith("pointSens") else "surface"
    fitting = [one for one in found if one.kind == wanted or (one.newer and one.kind == "surface")]
    return fitting[0] if len(set(fitting)) == 1 else None


def areas_about(points: Array, sizes: Ints, corners: Ints, count: int) -> Array:
    """The sum [count] of the full areas of the faces about each point.

    Args:
        points: [count, 3]; sizes: [f], corners: of some faces, one after another.
    """
    area = np.linalg.norm(areas(points, sizes, corners)[0], axis=1)
    return np.bincount(corners, np.repeat(area, sizes), minlength=count)
