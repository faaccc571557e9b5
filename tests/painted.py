"""Surfaces and states of the tests of the studio."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from rbfevo.arrays import Points, Triangles
from rbfevo.studio.choices import Choices
from rbfevo.studio.keeping import State
from rbfevo.studio.searching import write_mesh


def ball(subdivisions: int = 3) -> tuple[Points, Triangles]:
    """An ellipsoid, symmetric about y = 0: 642 vertices with three subdivisions."""
    made = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.asarray(made.vertices, np.float64) * (1.0, 0.5, 0.35)
    return vertices, np.asarray(made.faces, np.int64)


def plate(cells: int = 20) -> tuple[Points, Triangles]:
    """A flat square from 0 to 1 in x and y, normals along z."""
    places = np.linspace(0.0, 1.0, cells + 1)
    x, y = np.meshgrid(places, places, indexing="ij")
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    i, j = (part.ravel() for part in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    a = i * (cells + 1) + j
    b, c, d = a + cells + 1, a + cells + 2, a + 1
    return vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def bump(vertices: Points, at: tuple[float, float, float], height: float = 0.05, width: float = 0.3) -> Points:
    """A displacement [n, 3] along z around a place."""
    away = np.linalg.norm(vertices - np.array(at), axis=1)
    field = np.zeros_like(vertices)
    field[:, 2] = height * np.exp(-((away / width) ** 2))
    return field


def state(choices: Choices | None = None, subdivisions: int = 3) -> State:
    """A painted ellipsoid without a front."""
    vertices, triangles = ball(subdivisions)
    held = vertices[:, 0] < -0.8
    return State("ball", vertices, triangles, bump(vertices, (0.5, 0.0, 0.3)), held, choices or Choices(centers=6))


def mesh_file(path: Path, subdivisions: int = 3) -> Path:
    """A file with the ellipsoid, and a point array `sensitivity` of one value a vertex."""
    vertices, triangles = ball(subdivisions)
    values = bump(vertices, (0.5, 0.0, 0.3))[:, 2]
    nothing = np.zeros_like(vertices), np.zeros(len(vertices), bool)
    write_mesh(path, vertices, triangles, *nothing, sensitivity=values)
    return path
