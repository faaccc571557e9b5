"""What a brush does to the vertices that it passes: how much each of them is reached, and which way it moves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Points
from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror

ACTIONS = ("pull", "push", "erase", "hold", "release")
DIRECTIONS = ("normal", "x", "y", "z")


class Brush(NamedTuple):
    """A brush; lengths in model units.

    Attributes:
        action: `pull` moves along the direction, `push` against it, `erase` takes away what was painted, `hold` marks
            vertices that must stay, `release` unmarks them.
        radius: of the ball that it reaches, positive.
        strength: how far it moves the vertices in its middle, positive.
        edge: the share of the radius, from 0 to 1, over which its effect fades to nothing.
        direction: `normal`, each vertex along its own, or an axis.
    """

    action: str
    radius: float
    strength: float
    edge: float = 1.0
    direction: str = "normal"

    def checked(self) -> Brush:
        """The brush itself.

        Raises:
            UserError: for a number out of range or an unknown action or direction.
        """
        if self.action not in ACTIONS:
            raise UserError(f"brush: action {self.action}: choose one of {', '.join(ACTIONS)}")
        if self.direction not in DIRECTIONS:
            raise UserError(f"brush: direction {self.direction}: choose one of {', '.join(DIRECTIONS)}")
        for name, value in (("radius", self.radius), ("strength", self.strength)):
            if not 0.0 < value < np.inf:
                raise UserError(f"brush: {name} {value:g}: give a positive length")
        if not 0.0 <= self.edge <= 1.0:
            raise UserError(f"brush: edge {self.edge:g}: give a number from 0 (hard) to 1 (soft)")
        return self


class Spot(NamedTuple):
    """Where a brush touches the surface: a point [3], and the unit normal [3] there."""

    point: Array
    normal: Array


def reach(brush: Brush, distances: Array) -> Array:
    """How much vertices at these distances from the brush are reached, [q] from 0 to 1.

    1 up to (1 - edge) of the radius, then 1 - 3 t^2 + 2 t^3 with t from 0 to 1 at the radius, and 0 beyond.
    """
    width = brush.edge * brush.radius
    if width == 0.0:
        return (distances < brush.radius).astype(np.float64)
    t = np.clip((distances - (brush.radius - width)) / width, 0.0, 1.0)
    return 1.0 - t * t * (3.0 - 2.0 * t)


def reached(brush: Brush, vertices: Points, normals: Points, begin: Spot, end: Spot) -> tuple[NDArray[np.int64], Array]:
    """The vertices that a brush reaches on its straight way from one spot to another, and how much, (0, 1].

    Only the distance to the way counts, so that a stroke paints the same however many events a browser sends. Vertices
    that face away from the surface under the brush, such as those on the back of a plate, are left out.
    """
    low, high = np.minimum(begin.point, end.point) - brush.radius, np.maximum(begin.point, end.point) + brush.radius
    rows = np.flatnonzero(((vertices >= low) & (vertices <= high)).all(axis=1))
    way = end.point - begin.point
    length = float(way @ way)
    along = np.clip((vertices[rows] - begin.point) @ way / length, 0.0, 1.0) if length > 0.0 else np.zeros(len(rows))
    distances = np.linalg.norm(vertices[rows] - begin.point - along[:, None] * way, axis=1)
    facing = begin.normal + along[:, None] * (end.normal - begin.normal)
    shares = np.where((normals[rows] * facing).sum(axis=1) > 0.0, reach(brush, distances), 0.0)
    return rows[shares > 0.0], shares[shares > 0.0]


def ways(brush: Brush, normals: Points, mirror: Mirror | None = None) -> Points:
    """The displacements [q, 3] of vertices with these unit normals [q, 3] that the brush reaches wholly.

    Args:
        mirror: of the mirror image of a stroke, its plane, or None: an axis is then mirrored, too.
    """
    moved = brush.strength * (-1.0 if brush.action == "push" else 1.0)
    if brush.direction == "normal":
        return moved * normals
    axis = DIRECTIONS.index(brush.direction) - 1
    way = np.zeros((1, 3))
    way[0, axis] = -moved if mirror is not None and mirror.axis == axis else moved
    return np.repeat(way, len(normals), axis=0)


def imaged(spot: Spot, mirror: Mirror) -> Spot:
    """The mirror image of a spot."""
    flipped = spot.normal.copy()
    flipped[mirror.axis] *= -1.0
    return Spot(np.asarray(mirror.image(spot.point)), flipped)
