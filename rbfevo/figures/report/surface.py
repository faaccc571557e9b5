"""The mesh that a page shows: all of it, or, where that would be too much for a browser, fewer vertices of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.recorded.record import Record

MOST = 25_000  # vertices: three megabytes in the page, and fluid


class Surface(NamedTuple):
    """The vertices of a page's mesh, some of a run's or all of them.

    Attributes:
        rows: [q] which vertices of the run; faces: [f, 3] among them, none where the run has none.
        weights: [q] each vertex' share of the sums over all vertices: those of the vertices that it stands for.
    """

    rows: Array
    faces: Array
    weights: Array


def surface_of(record: Record, most: int = MOST) -> Surface:
    """The mesh of a run on at most `most` vertices.

    A mesh with more of them is binned: of the vertices in a cell of a regular grid one stays, and stands for those
    that are nearest to it.
    """
    n = len(record.vertices)
    if n <= most:
        return Surface(np.arange(n), record.faces, record.weights)
    rows, faces = (_binned if len(record.faces) else _sampled)(record, most)
    from scipy.spatial import KDTree

    nearest = KDTree(record.vertices[rows]).query(record.vertices)[1]
    return Surface(rows, faces, np.bincount(nearest, weights=record.weights, minlength=len(rows)))


def _sampled(record: Record, most: int) -> tuple[Array, Array]:
    """Evenly spaced vertices of a design without faces."""
    return np.linspace(0, len(record.vertices) - 1, most).round().astype(int), record.faces[:0]


def _binned(record: Record, most: int) -> tuple[Array, Array]:
    import pyvista  # VTK takes a while, and only large meshes need it
    from vtkmodules.vtkFiltersCore import vtkBinnedDecimation

    points = np.zeros((len(record.vertices), 3))
    points[:, : record.vertices.shape[1]] = record.vertices
    mesh = pyvista.PolyData.from_regular_faces(points, record.faces)
    mesh.point_data["row"] = np.arange(len(points))
    extent = np.ptp(points, axis=0)
    finest, found = 4096, None
    coarsest = 1
    while finest - coarsest > 1:  # cells along the longest side; the number of vertices rises with it
        cells = (coarsest + finest) // 2
        binning = vtkBinnedDecimation()
        binning.SetInputData(mesh)
        binning.SetNumberOfDivisions(*(max(1, int(np.ceil(cells * side / extent.max()))) for side in extent))
        binning.SetPointGenerationModeToBinPoints()
        binning.ProducePointDataOn()
        binning.Update()
        fewer = pyvista.wrap(binning.GetOutput())
        if fewer.n_points <= most:
            coarsest, found = cells, fewer
        else:
            finest = cells
    if found is None:  # VTK cannot simplify it, even to one cell
        return _sampled(record, most)
    return np.asarray(found.point_data["row"]).round().astype(int), np.asarray(found.regular_faces)
