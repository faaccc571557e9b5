"""Where a surface passes through itself: the edges that pierce a triangle."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Points, Triangles

_BLOCK, _ROUNDING = 200_000, 1e-12


_LAST: dict[bytes, NDArray[np.int64]] = {}  # of the last surface: a design is often built again with other settings


def piercing_edges(vertices: Points, triangles: Triangles, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices of those `edges` [e, 2] that pierce a triangle with which they share no vertex.

    Vertices that coincide count as one, so a seam is no crossing; nor is a touch: the ends of the edge lie strictly on
    the two sides of the triangle, and it passes between the triangle's edges, or through one of them.
    """
    hashed = hashlib.blake2b()
    for array in (vertices, triangles, edges):
        hashed.update(np.ascontiguousarray(array).data)
    if hashed.digest() not in _LAST:
        _LAST.clear()
        _LAST[hashed.digest()] = _found(vertices, triangles, edges)
    return _LAST[hashed.digest()].copy()


def _found(vertices: Points, triangles: Triangles, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """What `piercing_edges` returns."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkIdList, vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkStaticCellLocator

    low, extent = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max()) or 1.0
    scaled = np.ascontiguousarray((vertices - low) / extent)
    points, cells, surface = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(scaled, deep=True))
    cells.SetData(3, numpy_to_vtkIdTypeArray(np.ascontiguousarray(triangles).reshape(-1), deep=True))
    surface.SetPoints(points)
    surface.SetPolys(cells)
    locator = vtkStaticCellLocator()
    locator.SetDataSet(surface)
    locator.BuildLocator()

    place, near = np.unique(scaled, axis=0, return_inverse=True)[1].reshape(-1), vtkIdList()
    found, edge_of, triangle_of = [np.empty(0, np.int64)], [], []
    for k, (start, end) in enumerate(scaled[edges].tolist()):
        locator.FindCellsAlongLine(start, end, _ROUNDING, near)
        count = near.GetNumberOfIds()
        edge_of += [k] * count
        triangle_of += [near.GetId(i) for i in range(count)]
        if len(edge_of) >= _BLOCK or k == len(edges) - 1:
            edge, triangle = np.array(edge_of, np.int64), np.array(triangle_of, np.int64)
            apart = (place[edges[edge]][:, :, None] != place[triangles[triangle]][:, None, :]).all(axis=(1, 2))
            edge, triangle = edge[apart], triangle[apart]
            found.append(np.unique(edge[_pierce(scaled[edges[edge]], scaled[triangles[triangle]])]))
            edge_of, triangle_of = [], []
    return np.unique(np.concatenate(found))


def _pierce(lines: Points, corners: Points) -> NDArray[np.bool_]:
    """[k] True where a line [k, 2, 3] ends strictly on both sides of a triangle [k, 3, 3] and passes through it.

    Volumes of tetrahedra decide, each by more than the rounding of its products.
    """
    start, end = np.moveaxis(lines, 1, 0)
    a, b, c = np.moveaxis(corners, 1, 0)
    before, after = _side(a, b, c, start), _side(a, b, c, end)
    between = np.stack([_side(start, end, a, b), _side(start, end, b, c), _side(start, end, c, a)])
    # Through an edge counts: parts that are mirror images of each other cross there and nowhere else.
    return (before * after < 0) & ((between >= 0).all(axis=0) | (between <= 0).all(axis=0)) & between.any(axis=0)


def _side(a: Points, b: Points, c: Points, d: Points) -> NDArray[np.int64]:
    """On which side of the plane through a, b and c the point d is, all [k, 3]: 1, -1, or 0 if rounding decides."""
    u, v, w = a - d, b - d, c - d
    normal = np.cross(v, w)
    volume = np.einsum("ij,ij->i", u, normal)
    doubt = _ROUNDING * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1) * np.linalg.norm(w, axis=1)
    return np.where(np.abs(volume) > doubt, np.sign(volume), 0.0).astype(np.int64)
