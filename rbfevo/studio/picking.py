"""From a place on the screen to the mesh: rays of a camera, what they hit, and how far a pointer drags a point."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np

from rbfevo.arrays import Array, Points, Triangles
from rbfevo.errors import UserError
from rbfevo.meshes.vtk_datasets import polydata
from rbfevo.studio.brush import Spot

FAR = 1e3  # lengths of a ray, in diagonals of the surface


class Camera(NamedTuple):
    """A camera as a browser describes it.

    Attributes:
        position, focal_point, view_up: [3]; angle: vertical, degrees; parallel: whether it has no perspective, and then
            `scale` is half the height of what it sees, model units; aspect: width over height.
    """

    position: Array
    focal_point: Array
    view_up: Array
    angle: float
    parallel: bool
    scale: float
    aspect: float

    @staticmethod
    def of(sent: Any, aspect: float) -> Camera:
        """The camera that a page has sent.

        Raises:
            UserError: if it is none, or has numbers that no camera has.
        """
        try:
            position, focal, up = (
                np.array(sent[key], np.float64).reshape(3) for key in ("position", "focalPoint", "viewUp")
            )
            made = Camera(
                position,
                focal,
                up,
                float(sent["viewAngle"]),
                bool(sent["parallelProjection"]),
                float(sent["parallelScale"]),
                float(aspect),
            )
        except (KeyError, TypeError, ValueError):
            raise UserError("the page sent no camera") from None
        numbers = np.concatenate([position, focal, up, [made.angle, made.scale, made.aspect]])
        upright = float(np.linalg.norm(np.cross(made.focal_point - made.position, made.view_up)))
        if not np.isfinite(numbers).all() or not (made.aspect > 0.0 and 0.0 < made.angle < 180.0 and upright > 0.0):
            raise UserError("the page sent a camera that sees nothing")
        return made

    @property
    def axes(self) -> tuple[Array, Array, Array]:
        """Unit vectors [3] to the right, up, and forwards."""
        forwards = self.focal_point - self.position
        forwards = forwards / np.linalg.norm(forwards)
        right = np.cross(forwards, self.view_up)
        right = right / np.linalg.norm(right)
        return right, np.cross(right, forwards), forwards

    def ray(self, x: float, y: float) -> tuple[Array, Array]:
        """Origin [3] and unit direction [3] of the ray at a place: (0, 0) is the upper left corner, (1, 1) the last."""
        right, up, forwards = self.axes
        across, upwards = self.aspect * (2.0 * x - 1.0), 1.0 - 2.0 * y
        if self.parallel:
            return self.position + self.scale * (across * right + upwards * up), forwards
        half = np.tan(np.radians(self.angle) / 2.0)
        direction = forwards + half * (across * right + upwards * up)
        return self.position, direction / np.linalg.norm(direction)

    def places(self, points: Points) -> Points:
        """Where points [q, 3] are on the screen, [q, 2] as `ray` takes them; NaN behind the camera."""
        right, up, forwards = self.axes
        away = points - self.position
        depth = away @ forwards
        half = np.full(len(points), self.scale) if self.parallel else np.tan(np.radians(self.angle) / 2.0) * depth
        half[depth <= 0.0] = np.nan
        return np.column_stack([1.0 + away @ right / (half * self.aspect), 1.0 - away @ up / half]) / 2.0

    def dragged(self, point: Array, x: float, y: float) -> Array:
        """Where a point [3] lies after it was dragged to a place on the screen, at its own depth."""
        origin, direction = self.ray(x, y)
        forwards = self.axes[2]
        return origin + direction * float((point - origin) @ forwards) / float(direction @ forwards)


class Surface:
    """Triangles [f, 3] of vertices [n, 3] that rays can hit."""

    def __init__(self, vertices: Points, triangles: Triangles) -> None:
        from vtkmodules.vtkCommonDataModel import vtkGenericCell, vtkStaticCellLocator

        self._dataset = polydata(vertices, triangles, {})
        self._reach = FAR * (float(np.linalg.norm(np.ptp(vertices, axis=0))) or 1.0)
        self._corners = vertices, triangles
        self._cell, self._locator = vtkGenericCell(), vtkStaticCellLocator()
        self._locator.SetDataSet(self._dataset)
        self._locator.BuildLocator()

    def hit(self, origin: Array, direction: Array) -> Spot | None:
        """The first point that a ray meets, and the normal of its triangle as it is wound; None where it meets none."""
        from vtkmodules.vtkCommonCore import reference

        t, sub, cell = (cast(Any, reference(value)) for value in (0.0, 0, 0))
        point, parametric = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        end = origin + self._reach * direction
        if not self._locator.IntersectWithLine(
            origin.tolist(), end.tolist(), 0.0, t, point, parametric, sub, cell, self._cell
        ):
            return None
        vertices, triangles = self._corners
        a, b, c = vertices[triangles[int(cell)]]
        normal = np.cross(b - a, c - a)
        size = float(np.linalg.norm(normal))
        return Spot(np.array(point), -direction if size == 0.0 else normal / size)
