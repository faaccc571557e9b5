"""Which points of a volume mesh follow a setup, which are held, and which slide, while the inside is carried along.

- *design*: the points of the design surface, those of some patches or those that are vertices of a run's template.
- *slip*: boundary points in symmetry planes, which slide in them: their component across the plane is 0.
- *held*: all other points of the boundary.
- *loose*: points of no solid cell, which the inside of the mesh does not reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Ints
from rbfevo.errors import UserError
from rbfevo.meshes import cells
from rbfevo.meshes.faces import Between, alike, corners_of, edges_of
from rbfevo.meshes.mesh import Cells, Mesh
from rbfevo.meshes.surface import patch_cells, shown

SLIP_TYPES = ("symmetryPlane", "symmetry", "empty", "wedge")  # OpenFOAM's
CLOSE = 1e-6  # of the template's diagonal: a boundary point is a vertex of the template, or lies in a plane
SINGLE = 2.0 * float(np.finfo(np.float32).eps)  # of the farthest coordinate: what files with float32 round

Mask = NDArray[np.bool_]


class Plane(NamedTuple):
    """The plane on which coordinate `axis` is `at`."""

    axis: int
    at: float


class Constraints(NamedTuple):
    """The constraints on the points [n] of a volume mesh.

    Attributes:
        design, held, loose: [n]; slip: [n, 3] True for the axes across which a point's plane lies.
        edges, rim: [e, 2] the edges of all cells, and those of the boundary, each once.
    """

    design: Mask
    slip: Mask
    held: Mask
    loose: Mask
    edges: Ints
    rim: Ints

    @property
    def fixed(self) -> Mask:
        """[n, 3] which components are given: all of design, held and loose points, those across a plane of others."""
        return self.slip | (self.design | self.held | self.loose)[:, None]


def solid_faces(mesh_cells: Cells) -> Between:
    """The faces of the solid cells of a mesh.

    Raises:
        UserError: if there are none, or cells of unknown kinds or of second order.
    """
    found, counted = cells.solids(mesh_cells), cells.counts(mesh_cells)
    if not found:
        listed = ", ".join(f"{count} {name}" for name, count in counted.items()) or "only points"
        raise UserError(f"--volume laplace needs cells that fill a volume, but there are {listed}; use --volume rbf")
    bad = {name: found[name] for name in ("prisms",) if name in found}
    bad |= {name: count for name, count in counted.items() if name == "cells of an unknown kind"}
    faceless = found.get("polyhedra", 0) - (0 if mesh_cells.faces is None else len(np.unique(mesh_cells.faces.cell)))
    bad |= {"polyhedra without faces": faceless} if faceless else {}
    solid = np.isin(mesh_cells.kinds, [kind for kinds in cells.SOLIDS.values() for kind in kinds])
    curved = cells.curved(Cells(mesh_cells.kinds[solid], mesh_cells.sizes[solid], mesh_cells.corners))
    bad |= {"second-order cells": curved} if curved else {}
    if bad:
        listed = ", ".join(f"{count} {name}" for name, count in bad.items())
        raise UserError(f"--volume laplace does not know the edges of {listed}; use --volume rbf")
    return Between.of(cells.faces_of(mesh_cells))


def constraints(
    mesh: Mesh,
    faces: Between,
    vertices: Array,
    mirror: Plane | None = None,
    sides: Sequence[Plane] = (),
    design: Sequence[str] = (),
    slip: Sequence[str] = (),
) -> Constraints:
    """The constraints on a volume mesh that a run deforms.

    Args:
        faces: of its cells, by `solid_faces`.
        vertices: [v, 3] of the run's template; mirror: its symmetry plane; sides: the two of the slab of a planar run.
        design: patches of the design surface; without, it is the boundary points that are vertices of the template.
        slip: patches that slide besides those of a sliding type; where the mesh has no types, boundary faces in the
            run's planes slide too.

    Raises:
        UserError: if a patch or the design surface is not there, or if a patch that slides does not lie in planes
            across x, y or z.
    """
    both = sorted(set(design) & set(slip))
    if both:
        raise UserError(f"--design and --slip both name {', '.join(both)}: a patch either moves or slides")
    n, outer = len(mesh.points), cells.polygons_of(faces.sizes, faces.corners, faces.outer)
    tolerance = CLOSE * float(np.linalg.norm(np.ptp(vertices, axis=0))) + SINGLE * float(np.abs(mesh.points).max())
    places = _places(mesh.cells, outer)
    if design:
        moving = _among(n, *(_corners(outer, _on_boundary(mesh, places, name, "--design")) for name in design))
    else:
        index = np.unique(outer.corners)
        moving = _among(n, index[_of_template(mesh, mesh.points[index], vertices, mirror, tolerance)])
    axis = np.full(len(outer), -1)  # across which a boundary face slides
    if not mesh.patch_types:
        for plane in (*sides, *([] if mirror is None else [mirror])):
            away = np.abs(mesh.points[outer.corners, plane.axis] - plane.at)
            axis[np.maximum.reduceat(away, _starts(outer)) <= tolerance] = plane.axis
    for name in slip_patches(mesh, slip):
        chosen = _on_boundary(mesh, places, name, "--slip")
        axis[chosen] = _axes(mesh.points, outer, chosen, name, tolerance)
    held = _among(n, _corners(outer, np.flatnonzero(axis < 0))) & ~moving
    sliding = np.zeros((n, 3), bool)
    for across in range(3):
        sliding[:, across] = _among(n, _corners(outer, np.flatnonzero(axis == across)))
    sliding[held] = False
    loose = ~_among(n, faces.corners) & ~moving
    edges, rim = edges_of(faces.sizes, faces.corners), edges_of(outer.sizes, outer.corners)
    return Constraints(moving, sliding, held, loose, edges, rim)


def slip_patches(mesh: Mesh, named: Sequence[str] = ()) -> list[str]:
    """The patches that slide: those of a sliding type that have faces, and those that were named."""
    typed = [name for name, kind in mesh.patch_types.items() if kind in SLIP_TYPES and len(mesh.patches.get(name, ()))]
    return [*typed, *(name for name in dict.fromkeys(named) if name not in typed)]


def _among(count: int, *indices: Ints) -> Mask:
    """[count] True at the given indices."""
    mask = np.zeros(count, bool)
    for index in indices:
        mask[index] = True
    return mask


def _starts(polygons: Cells) -> Ints:
    return np.cumsum(polygons.sizes) - polygons.sizes


def _corners(polygons: Cells, chosen: Ints) -> Ints:
    """The corners of some polygons."""
    return corners_of(polygons.sizes, polygons.corners, chosen)


def _places(mesh_cells: Cells, outer: Cells) -> Ints:
    """[c] the boundary face that each of the mesh's cells is, -1 for a cell that is none."""
    flat = np.isin(mesh_cells.kinds, cells.FLAT)
    of = np.repeat(flat, mesh_cells.sizes)
    sizes = np.concatenate([outer.sizes, mesh_cells.sizes[flat]])
    number = alike(sizes, np.concatenate([outer.corners, mesh_cells.corners[of]]))
    face = np.full(int(number.max(initial=0)) + 1, -1)
    face[number[: len(outer)]] = np.arange(len(outer))
    places = np.full(len(mesh_cells), -1)
    places[flat] = face[number[len(outer) :]]
    return places


