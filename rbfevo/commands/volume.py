"""`--volume laplace`: the design surface moves as a setup says, and the inside of a volume mesh is carried along."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.meshes.constraints import Constraints, Plane, constraints, slip_patches
from rbfevo.meshes.faces import Between
from rbfevo.meshes.mesh import Mesh
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup

if TYPE_CHECKING:
    from rbfevo.geometry.extension import Extension

JUMP = 0.01  # of the largest displacement: a rim that moves more beside held points gets a warning
ROUNDING = 1e-6  # of the same: a point that moves less across a symmetry plane stays in it


class Carried(NamedTuple):
    """The displacement [n, 3] of a mesh's points, a line on who moves how, and what may be wrong with it.

    Attributes:
        leaving: why solvers would refuse the symmetry planes, or empty; jump: a warning about the rim, or empty.
    """

    displacement: Array
    line: str
    leaving: str
    jump: str


class Carrier(NamedTuple):
    """What carries displacements of a setup into a volume mesh.

    Attributes:
        constraints: on its points; follows: [n, 3] where a displacement is the setup's; extension: to all others.
    """

    constraints: Constraints
    follows: NDArray[np.bool_]
    extension: Extension


def carrier(
    mesh: Mesh,
    faces: Between,
    vertices: Array,
    chosen: Setup,
    design: Sequence[str] = (),
    slip: Sequence[str] = (),
) -> Carrier:
    """Prepare a volume mesh for displacements of a setup of a run with these vertices [v, 3]; arguments as `carried`.

    Raises:
        UserError: if the run or the mesh is not for it, or patches are not there.
    """
    from rbfevo.geometry.extension import Extension  # with SciPy

    if vertices.shape[1] != 3:
        raise UserError("--volume laplace carries displacements of a surface in space, and this run is on the plane")
    mirror = None if chosen.mirror is None else Plane(chosen.mirror.axis, chosen.mirror.at)
    planar = chosen.planar
    sides = [] if planar is None else [Plane(planar.axis, planar.at + s * planar.depth) for s in (-1.0, 1.0)]
    found = constraints(mesh, faces, vertices, mirror, sides, design, slip)
    follows = found.design[:, None] | (found.loose[:, None] & ~found.slip)
    return Carrier(found, follows, Extension(mesh.points, found.edges, found.fixed))


def carried(
    mesh: Mesh,
    faces: Between,
    record: Record,
    chosen: Setup,
    displacement: Array,
    design: Sequence[str] = (),
    slip: Sequence[str] = (),
) -> Carried:
    """Keep the displacements [n, 3] of a setup at the design surface, and carry them into the volume of a mesh.

    Args:
        faces: of the mesh's solid cells; design, slip: names of patches, as for `constraints`.

    Raises:
        UserError: if the run or the mesh is not for it, patches are not there, or the solver does not converge.
    """
    found, follows, extension = carrier(mesh, faces, record.vertices, chosen, design, slip)
    moved = extension(np.where(follows, displacement, 0.0))
    largest = float(np.linalg.norm(displacement[found.design], axis=1).max(initial=0.0))
    return Carried(
        moved,
        _line(mesh, found, slip),
        leaving(mesh, found, displacement, largest),
        jump(mesh, found, moved, largest),
    )


def _line(mesh: Mesh, found: Constraints, slip: Sequence[str]) -> str:
    """How many points move as the setup says, slide, are held, and are carried along."""
    patches = slip_patches(mesh, slip)
    sliding = found.slip.any(axis=1) & ~found.design
    where = f" (patch {', '.join(patches)})" if patches else ""
    inside = len(mesh.points) - int((found.design | sliding | found.held | found.loose).sum())
    loose = f", {int(found.loose.sum())} in no solid cell move as the setup says" if found.loose.any() else ""
    return (
        f"the {int(found.design.sum())} points of the design surface move as the setup says, {int(found.held.sum())} "
        f"others of the boundary are held, {int(sliding.sum())} slide in symmetry planes{where}, {inside} inside are "
        f"carried along{loose}"
    )


def leaving(mesh: Mesh, found: Constraints, displacement: Array, largest: float) -> str:
    """How many points of the design surface leave a symmetry plane, and what to do; empty if none does."""
    across = np.where(found.slip & found.design[:, None], np.abs(displacement), 0.0)
    bad = across.max(axis=1) > ROUNDING * largest
    if not bad.any():
        return ""
    axis = "xyz"[int(across.max(axis=0).argmax())]
    return (
        f"{int(bad.sum())} points of the design surface leave a symmetry plane of the mesh, by up to "
        f"{across.max():.4g} along {axis}: set scenario.symmetry={axis} (of a slab scenario.planar={axis}) in the run, "
        "or hold them"
    )


def jump(mesh: Mesh, found: Constraints, moved: Array, largest: float) -> str:
    """How far points of the design surface beside held ones move, and what to do; empty if they hardly do."""
    edges = np.concatenate([found.rim, found.rim[:, ::-1]])
    edges = edges[found.design[edges[:, 0]] & found.held[edges[:, 1]]]
    length = np.linalg.norm(moved[edges[:, 0]], axis=1)
    bad = length > JUMP * largest
    if not bad.any():
        return ""
    share = float((length / np.linalg.norm(mesh.points[edges[:, 0]] - mesh.points[edges[:, 1]], axis=1)).max())
    return (
        f"{len(np.unique(edges[bad, 0]))} points at the rim of the design surface move by up to {length.max():.4g}, "
        f"{share:.2g} times the edge to points of the boundary that are held: the other patches are bent there; hold "
        "the rim in the run (scenario.hold), or let a plane patch slide (--slip PATCH)"
    )
