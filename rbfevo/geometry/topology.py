"""Properties of a triangle mesh: oddities, a consistent winding, normals and areas of its vertices."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from rbfevo.arrays import Points, Triangles
from rbfevo.geometry.crossings import piercing_edges
from rbfevo.geometry.triangles import doubled_area_vectors, triangle_areas

MOST_TRIANGLES = 200_000  # up to which crossings are searched for
FLAT = 1e-3  # volume over area^1.5, below which a surface has no inside; a ball has 0.094
_SHELLS = 100  # of the largest closed pieces, in which others are searched for


def oddities(vertices: Points, triangles: Triangles, edges: Edges | None = None) -> dict[str, str]:
    """Return one line for each oddity of a mesh that is harmless but may be unintended.

    Keys: `open boundary`, `non-manifold edges`, `pieces` (by shared vertices), `winding`, `inside out`, `crossings`.

    Args:
        vertices: [n, 3]; triangles: [f, 3], none with a corner twice.
        edges: those of the mesh, where they are known already.
    """
    edges, found = edges or edges_of(len(vertices), triangles), {}
    if border := int((edges.uses == 1).sum()):
        found["open boundary"] = f"{border} of {len(edges.uses)} edges belong to one triangle only"
    if crowded := int((edges.uses > 2).sum()):
        found["non-manifold edges"] = f"{crowded} of {len(edges.uses)} edges belong to more than two triangles"

    count, piece = _pieces(len(vertices), edges.ends)
    if count > 1:
        sizes = np.bincount(piece)
        found["pieces"] = f"{count} pieces that share no vertex; the largest has {sizes.max()} vertices"
    clashing = (edges.uses == 2) & (edges.balance != 0)
    if clashing.any():
        found["winding"] = f"at {int(clashing.sum())} edges the two triangles have opposite winding"

    closed = np.ones(count, bool)
    closed[piece[edges.ends[(edges.uses != 2) | clashing, 0]]] = False
    of_triangle = piece[triangles[:, 0]]
    inward = closed & (_volumes(vertices, triangles, of_triangle, count) < 0.0)
    inward &= ~_nested(vertices, triangles, of_triangle, closed)
    if inward.any():
        found["inside out"] = (
            f"{int(inward.sum())} of {int(closed.sum())} closed pieces have normals that point inwards"
        )

    if len(triangles) > MOST_TRIANGLES:
        found["crossings"] = f"self-intersections were not searched for (more than {MOST_TRIANGLES:,} triangles)"
    elif pierced := len(piercing_edges(vertices, triangles, edges.ends)):
        found["crossings"] = f"the surface intersects itself: {pierced} edges pierce a triangle"
    return found


def oriented(vertices: Points, triangles: Triangles, edges: Edges | None = None) -> tuple[Triangles, int]:
    """Wind triangles [f, 3] consistently with their neighbours; return them and how many were turned.

    Neighbours are the two triangles at an edge that has no third. Of a closed piece the normals point outward, of an
    open one, and of one within another, which may be the wall of a cavity, as those of most of its triangles do. A
    one-sided piece keeps edges where the winding clashes.
    """
    edges, f = edges or edges_of(len(vertices), triangles), len(triangles)
    pairs, same = edges.neighbours()
    keys, first = np.unique(pairs[:, 0] * f + pairs[:, 1], return_index=True)
    one, other = np.divmod(keys, f)
    count, piece = connected_components(coo_array((np.ones(len(keys)), (one, other)), shape=(f, f)), directed=False)
    # One more triangle, the root, is a neighbour of one triangle of each piece, so that one search reaches all. A link
    # weighs 1 where both are wound alike, else 2.
    starts = np.unique(piece, return_index=True)[1]
    rows, columns = np.concatenate([one, np.full(count, f)]), np.concatenate([other, starts])
    weights = np.concatenate([np.where(same[first], 1, 2), np.ones(count, np.int64)])
    links = coo_array((weights, (rows, columns)), shape=(f + 1, f + 1)).tocsr()
    links = csr_array(links + links.T)
    order, parent = breadth_first_order(links, f, directed=False)
    parent = parent.astype(np.int64)
    parent[f] = f
    children = order[1:]
    turned = np.zeros(f + 1, bool)
    turned[children] = np.asarray(links[children, parent[children]]).reshape(-1) == 2
    while (parent != f).any():  # each round adds up twice as long a way to the root
        turned ^= turned[parent]
        parent = parent[parent]
    turned = turned[:f]

    wound = np.where(turned[:, None], triangles[:, ::-1], triangles)
    lonely = np.zeros(count, bool)
    lonely[piece[edges.triangle[edges.uses[edges.index] != 2]]] = True
    lonely |= _nested(vertices, triangles, piece, ~lonely)
    sizes, turns = np.bincount(piece, minlength=count), np.bincount(piece, turned, minlength=count)
    inward = _volumes(vertices, wound, piece, count) < 0.0
    reverse = np.where(lonely, 2 * turns > sizes, inward)[piece]
    return np.where(reverse[:, None], wound[:, ::-1], wound), int((turned ^ reverse).sum())


def flat(vertices: Points) -> bool:
    """Tell whether all vertices [n, 3] lie in one plane, up to the rounding of single precision."""
    spans = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False) if len(vertices) > 2 else np.zeros(3)
    return bool(spans[-1] <= 1e-6 * spans[0])


def inward(vertices: Points, triangles: Triangles) -> bool:
    """Tell whether an open surface is wound with its normals inwards, once its holes are closed towards their middle.

    False for closed surfaces, and where the enclosed volume is negligible, as for a flat sheet.
    """
    return enclosed(vertices, triangles) < -FLAT and bool(rim(vertices, triangles).size)


def enclosed(vertices: Points, triangles: Triangles) -> float:
    """Return the volume that a surface encloses once its holes are closed towards their middle, over its area^1.5.

    Positive where the normals point outwards; 0 for a surface without triangles.
    """
    area = float(triangle_areas(vertices, triangles).sum())
    if area == 0.0:
        return 0.0
    border = rim(vertices, triangles)
    middle = vertices[border if border.size else triangles.reshape(-1)].mean(axis=0)
    a, b, c = np.moveaxis(vertices[triangles] - middle, 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6.0 / area**1.5


def clashes(edges: Edges) -> int:
    """Return at how many edges of just two triangles these are wound against each other."""
    return int(((edges.uses == 2) & (edges.balance != 0)).sum())


def rim(vertices: Points, triangles: Triangles) -> NDArray[np.int64]:
    """Return the vertices [r] on the open boundary, at edges of one triangle only."""
    edges = edges_of(len(vertices), triangles)
    return np.unique(edges.ends[edges.uses == 1])


def vertex_normals(vertices: Points, triangles: Triangles) -> Points:
    """Return unit normals [n, 3] of the vertices, each triangle's weighted with its area; zero where they cancel."""
    scale = float(np.abs(vertices).max()) or 1.0
    sums = _summed(doubled_area_vectors(vertices / scale, triangles), triangles, len(vertices))
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0.0)