def _on_boundary(mesh: Mesh, places: Ints, name: str, option: str) -> Ints:
    """The boundary faces of a patch."""
    chosen = places[patch_cells(mesh, [name], option)]
    if not (chosen >= 0).any():
        raise UserError(f"{option}={name}: none of its {len(chosen)} cells is a face of the mesh's boundary")
    return chosen[chosen >= 0]


def _axes(points: Array, outer: Cells, chosen: Ints, name: str, tolerance: float) -> Ints:
    """The axis across which each chosen boundary face lies flat."""
    place, starts = points[outer.corners], _starts(outer)
    extent = (np.maximum.reduceat(place, starts) - np.minimum.reduceat(place, starts))[chosen]
    inclined = int((extent.min(axis=1) > tolerance).sum())
    if inclined:
        raise UserError(
            f"{inclined} of {len(chosen)} faces of the symmetry patch {name} are not in a plane across x, y or z, and "
            "points can slide only in such planes; turn the mesh and the run, or use --volume rbf"
        )
    return extent.argmin(axis=1)


def _of_template(mesh: Mesh, boundary: Array, vertices: Array, mirror: Plane | None, tolerance: float) -> Mask:
    """Which boundary points [b, 3] are vertices of the template, or mirror images where it is one half of a body."""
    from scipy.spatial import KDTree

    wanted = vertices
    if mirror is not None:
        axis, at = mirror
        sides = [
            (values.min() < at - tolerance, values.max() > at + tolerance)
            for values in (vertices[:, axis], boundary[:, axis])
        ]
        if not all(sides[0]):
            image = vertices.copy()
            image[:, axis] = 2.0 * at - vertices[:, axis]
            wanted = np.concatenate([vertices, image])
        below, above = sides[1]
        away = wanted[:, axis] - at
        wanted = wanted[(below | (away >= -tolerance)) & (above | (away <= tolerance))]  # of half a mesh, its half
    distance, nearest = KDTree(boundary).query(wanted, distance_upper_bound=tolerance)
    there = np.isfinite(distance)
    if not there.all() or not len(there):
        missing = f"{int((~there).sum())} of the {len(there)}" if there.any() else f"all {len(there)}"
        hint = "take the template from this mesh"  # which names no patches
        if mesh.patches:
            hint = f"name the patches of the design surface (--design PATCH; there are {shown(mesh.patches)})"
        if "case" in mesh.notes:
            hint = f"if the case has moved since the run, give --mesh an earlier time, such as CASE/0; if not, {hint}"
        else:
            hint = f"if so, {hint}"
        hint = hint[0].upper() + hint[1:]
        raise UserError(
            f"its boundary lacks {missing} vertices of the run's template, so which of its points are the design "
            f"surface is not known: is it in the place and unit of the run? {hint}, or use --volume rbf"
        )
    # Points that coincide move together.
    number = np.unique(boundary, axis=0, return_inverse=True)[1].reshape(-1)
    return np.isin(number, number[nearest])
