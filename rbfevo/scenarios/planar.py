"""Planar designs: slabs one cell thick, and shapes in one plane, whose displacements have two components."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from rbfevo.arrays import Array, Ints, Points, Triangles
from rbfevo.errors import UserError
from rbfevo.geometry.lengths import length, number_or_percentage
from rbfevo.geometry.pairing import Pairing
from rbfevo.geometry.planar import LAYER, Plane, layers
from rbfevo.geometry.triangles import doubled_area_vectors

Mask = NDArray[np.bool_]
NOTED = 1e-9  # of |g|^2: a smaller share is rounding


@dataclasses.dataclass(frozen=True)
class Planar:
    """The mid-plane of a planar design of n vertices, and the partner [n] of each on the other side.

    Of a design in one plane, a curve or a flat area, every vertex is its own partner.
    """

    plane: Plane
    partner: Ints

    @staticmethod
    def of(axis: Any, vertices: Points, curve: bool = False) -> Planar | None:
        """What `scenario.planar` asks for vertices [n, 3] of a surface or a curve; None where it is null.

        Vertices within 1e-6 of the diagonal of each other along the axis are in one layer; front and back match within
        the same distance.

        Raises:
            UserError: for another axis, more than two layers, or front and back with different vertices.
        """
        if axis is None:
            return None
        if axis not in ("x", "y", "z"):
            raise UserError(f"scenario.planar={axis}: choose x, y or z, the axis across the plane, or null")
        number = "xyz".index(axis)
        diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        tolerance = LAYER * diagonal
        heights = vertices[:, number]
        found = layers(heights, tolerance)
        if curve and len(found) > 1:
            raise UserError(
                f"scenario.planar={axis}: the vertices of the curve lie in {len(found)} layers across {axis}, but a "
                "planar curve lies in one plane; choose another axis, or a mesh with faces"
            )
        if len(found) > 2:
            raise UserError(
                f"scenario.planar={axis}: the vertices lie in {len(found)} layers across {axis}; a planar design has "
                "two, front and back of a slab one cell thick, or one; choose another axis, or null"
            )
        if len(found) == 1:
            plane = Plane(number, found[0])
            others = vertices[:, plane.others]
            if not np.ptp(others, axis=0).all():
                raise UserError(f"scenario.planar={axis}: all vertices lie on one line across {axis}")
            return Planar(plane, np.arange(len(vertices)))
        plane = Plane.between(number, *found)
        partner, lonely = _partners(vertices[:, plane.others], heights > plane.at, tolerance)
        if lonely:
            raise UserError(
                f"scenario.planar={axis}: {lonely} of {len(vertices)} vertices have no vertex opposite to them on the "
                f"other side, within 1e-6 of the diagonal ({tolerance:.3g}); a slab has the same vertices on both"
            )
        return Planar(plane, partner)

    @property
    def note(self) -> str:
        """What the design is, in a line."""
        name, at, depth = self.plane.name, self.plane.at, self.plane.depth
        shape = f"a slab {2.0 * depth:.4g} thick, whose front and back move alike" if depth else "in one plane"
        return f"the design is {shape}; centers lie in the plane {name} = {at:g}, and nothing moves along {name}"

    def averaged(self, values: Array) -> Array:
        """Values [n] or [n, k] of which front and back both take the mean."""
        return 0.5 * (values + values[self.partner])

    def either(self, marks: Mask) -> Mask:
        """Marks [n] that front and back both have where one of them has it."""
        return marks | marks[self.partner]

    def normals(self, vertices: Points, triangles: Triangles) -> Points:
        """Unit normals [n, 3] in the plane, the same for front and back; zero where there is none.

        Each triangle counts by its area at both vertices of a pair, however its quadrilateral was cut.
        """
        vectors = self.plane.flat(doubled_area_vectors(vertices / (float(np.abs(vertices).max()) or 1.0), triangles))
        pair = np.minimum(np.arange(len(vertices)), self.partner)[triangles]
        sums = np.zeros((len(vertices), 3))
        for corners in pair.T:
            np.add.at(sums, corners, vectors)
        lowest = np.minimum(np.arange(len(vertices)), self.partner)
        return _unit(sums[lowest])

    def wanted(self, wanted: Points, weights: Array) -> tuple[Points, dict[str, str]]:
        """A wanted displacement [n, 3] without its component along the axis, the same for front and back; notes.

        Raises:
            UserError: if nothing is left.
        """
        scale = float(np.abs(wanted).max(initial=0.0)) or 1.0
        square = weights[:, None] * (wanted / scale) ** 2
        total, axis, name = float(square.sum()), self.plane.axis, self.plane.name
        flat = self.plane.flat(wanted)
        found = self.averaged(flat)
        if not found.any():
            raise UserError(
                f"scenario.planar={name}: the wanted displacement has no component across {name} that front and back "
                "have in common"
            )
        notes = {}
        dropped = float(square[:, axis].sum()) / total
        if dropped > NOTED:
            notes["planar component"] = f"the component along {name} is left out, {dropped:.3%} of |g|^2"
        apart = float((weights[:, None] * ((flat - found) / scale) ** 2).sum()) / total
        if apart > NOTED:
            notes["planar difference"] = (
                f"front and back of the slab want different displacements and take their mean; {apart:.3%} of |g|^2 is "
                "lost with it"
            )
        return found, notes

    def support(self, value: Any, diagonal: float) -> float:
        """The support radius of `scenario.support`: a percentage is of the diagonal [model units] in the plane.

        It is the reach within the plane, so that the radius of a thick slab is larger.

        Raises:
            UserError: unless it is positive.
        """
        found = length("scenario.support", value, diagonal)
        return math.hypot(found, self.plane.depth) if number_or_percentage(value)[1] else found

    def target(self, name: str, points: Points, triangles: Triangles | None) -> tuple[Points, Triangles | None]:
        """The target of this name as the mid-plane meets it: a slab without front and back, a cloud within the plane.

        Closest points of the mid-plane then lie on the outline of the target.

        Raises:
            UserError: if the target does not cross its own middle along the axis.
        """
        axis = self.plane.axis
        placed = points.copy()
        if triangles is None:
            placed[:, axis] = self.plane.at
            return placed, None
        low, high = float(points[:, axis].min()), float(points[:, axis].max())
        placed[:, axis] += self.plane.at - 0.5 * (low + high)
        heights = points[triangles, axis]
        around = np.ptp(heights, axis=1) > LAYER * float(np.linalg.norm(np.ptp(points, axis=0)))
        if not around.any():
            raise UserError(
                f"{name}: the target lies in one plane across {self.plane.name}; a planar design needs a slab, a curve "
                "or a cloud"
            )
        return placed, triangles[around]

    def kept_in_plane(self, pairing: Pairing) -> Pairing:
        """Pairs of vertices that were moved into the plane, whose closest points then keep each point's own height."""
        axis, query = self.plane.axis, pairing.query

        def closest(points: Points) -> tuple[Points, Ints]:
            """The closest points [q, 3] of points [q, 3] within the plane, and their triangles [q]."""
            found, triangle = query(self.plane.pinned(points))
            found = found.copy()
            found[:, axis] = points[:, axis]
            return found, triangle

        return pairing._replace(displacement=self.plane.flat(pairing.displacement), query=closest)


def _partners(places: Points, front: Mask, tolerance: float) -> tuple[Ints, int]:
    """The vertex on the other side of each of the places [n, 2], and how many have none.

    Of several in one place the first on the one side belongs to the first on the other.
    """
    n = len(places)
    links = KDTree(places).query_pairs(tolerance, output_type="ndarray")
    graph = coo_array((np.ones(len(links), bool), (links[:, 0], links[:, 1])), shape=(n, n))
    place = np.asarray(connected_components(graph, directed=False)[1], np.int64)
    counts = np.stack([np.bincount(place[side], minlength=place.max() + 1) for side in (front, ~front)])
    lonely = int(np.abs(counts[0] - counts[1]).sum())
    partner = np.arange(n)
    if not lonely:
        one, other = (np.flatnonzero(side) for side in (front, ~front))
        one, other = (rows[np.argsort(place[rows], kind="stable")] for rows in (one, other))
        partner[one], partner[other] = other, one
    return partner, lonely


def _unit(vectors: Points) -> Points:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.0)