def volume(vertices: Points, triangles: Triangles) -> float:
    """Return the signed volume that a closed surface encloses, positive where its normals point outwards."""
    extent = float(np.ptp(vertices, axis=0).max())
    return float(_volumes(vertices, triangles, np.zeros(len(triangles), np.int64), 1)[0]) * extent**3


def vertex_areas(vertices: Points, triangles: Triangles) -> NDArray[np.float64]:
    """Return the area [n] of the surface about each vertex: a third of each of its triangles', in squared units."""
    thirds = triangle_areas(vertices, triangles)[:, None] / 3.0
    return _summed(thirds, triangles, len(vertices))[:, 0]


@dataclasses.dataclass(frozen=True)
class Edges:
    """Edges [e] of a mesh, and its half edges [3 f], three for each triangle in turn.

    ends: [e, 2] vertices, ascending. uses: [e] triangles at the edge. balance: [e] how many more of them run up from
    the lower vertex than down. index: [3 f] each half edge's edge; triangle: [3 f] its triangle; up: [3 f].
    """

    ends: NDArray[np.int64]
    uses: NDArray[np.int64]
    balance: NDArray[np.int64]
    index: NDArray[np.int64]
    triangle: NDArray[np.int64]
    up: NDArray[np.bool_]

    def neighbours(self) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Pairs [k, 2] of the triangles at edges with just two, and whether they are wound alike [k]."""
        order = np.argsort(self.index, kind="stable")
        paired = order[(self.uses == 2)[self.index[order]]].reshape(-1, 2)
        pairs = self.triangle[paired]
        return pairs, self.up[paired[:, 0]] != self.up[paired[:, 1]]


def edges_of(n: int, triangles: Triangles) -> Edges:
    """The edges of triangles [f, 3] among n vertices."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    up = start < end
    keys, index, uses = np.unique(
        np.minimum(start, end) * n + np.maximum(start, end), return_inverse=True, return_counts=True
    )
    balance = np.bincount(index, np.where(up, 1, -1), minlength=len(keys)).astype(np.int64)
    ends = np.stack(np.divmod(keys, n), axis=1)
    return Edges(ends, uses, balance, index, np.repeat(np.arange(len(triangles)), 3), up)


def pieces(n: int, edges: Edges) -> int:
    """Return how many pieces n vertices make that share no vertex."""
    return _pieces(n, edges.ends)[0]


def _pieces(n: int, ends: NDArray[np.int64]) -> tuple[int, NDArray[np.int64]]:
    links = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(n, n))
    count, piece = connected_components(links, directed=False)
    return int(count), piece.astype(np.int64)


def _volumes(vertices: Points, triangles: Triangles, piece: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    """Signed volume [count] that the triangles of each piece [f] enclose if it is closed, in units of the box."""
    middle, extent = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max()) or 1.0
    a, b, c = np.moveaxis(((vertices - middle) / extent)[triangles], 1, 0)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    return np.bincount(piece, volumes, minlength=count).astype(np.float64)


def _nested(
    vertices: Points, triangles: Triangles, piece: NDArray[np.int64], closed: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which pieces [p] have a bounding box within that of another, closed piece; `piece` [f] is each triangle's."""
    low, high = np.full((len(closed), 3), np.inf), np.full((len(closed), 3), -np.inf)
    for corner in triangles.T:
        np.minimum.at(low, piece, vertices[corner])
        np.maximum.at(high, piece, vertices[corner])
    nested = np.zeros(len(closed), bool)
    largest = np.flatnonzero(closed)
    largest = largest[np.argsort(-(high - low)[largest].prod(axis=1), kind="stable")][:_SHELLS]
    for shell in largest:
        nested |= ((low > low[shell]) & (high < high[shell])).all(axis=1)
    return nested


def _summed(values: Points, triangles: Triangles, n: int) -> Points:
    """Sum values [f, k] of the triangles at each vertex: [n, k]."""
    corners = triangles.reshape(-1)
    sums = [np.bincount(corners, np.repeat(column, 3), minlength=n).astype(np.float64) for column in values.T]
    return np.stack(sums, axis=1)
