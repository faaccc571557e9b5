"""Whether sensitivities are integrated (nodal) or per area (density), where the files give a hint.

The default is nodal. A hint that speaks against it is asked about, and `scenario.sensitivity_kind` answers. There are
two hints: the name of an array that a solver is known to write per area, and values that do not follow the areas of
vertices where a mesh is refined.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array

from rbfevo.arrays import Triangles
from rbfevo.errors import UserError
from rbfevo.geometry import topology

KINDS = ("nodal", "density")
DEFAULT = "nodal"

# Names of arrays (of a column or its vector, in lower case) that are, or may be, per area, and why.
PER_AREA = (
    # OpenFOAM, sensitivitySurface.C and sensitivitySurfacePoints.C of adjointOptimisation: values are multiplied by
    # areas if includeSurfaceArea is true; its default depends on the type of sensitivity and the version.
    (
        re.compile(r"(?:face|point)sens(?:vec|normal).*"),
        "OpenFOAM writes it per area (density) unless includeSurfaceArea is true (nodal)",
    ),
    (re.compile(r".*per[ _-]?(?:unit[ _-]?)?area.*"), "its name says per area (density)"),
)

RATIO = 3.0  # of the mean areas about two vertices that are compared: single ones differ by 4 or more then
FEWEST, SHARE_OF_ROOT = 20, 0.25  # vertices on either side of such a ratio; of sqrt(n), the length of a line across
NEAR_ZERO = 0.25  # slope up to which sizes clearly do not follow areas; integrated values have 1
CERTAIN = 0.5  # which the slope stays below by twice its standard error

Array = NDArray[np.float64]


class Slope(NamedTuple):
    """How the size of values follows the areas of vertices: |s| ~ area^slope; its standard error, and vertices used."""

    slope: float
    error: float
    vertices: int


def ask(names: Iterable[str], values: Array, areas: Array, triangles: Triangles, source: str) -> None:
    """Raise UserError if values that are to be taken as integrated seem to be per area.

    Args:
        names: of the array, or the columns and the file; values: [n] or [n, 3]; areas: [n]; triangles: [f, 3].
        source: the sensitivity's name, for the message.

    Raises:
        UserError: with the reason, asking for `scenario.sensitivity_kind`.
    """
    reason = hint(names, values, areas, triangles)
    if reason is not None:
        raise UserError(
            f"scenario.sensitivity={source}: is it integrated over each vertex's share of the surface, or per area? "
            f"{reason}; set scenario.sensitivity_kind=nodal (integrated) or density (per area)"
        )


def hint(names: Iterable[str], values: Array, areas: Array, triangles: Triangles) -> str | None:
    """What suggests that values are per area, in a sentence; None where nothing does. Arguments as for `ask`."""
    for name in names:
        for pattern, reason in PER_AREA:
            if pattern.fullmatch(name.strip().lower()):
                return f"{name}: {reason}"
    found = slope(values, areas, triangles)
    if found is None or found.slope > NEAR_ZERO or found.slope + 2.0 * found.error >= CERTAIN:
        return None
    return (
        f"Where the mesh is refined, its size goes with area^{found.slope:.2f} ({found.vertices} vertices; integrated "
        "values go with area^1, those per area with area^0)"
    )


def slope(values: Array, areas: Array, triangles: Triangles) -> Slope | None:
    """Fit log|s| against log(area) across the border of refined regions; None if the mesh has too little of one.

    Areas and |s| are first averaged over each vertex and its neighbours, since single triangles of odd shape say
    nothing. Pairs are vertices at most two edges apart whose mean areas differ by a factor of 3 or more: between them
    the field itself changes little. The slope is the median of theirs; its error counts each vertex once.

    Args:
        values: [n] or [n, 3]; areas: [n]; triangles: [f, 3].
    """
    n = len(areas)
    ends = topology.edges_of(n, triangles).ends
    links = csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(n, n))
    links = csr_array(links + links.T + eye_array(n))
    size = np.abs(values) if values.ndim == 1 else np.linalg.norm(values, axis=1)
    size, area = (links @ single / np.diff(links.indptr) for single in (size, areas))
    usable = (size > 0.0) & (area > 0.0)
    logs, logs_of_size = (np.log(np.where(usable, mean, 1.0)) for mean in (area, size))
    steep = _steep(links, logs)  # most meshes have few such vertices
    near = (links[steep] @ links).tocoo()
    small, large = steep[near.row], near.col
    kept = usable[small] & usable[large] & (logs[large] - logs[small] >= np.log(RATIO))
    small, large = small[kept], large[kept]
    fewest = min(len(np.unique(small)), len(np.unique(large)))
    if fewest < max(FEWEST, SHARE_OF_ROOT * np.sqrt(n)):
        return None
    slopes = (logs_of_size[large] - logs_of_size[small]) / (logs[large] - logs[small])
    low, middle, high = np.percentile(slopes, [25.0, 50.0, 75.0])
    return Slope(float(middle), float(1.2533 * (high - low) / 1.349 / np.sqrt(fewest)), fewest)


def _steep(links: csr_array, logs: Array) -> NDArray[np.int64]:
    """Vertices from which areas rise by sqrt(RATIO) or more on one of two edges: the smaller ends of all pairs."""
    start = np.repeat(np.arange(len(logs)), np.diff(links.indptr))
    rise = np.full(len(logs), -np.inf)
    np.maximum.at(rise, start, logs[links.indices] - logs[start])
    next_rise = np.full(len(logs), -np.inf)
    np.maximum.at(next_rise, start, rise[links.indices])
    return np.flatnonzero(np.maximum(rise, next_rise) >= np.log(RATIO) / 2.0)
