"""Curves of segments in a plane: a consistent direction, normals and lengths at their vertices, oddities, strips."""

from __future__ import annotations

import numpy as np

from rbfevo.arrays import Array, Ints, Points, Triangles


def oriented(places: Points, segments: Ints) -> tuple[Ints, int]:
    """Let segments [s, 2] between places [n, 2] run on one after another; return them and how many were turned.

    A closed curve runs counterclockwise, so that the normals to its right point outwards; an open one, and a closed one
    within another, which may be the wall of a hole, as most of its segments do. Where more than two segments meet, each
    branch is a curve of its own. Vertices in one place count as one.
    """
    one = _merged(places)[segments]
    turned = np.zeros(len(segments), bool)
    chains = _chains(one)
    boxes = [(places[segments[own]].min(axis=(0, 1)), places[segments[own]].max(axis=(0, 1))) for own, _, _ in chains]
    closed = [index for index, chain in enumerate(chains) if chain[2]]
    for index, (own, backwards, loop) in enumerate(chains):
        low, high = boxes[index]
        nested = any((low > boxes[other][0]).all() and (high < boxes[other][1]).all() for other in closed)
        if loop and not nested:
            ends = np.where(backwards[:, None], segments[own][:, ::-1], segments[own])
            a, b = np.moveaxis(places[ends] - places[segments[own]].mean(axis=(0, 1)), 1, 0)
            flip = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) < 0.0
        else:
            flip = 2 * int(backwards.sum()) > len(own)
        turned[own] = backwards ^ flip
    return np.where(turned[:, None], segments[:, ::-1], segments), int(turned.sum())


def normals(places: Points, segments: Ints) -> Points:
    """Unit normals [n, 2] of vertices, to the right of the segments there, each weighted with its length."""
    along = places[segments[:, 1]] - places[segments[:, 0]]
    vectors = np.stack([along[:, 1], -along[:, 0]], axis=1)
    place, sums = _merged(places), np.zeros((len(places), 2))
    for ends in segments.T:
        np.add.at(sums, place[ends], vectors)
    sums = sums[place]
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0.0)


def segment_lengths(vertices: Points, segments: Ints) -> Array:
    """The lengths [s] of segments [s, 2] of vertices [n, d]."""
    return np.linalg.norm(vertices[segments[:, 1]] - vertices[segments[:, 0]], axis=1)


def vertex_lengths(vertices: Points, segments: Ints) -> Array:
    """The length [n] of the curve about each vertex: half of each of its segments'."""
    halves = np.repeat(0.5 * segment_lengths(vertices, segments), 2)
    return np.bincount(segments.reshape(-1), halves, minlength=len(vertices)).astype(np.float64)


def ends(n: int, segments: Ints) -> Ints:
    """The vertices, of n, at which open curves end."""
    return np.flatnonzero(np.bincount(segments.reshape(-1), minlength=n) == 1)


def oddities(places: Points, segments: Ints) -> dict[str, str]:
    """A line for what is harmless but may be unintended: `open curve`, `branches`, `curves` (how many)."""
    one, found = _merged(places)[segments], {}
    uses = np.bincount(one.reshape(-1))
    if loose := int((uses == 1).sum()):
        found["open curve"] = f"the curve has {loose} open ends; its normals point to the right of its segments"
    if crowded := int((uses > 2).sum()):
        found["branches"] = f"at {crowded} vertices more than two segments meet"
    count = len(_chains(one))
    if count > 1:
        found["curves"] = f"{count} curves between ends and branches"
    return found


def strip(vertices: Points, segments: Ints, axis: int, depth: float) -> tuple[Points, Triangles]:
    """The surface that segments of vertices [n, 3] sweep by `depth` along an axis to both sides: [2n, 3], [2s, 3]."""
    n, step = len(vertices), np.zeros(3)
    step[axis] = depth
    a, b = segments.T
    triangles = np.concatenate([np.stack([a, b, b + n], axis=1), np.stack([a, b + n, a + n], axis=1)])
    return np.concatenate([vertices - step, vertices + step]), triangles


def _merged(places: Points) -> Ints:
    """The first vertex [n] in the place of each."""
    _, first, index = np.unique(places, axis=0, return_index=True, return_inverse=True)
    return first[index.reshape(-1)]


def _chains(segments: Ints) -> list[tuple[Ints, Array, bool]]:
    """Segments [s, 2] one after another: for each chain their numbers, which run backwards, and whether it is closed.

    A chain goes on where just two segments meet.
    """
    order = np.argsort(segments.reshape(-1), kind="stable")
    vertex = segments.reshape(-1)[order]
    begin = np.searchsorted(vertex, segments)  # of each end's entries in `order`
    uses = np.searchsorted(vertex, segments, side="right") - begin
    seen = np.zeros(len(segments), bool)
    starts = [(int(s), int(e)) for s, e in np.argwhere(uses != 2)] + [(s, 0) for s in range(len(segments))]
    found = []
    for segment, entered in starts:
        own, backwards, loop = [], [], False
        while not seen[segment]:
            seen[segment] = True
            own.append(segment)
            backwards.append(entered == 1)
            left = 1 - entered
            if uses[segment, left] != 2:
                break
            first, second = order[begin[segment, left] : begin[segment, left] + 2].tolist()
            following = second if first == 2 * segment + left else first
            segment, entered = divmod(following, 2)
            loop = bool(seen[segment]) and segment == own[0]
        if own:
            found.append((np.array(own), np.array(backwards), loop))
    return found
