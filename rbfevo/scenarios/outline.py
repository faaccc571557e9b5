"""Curves as planar designs and as targets of planar designs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints, Points, Triangles
from rbfevo.geometry import curves
from rbfevo.geometry.planar import Plane
from rbfevo.meshes import opened
from rbfevo.names import existing_home
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.templates import curve_of, curve_template


class Outline(NamedTuple):
    """A curve as a design.

    Attributes:
        segments: [s, 2], one after another; turned: how many had to be turned for that.
        normals: [n, 3] unit normals of the vertices, in the plane; lengths: [n] of the curve about each vertex.
        surface: [2n, 3], [2s, 3] the strip that it sweeps along the axis; notes: on its oddities.
    """

    segments: Ints
    turned: int
    normals: Points
    lengths: Array
    surface: tuple[Points, Triangles]
    notes: dict[str, str]


def outline(vertices: Points, segments: Ints, plane: Plane) -> Outline:
    """A curve of vertices [n, 3] and segments [s, 2] in a plane as a design."""
    places, normals = vertices[:, plane.others], np.zeros(vertices.shape)
    found, turned = curves.oriented(places, segments)
    normals[:, plane.others] = curves.normals(places, found)
    return Outline(
        found,
        turned,
        normals,
        curves.vertex_lengths(vertices, found),
        _strip(vertices, found, plane),
        curves.oddities(places, found),
    )


def target_curve(path: str, plane: Plane) -> tuple[Points, Triangles] | None:
    """The strip [2q, 3], [2s, 3] that the curve in a file sweeps along the axis; None if it holds no curve.

    Raises:
        UserError: if the file is unreadable, or its curve does not lie in one plane across the axis.
    """
    place = existing_home(path)
    with opened(place) as mesh:
        pass
    lines = curve_of(place, mesh)
    if lines is None:
        return None
    found = curve_template(place, mesh, lines)
    Planar.of(plane.name, found.vertices, curve=True)
    return _strip(found.vertices, found.segments, plane)


def _strip(vertices: Points, segments: Ints, plane: Plane) -> tuple[Points, Triangles]:
    """The strip of a curve, as wide as the curve is long, so that no triangle is thin."""
    width = float(np.ptp(vertices[:, plane.others], axis=0).max())
    return curves.strip(vertices, segments, plane.axis, 0.5 * width)
