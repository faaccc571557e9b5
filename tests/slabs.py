"""Slabs one cell thick about an ellipse: their surface, their volume, and the same in the plane."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv

THICK = 0.1
HALVES = (2.0, 1.0)  # of the ellipse


def ring(count: int, scale: float = 1.0) -> np.ndarray:
    """Points [count, 2] of the ellipse, counterclockwise, symmetric about both axes to the bit."""
    angle = 2.0 * np.pi * (np.arange(count // 4 + 1)) / count
    x, y = HALVES[0] * np.cos(angle), HALVES[1] * np.sin(angle)
    x[-1] = y[0] = 0.0
    quarter = np.stack([x, y], axis=1)
    upper = np.concatenate([quarter, (quarter * (-1, 1))[-2::-1]])
    return scale * np.concatenate([upper, (upper * (1, -1))[-2:0:-1]])


def lifted(flat: np.ndarray, axis: int, height: float) -> np.ndarray:
    """Points [n, 3] of points [n, 2] at a height along an axis, the other two in right-handed order."""
    points = np.full((len(flat), 3), height)
    points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = flat.T
    return points


def strip(count: int, axis: int = 2, heights: tuple[float, float] = (0.0, THICK)) -> Any:
    """The closed strip of quadrilaterals about the ellipse, normals outwards; back (low) vertices first."""
    flat = ring(count)
    points = np.concatenate([lifted(flat, axis, height) for height in heights])
    here = np.arange(count)
    following = (here + 1) % count
    quads = np.stack([here, following, following + count, here + count], axis=1)
    return pv.PolyData(points, np.hstack([np.full((count, 1), 4), quads]).ravel())


def saved(surface: pv.DataSet, path: Path, **arrays: np.ndarray) -> Path:
    """A file with a surface and point arrays."""
    for name, values in arrays.items():
        surface.point_data[name] = values
    surface.save(path)
    return path


def volume(count: int, rows: int = 4, heights: tuple[float, float] = (0.0, THICK)) -> pv.UnstructuredGrid:
    """Hexahedra in one layer from the ellipse outwards, `rows` of them."""
    scales = np.linspace(1.0, 2.0, rows + 1)
    points = np.concatenate([lifted(ring(count, scale), 2, height) for height in heights for scale in scales])
    half = count * (rows + 1)
    whole = []
    for j in range(rows):
        for i in range(count):
            following = (i + 1) % count
            corners = [j * count + i, (j + 1) * count + i, (j + 1) * count + following, j * count + following]
            whole.append([8, *corners, *(half + corner for corner in corners)])
    return pv.UnstructuredGrid(np.ravel(whole), np.full(len(whole), 12), points)
