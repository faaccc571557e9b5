"""A mesh with what a designer has painted on it: where it should move, what must stay, and how to undo that."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Points, Triangles
from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.geometry.mirror import Mirror
from rbfevo.studio.brush import Brush, Spot, imaged, reached, ways

REMEMBERED = 200  # strokes that can be undone
EQUAL = 1e-9  # shares of a stroke and of its mirror image that differ by less


class Change(NamedTuple):
    """What a stroke has changed: rows [q], and the field [q, 3] and held marks [q] of these before and after."""

    rows: NDArray[np.int64]
    before: tuple[Points, NDArray[np.bool_]]
    after: tuple[Points, NDArray[np.bool_]]


@dataclasses.dataclass
class _Stroke:
    """A stroke that is not at its end: how much it has reached each vertex so far, [n], and by its mirror image."""

    brush: Brush
    field: Points
    held: NDArray[np.bool_]
    shares: Array
    images: Array
    last: Spot | None = None


class Painting:
    """The wanted displacement of a surface, and the vertices that must stay, as they are painted.

    Args:
        vertices: [n, 3] model units; triangles: [f, 3], wound alike.
        field: [n, 3] the wanted displacement to begin with, model units; None for none.
        held: [n] bool, the vertices that must stay to begin with; None for none.

    Attributes:
        field, held: as they are now; normals: [n, 3] unit normals of the vertices; diagonal: of the bounding box.

    Raises:
        UserError: if the arrays do not match the surface, or have values that are not finite.
    """

    def __init__(
        self,
        vertices: Points,
        triangles: Triangles,
        field: Points | None = None,
        held: NDArray[np.bool_] | None = None,
    ) -> None:
        self.vertices, self.triangles = vertices, triangles
        self.field = np.zeros_like(vertices) if field is None else np.array(field, np.float64)
        self.held = np.zeros(len(vertices), bool) if held is None else np.array(held, bool)
        if self.field.shape != vertices.shape or self.held.shape != (len(vertices),):
            raise UserError(f"the painted field has {len(self.field)} rows, and the mesh {len(vertices)} vertices")
        if not np.isfinite(self.field).all():
            raise UserError("the painted field has values that are not finite")
        self.normals = topology.vertex_normals(vertices, triangles)
        self.diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        self._done: list[Change] = []
        self._undone: list[Change] = []
        self._stroke: _Stroke | None = None

    @property
    def empty(self) -> bool:
        """Whether no vertex that may move should move."""
        return not self.field[~self.held].any()

    @property
    def undoable(self) -> int:
        """Strokes that can be undone; `redoable`: those that can be done again."""
        return len(self._done)

    @property
    def redoable(self) -> int:
        """Strokes that can be done again."""
        return len(self._undone)

    def begin(self, brush: Brush) -> None:
        """Begin a stroke.

        Raises:
            UserError: as `Brush.checked`.
        """
        if self._stroke is not None:
            self.end()
        zeros = np.zeros(len(self.vertices))
        self._stroke = _Stroke(brush.checked(), self.field.copy(), self.held.copy(), zeros, zeros.copy())

    def touch(self, spot: Spot | None, mirror: Mirror | None = None) -> NDArray[np.int64]:
        """Go on with the stroke to a spot, or lift the brush where there is none; return the vertices that changed.

        Args:
            mirror: paint the mirror image of the stroke in this plane, too.
        """
        stroke = self._stroke
        if stroke is None:
            return np.empty(0, np.int64)
        last, stroke.last = stroke.last, spot
        if spot is None:
            return np.empty(0, np.int64)
        begin = spot if last is None else last
        rows, shares = reached(stroke.brush, self.vertices, self.normals, begin, spot)
        more = shares > stroke.shares[rows]
        rows = rows[more]
        stroke.shares[rows] = shares[more]
        if mirror is not None:
            ends = imaged(begin, mirror), imaged(spot, mirror)
            others, shares = reached(stroke.brush, self.vertices, self.normals, *ends)
            more = shares > stroke.images[others]
            stroke.images[others[more]] = shares[more]
            rows = np.union1d(rows, others[more])
        self._paint(stroke, rows, mirror)
        return rows

    def _paint(self, stroke: _Stroke, rows: NDArray[np.int64], mirror: Mirror | None) -> None:
        """Let vertices have what the stroke makes of what they had before it."""
        action, own, image = stroke.brush.action, stroke.shares[rows], stroke.images[rows]
        share = np.maximum(own, image)
        if action == "hold":
            self.held[rows] = stroke.held[rows] | (share > 0.0)
        elif action == "release":
            self.held[rows] = stroke.held[rows] & ~(share > 0.0)
        elif action == "erase":
            self.field[rows] = (1.0 - share)[:, None] * stroke.field[rows]
        else:
            normals = self.normals[rows]
            nearer = np.where(np.abs(own - image) < EQUAL, 0.5, own > image)[:, None]  # on the plane both count
            way = nearer * ways(stroke.brush, normals) + (1.0 - nearer) * ways(stroke.brush, normals, mirror)
            self.field[rows] = stroke.field[rows] + share[:, None] * way

    def end(self) -> bool:
        """End the stroke; return whether it has changed anything."""
        stroke, self._stroke = self._stroke, None
        return stroke is not None and self._remember(stroke.field, stroke.held)

    def replace(self, field: Points | None = None, held: NDArray[np.bool_] | None = None) -> bool:
        """Put a whole field [n, 3] or all held marks [n] in the place of what is painted; return whether it differs."""
        self.end()
        before = self.field, self.held
        self.field = self.field.copy() if field is None else np.array(field, np.float64)
        self.held = self.held.copy() if held is None else np.array(held, bool)
        return self._remember(*before)

    def _remember(self, field: Points, held: NDArray[np.bool_]) -> bool:
        """Keep what differs from an earlier field and held marks, so that it can be undone."""
        rows = np.flatnonzero((self.field != field).any(axis=1) | (self.held != held))
        if not len(rows):
            return False
        after = self.field[rows].copy(), self.held[rows].copy()
        self._done = [*self._done[1 - REMEMBERED :], Change(rows, (field[rows].copy(), held[rows].copy()), after)]
        self._undone = []
        return True

    def undo(self) -> bool:
        """Undo the last stroke; return whether there was one."""
        self.end()
        if not self._done:
            return False
        change = self._done.pop()
        self._undone.append(change)
        self.field[change.rows], self.held[change.rows] = change.before
        return True

    def redo(self) -> bool:
        """Do the last stroke that was undone again; return whether there was one."""
        self.end()
        if not self._undone:
            return False
        change = self._undone.pop()
        self._done.append(change)
        self.field[change.rows], self.held[change.rows] = change.after
        return True
