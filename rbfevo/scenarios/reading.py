"""Read a user's surface or point cloud from a file, and refuse unusable ones in one line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rbfevo.arrays import Points, Triangles
from rbfevo.errors import UserError
from rbfevo.geometry.triangles import doubled_area_vectors
from rbfevo.meshes import FormatError, Mesh, opened, refuse_bad_points, refuse_huge
from rbfevo.meshes.surface import Surface, surface_of
from rbfevo.names import existing_home


def read_surface(path: str | Path) -> tuple[Points, Triangles | None]:
    """Read vertices [n, 3] float64 and triangles [f, 3] int64, or None for a bare cloud, in the file's own units.

    The ending determines the format, one of `rbfevo.meshes.ENDINGS`. Polygons are cut into triangles; of a mesh that
    fills a volume the boundary is taken. Vertices keep the file's order; STL repeats a vertex for each triangle.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, or holds no usable surface or cloud.
    """
    path = existing_home(path)
    with opened(path) as mesh:
        refuse_points(path, mesh.points)
        found = surface(path, mesh)
        points = mesh.points
    if not len(found.triangles):
        return points, None
    extent = checked_extent(path, points)
    if np.abs(doubled_area_vectors(points / extent, found.triangles)).max() < 1e-14:
        raise UserError(f"{path}: none of its {len(found.triangles)} triangles has any area")
    return points, found.triangles


def surface(path: Path, mesh: Mesh, patches: Sequence[str] | None = None) -> Surface:
    """The surface of a mesh, as `surface_of` takes it; error messages name the file.

    Raises:
        UserError: if there is none, or not all of it can be taken.
    """
    try:
        return surface_of(mesh, patches)
    except (FormatError, UserError) as error:
        raise UserError(f"{path}: {error}") from None


def refuse_points(path: Path, points: Points) -> None:
    """Raise UserError if points [n, 3] are only one, not finite, too large or all in one place."""
    refuse_bad_points(path, points)
    if len(points) == 1:
        raise UserError(f"{path}: it has only one point; a surface or cloud needs more")
    checked_extent(path, points)


def checked_extent(path: Path | str, vertices: Points) -> float:
    """Return the longest side of the box of finite vertices [n, 3]; UserError if its square would overflow."""
    refuse_huge(path, vertices)
    extent = float(np.ptp(vertices, axis=0).max())
    if extent < 1e-100:
        raise UserError(f"{path}: all {len(vertices)} points coincide at {tuple(vertices[0].tolist())}")
    return extent
