"""How far the faces of a volume mesh are from what a finite-volume solver likes: non-orthogonality and skewness.

The definitions are those of OpenFOAM's checkMesh, for faces and cells of any shape. With the middle m of a face's n
corners x_i, it is cut into the triangles (x_i, x_i+1, m), with area vectors s_i and centres t_i:

    S = sum s_i,    f = sum |s_i| t_i / sum |s_i|             the area vector and the centre of the face
    e = mean of f,  C = sum v_f (3/4 f + 1/4 e) / sum v_f     the centre of a cell, v_f = S . (f - e) / 3

and with d = C_2 - C_1 for a face between cells 1 and 2:

    non-orthogonality    the angle between S and d
    skewness             |v| / max(0.2 |d|, the largest |v/|v| . (x_i - f)|),    v = f - C_1 - (S.(f - C_1) / S.d) d

v points from where d meets the plane of the face to the centre of the face; it is measured in the size of the face
along v. At a boundary face d = (n.(f - C_1)) n with its unit normal n, and 0.4 |d| stands for 0.2 |d|.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.faces import TINY, Between, areas


class Quality(NamedTuple):
    """The largest angle between a face's normal and the line between its cells' centres (degrees), and skewness."""

    non_orthogonality: float
    skewness: float


def qualities(points: Array, moved: Array, faces: Between) -> tuple[Quality, Quality]:
    """The worst non-orthogonality and skewness of a volume mesh at points [n, 3] and at moved points [n, 3].

    Which side of a face is which cell's is decided at `points`, so faces that a move turns over exceed 90 degrees.
    """
    used = points[faces.corners]
    shift = used.mean(axis=0)
    extent = float(np.abs(used - shift).max()) or 1.0
    before, after = ((places - shift) / extent for places in (points, moved))  # no unit counts, and nothing cancels
    sides = _sides(before, faces)
    return _quality(before, faces, *sides), _quality(after, faces, *sides)


def _sums(of: Ints, values: Array, count: int) -> Array:
    """The sums [count, 3] of values [k, 3] of groups `of` [k]."""
    return np.stack([np.bincount(of, column, minlength=count) for column in values.T], axis=1)


def _estimates(centres: Array, faces: Between) -> Array:
    """The means [c, 3] of the centres of each cell's faces."""
    cell, face = _uses(faces)
    return _sums(cell, centres[face], int(cell.max()) + 1) / np.bincount(cell)[:, None]


def _uses(faces: Between) -> tuple[Ints, Ints]:
    """Which cell has which face: owners first, then neighbours."""
    inner = np.flatnonzero(faces.neighbour >= 0)
    return np.concatenate([faces.owner, faces.neighbour[inner]]), np.concatenate([np.arange(len(faces.owner)), inner])


def _sides(points: Array, faces: Between) -> tuple[Array, Array]:
    """[f] 1 or -1: whether the normal of a face points out of its owner, and [f] the same of its neighbour."""
    vectors, centres = areas(points, faces.sizes, faces.corners)
    estimates = _estimates(centres, faces)
    out = [
        np.where((vectors * (centres - estimates[cell])).sum(axis=1) < 0, -1.0, 1.0)
        for cell in (faces.owner, faces.neighbour)
    ]
    return out[0], out[1]


def _quality(points: Array, faces: Between, out: Array, out_of_neighbour: Array) -> Quality:
    vectors, centres = areas(points, faces.sizes, faces.corners)
    estimates = _estimates(centres, faces)
    cell, face = _uses(faces)
    side = np.concatenate([out, out_of_neighbour[faces.neighbour >= 0]])
    volume = side * (vectors[face] * (centres[face] - estimates[cell])).sum(axis=1) / 3.0
    weighted = _sums(cell, volume[:, None] * 0.75 * (centres[face] - estimates[cell]), len(estimates))
    total = np.bincount(cell, volume)
    middles = estimates + weighted / np.where(np.abs(total) > TINY, total, np.inf)[:, None]

    vectors *= out[:, None]
    inner = faces.neighbour >= 0
    dot = functools.partial(np.einsum, "ij,ij->i")
    area = np.maximum(np.linalg.norm(vectors, axis=1), TINY)
    normal, away = vectors / area[:, None], centres - middles[faces.owner]
    between = np.where(
        inner[:, None], middles[faces.neighbour] - middles[faces.owner], dot(normal, away)[:, None] * normal
    )
    length = np.linalg.norm(between, axis=1)
    cosine = (dot(normal, between) / np.maximum(length, TINY))[inner]
    worst = float(np.degrees(np.arccos(np.clip(cosine.min(initial=1.0), -1.0, 1.0))))

    across = dot(normal, between)
    across = np.where(np.abs(across) < TINY, TINY, across)
    skew = away - (dot(normal, away) / across)[:, None] * between
    distance = np.linalg.norm(skew, axis=1)
    along = skew / np.maximum(distance, TINY)[:, None]
    corner = np.repeat(np.arange(len(centres)), faces.sizes)
    reach = np.abs(dot(along[corner], points[faces.corners] - centres[corner]))
    widest = np.maximum.reduceat(reach, np.cumsum(faces.sizes) - faces.sizes)
    size = np.maximum(np.maximum(widest, np.where(inner, 0.2, 0.4) * length), TINY)
    return Quality(worst, float((distance / size).max()))
