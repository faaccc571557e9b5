"""Polygons are cut into triangles that cover each of them once, concave ones too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Points = NDArray[np.float64]

_ROUNDING = 1e-9  # of a polygon's area: what its parts may overlap


def triangles(points: Points, sizes: Ints, corners: Ints) -> tuple[Ints, Ints]:
    """Cut polygons into triangles [f, 3]; return them and the polygon [f] that each belongs to, rising.

    A polygon is a fan about its first corner where that covers it once, as it does where the polygon is convex. A
    concave quadrilateral is cut at its other diagonal, a larger polygon by VTK's ear clipping.

    Args:
        points: [n, 3] finite; sizes: [p] corners of each polygon; corners: all of them, one polygon after another.

    Raises:
        ValueError: with the number of polygons that cross themselves, which no triangles cover once.
    """
    starts = np.cumsum(sizes) - sizes
    cut, polygon = _fans(starts, np.zeros_like(sizes), sizes, corners)
    wrong = np.flatnonzero(_overlapping(points, cut, polygon, len(sizes)))
    if not wrong.size:
        return cut, polygon

    pieces, owners = [cut], [polygon]
    turned = wrong[sizes[wrong] == 4]
    other, owner = _fans(starts[turned], np.ones_like(turned), sizes[turned], corners)
    crossing = _overlapping(points, other, owner, len(turned))
    pieces.append(other)
    owners.append(turned[owner])
    count = int(crossing.sum())
    for index in wrong[sizes[wrong] > 4]:
        own = corners[starts[index] : starts[index] + sizes[index]]
        clipped = _clipped(points, own)
        if clipped is None:
            count += 1
        else:
            pieces.append(clipped)
            owners.append(np.full(len(clipped), index))
    if count:
        raise ValueError(f"{count} of its polygons cross themselves, so that no triangles cover them once")
    keep = ~np.isin(polygon, wrong)
    pieces[0], owners[0] = cut[keep], polygon[keep]
    cut, polygon = np.concatenate(pieces), np.concatenate(owners)
    order = np.argsort(polygon, kind="stable")
    return cut[order], polygon[order]


def _fans(starts: Ints, first: Ints, sizes: Ints, corners: Ints) -> tuple[Ints, Ints]:
    """Fans about the `first` corner [p] of each polygon, and the polygon of each triangle."""
    fans = np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes)), fans)
    within = np.arange(len(polygon)) - np.repeat(np.cumsum(fans) - fans, fans)
    start, apex, size = starts[polygon], first[polygon], sizes[polygon]
    places = [start + (apex + step) % np.maximum(size, 1) for step in (0 * within, within + 1, within + 2)]
    return np.stack([corners[place] for place in places], axis=1).reshape(-1, 3), polygon


def _areas(points: Points, cut: Ints) -> Points:
    """Twice the area vectors [f, 3] of triangles, in units in which none is too large to be squared."""
    corners = points[cut]
    finite = np.abs(corners[np.isfinite(corners)])
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is refused by whoever needs the points
        a, b, c = np.moveaxis(corners / max(float(finite.max(initial=0.0)), 1e-300), 1, 0)
        return np.cross(b - a, c - a)


def _overlapping(points: Points, cut: Ints, polygon: Ints, count: int) -> NDArray[np.bool_]:
    """[p] True where some triangles of a polygon are wound against the polygon as a whole: they overlap others."""
    areas = _areas(points, cut)
    whole = np.stack([np.bincount(polygon, areas[:, axis], minlength=count) for axis in range(3)], axis=1)
    length = np.linalg.norm(whole, axis=1)
    along = np.einsum("ij,ij->i", areas, whole[polygon]) / np.where(length > 0, length, 1.0)[polygon]
    total = np.bincount(polygon, np.linalg.norm(areas, axis=1), minlength=count)
    flat = length <= _ROUNDING * total  # a bow tie; a polygon without any area has total = 0
    against = np.zeros(count, bool)
    against[polygon[along < -_ROUNDING * total[polygon]]] = True
    return against | (flat & (total > 0))


def _clipped(points: Points, own: Ints) -> Ints | None:
    """One polygon cut by ear clipping, or None where that does not cover it once."""
    from vtkmodules.vtkCommonCore import vtkIdList
    from vtkmodules.vtkCommonDataModel import vtkPolygon

    polygon, found = vtkPolygon(), vtkIdList()
    places = points[own] - points[own].mean(axis=0)
    places = places / max(float(np.abs(places).max()), 1e-300)
    polygon.GetPointIds().SetNumberOfIds(len(own))
    polygon.GetPoints().SetNumberOfPoints(len(own))
    for place, point in enumerate(places.tolist()):
        polygon.GetPointIds().SetId(place, place)
        polygon.GetPoints().SetPoint(place, point)
    polygon.EarCutTriangulation(found)
    ids = [found.GetId(i) for i in range(found.GetNumberOfIds())]
    if len(ids) != 3 * (len(own) - 2):
        return None
    cut = own[np.array(ids, np.int64).reshape(-1, 3)]
    start = np.zeros(1, np.int64)
    whole = _areas(points, _fans(start, start, np.array([len(own)]), own)[0]).sum(axis=0)
    parts, length = _areas(points, cut) @ whole, float(np.linalg.norm(whole))
    return cut if parts.sum() > 0 and np.abs(parts).sum() <= (1.0 + 1e-6) * length**2 else None
