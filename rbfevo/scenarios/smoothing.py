"""A wanted displacement smoothed over a length: the Sobolev filter on the part of the surface that may move."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Points, Triangles
from rbfevo.geometry import sobolev

Array = NDArray[np.float64]


class Smoothing(NamedTuple):
    """The smoothed wanted displacement [n, k], and the share of |g|^2 that smoothing removed."""

    wanted: Array
    removed: float


def smoothed(
    wanted: Array,
    vertices: Points,
    triangles: Triangles,
    weights: Array,
    held: NDArray[np.bool_],
    length: float,
    integrated: bool,
) -> Smoothing:
    """Smooth a wanted displacement with the Sobolev filter of `rbfevo.geometry.sobolev`.

    What is filtered is a function of the surface that does not depend on its mesh. A displacement (of a target) is one.
    A gradient g_i = -s_i / w_i of integrated sensitivities s_i is not, unless the weights are areas: there it is the
    density -s_i / a_i = g_i w_i / a_i that is filtered, and the result turned back.

    The filter runs on the free part alone: held vertices keep 0, the stiffness is that of the triangles without a held
    corner, and nothing flows over the border between them. A vertex that has only such triangles keeps its value.

    Args:
        wanted: [n, k]; vertices: [n, 3]; triangles: [f, 3], or segments [s, 2] of a curve; weights: [n].
        held: [n] vertices that should not move; length: l, model units.
        integrated: whether `wanted` comes from integrated sensitivities, not from a displacement.
    """
    areas = np.where(held, 0.0, sobolev.mass(vertices, triangles))
    stiffness = sobolev.stiffness(vertices, triangles[~held[triangles].any(axis=1)])
    per_area = np.divide(weights, areas, out=np.zeros_like(weights), where=areas > 0.0)
    factor = per_area[:, None] if integrated else np.ones((len(wanted), 1))
    density = sobolev.smoothed(factor * wanted, areas, stiffness, length)
    found = np.divide(density, factor, out=np.zeros_like(density), where=factor > 0.0)
    before, after = ((weights[:, None] * rows**2).sum() for rows in (wanted, found))
    return Smoothing(found, 1.0 - float(after / before))


def note(smoothing: Smoothing, vertices: Points, triangles: Triangles, length: float) -> str:
    """One line on the length, beside the edges of the mesh, and on what was removed."""
    edge = float(np.linalg.norm(vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)], axis=2).mean())
    share = smoothing.removed
    effect = f"removes {share:.1%} of |g|^2" if share >= 0.0 else f"adds {-share:.1%} to |g|^2"
    return f"g is smoothed over {length:.4g} ({length / edge:.2g} mean edges), which {effect}"
