"""The faces and edges of the solid cells of a mesh, each once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.mesh import Faces

_FACTOR = np.uint64(0x9E3779B97F4A7C15)

TINY = 1e-150  # areas and volumes below are none


class Between(NamedTuple):
    """Faces of solid cells, each once, and the cells that each lies between.

    Attributes:
        sizes: [f], corners: the corners of all faces, one face after another, as the owner has them.
        owner, neighbour: [f] the cells (0, 1 ... c - 1 in the order of the mesh's solids), -1 where there is no second.
    """

    sizes: Ints
    corners: Ints
    owner: Ints
    neighbour: Ints

    @staticmethod
    def of(faces: Faces) -> Between:
        """The faces of all solid cells by `cells.faces_of`, in their order; of a face of three cells two count."""
        cell = np.unique(faces.cell, return_inverse=True)[1].reshape(-1)
        number = alike(faces.sizes, faces.corners)
        order = np.argsort(number, kind="stable")
        uses = np.bincount(number)
        starts = np.cumsum(uses) - uses
        first, second = order[starts], order[starts + np.minimum(uses - 1, 1)]
        neighbour = np.where(uses > 1, cell[second], -1)
        order = np.argsort(first)
        first = first[order]
        return Between(faces.sizes[first], corners_of(faces.sizes, faces.corners, first), cell[first], neighbour[order])

    @property
    def outer(self) -> Ints:
        """The faces of one cell only."""
        return np.flatnonzero(self.neighbour < 0)


def within(sizes: Ints) -> Ints:
    """0, 1 ... for each of several groups, one after another."""
    return np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)


def corners_of(sizes: Ints, corners: Ints, chosen: Ints) -> Ints:
    """The corners of some faces, one after another."""
    starts, own = (np.cumsum(sizes) - sizes)[chosen], sizes[chosen]
    return corners[np.repeat(starts, own) + within(own)]


def alike(sizes: Ints, corners: Ints) -> Ints:
    """A number [f] of each face, the same where faces have the same corners, in whatever order: 0, 1 ..."""
    padded = np.full((len(sizes), int(sizes.max(initial=0))), -1)
    padded[np.repeat(np.arange(len(padded)), sizes), within(sizes)] = corners
    padded.sort(axis=1)
    key = np.zeros(len(padded), np.uint64)  # rows that are equal have equal keys, and others hardly ever
    for column in padded.T:
        key = (key ^ column.astype(np.uint64)) * _FACTOR
        key ^= key >> np.uint64(29)
    order = np.argsort(key, kind="stable")
    key = key[order]
    new = key[1:] != key[:-1]
    same = np.flatnonzero(~new)
    if (padded[order[same]] != padded[order[same + 1]]).any():
        return np.unique(padded, axis=0, return_inverse=True)[1].reshape(-1)
    number = np.empty(len(padded), np.int64)
    number[order] = np.concatenate([np.zeros(min(len(padded), 1), np.int64), np.cumsum(new)])
    return number


def edges_of(sizes: Ints, corners: Ints) -> Ints:
    """The edges [e, 2] of faces, each once, the lower point first; those from a point to itself are left out."""
    after = np.arange(1, len(corners) + 1)
    ends = np.cumsum(sizes)
    after[ends[sizes > 0] - 1] = (ends - sizes)[sizes > 0]
    low, high = np.minimum(corners, corners[after]), np.maximum(corners, corners[after])
    count = int(high.max(initial=0)) + 1
    number = np.sort((low * count + high)[low != high])
    number = number[np.concatenate([np.ones(min(len(number), 1), bool), number[1:] != number[:-1]])]
    return np.stack([number // count, number % count], axis=1)


def areas(points: Array, sizes: Ints, corners: Ints) -> tuple[Array, Array]:
    """Area vectors [f, 3] and centres [f, 3] of polygons, each cut into triangles about the middle of its corners.

    Args:
        points: [n, 3]; sizes: [f], corners: of the polygons, one after another.
    """
    vectors, centres = np.empty((2, len(sizes), 3))
    starts = np.cumsum(sizes) - sizes
    for size in np.unique(sizes):
        chosen = np.flatnonzero(sizes == size)
        place = points[corners[starts[chosen, None] + np.arange(size)]]
        middle = place.mean(axis=1)
        place -= middle[:, None]
        total, away, weight = np.zeros((len(chosen), 3)), np.zeros((len(chosen), 3)), np.zeros(len(chosen))
        for corner in range(size):
            own, after = place[:, corner], place[:, (corner + 1) % size]
            vector = 0.5 * np.cross(own, after)
            area = np.linalg.norm(vector, axis=1)
            total += vector
            away += area[:, None] * (own + after) / 3.0
            weight += area
        vectors[chosen], centres[chosen] = total, middle + away / np.maximum(weight, TINY)[:, None]
    return vectors, centres
