"""What a solver makes of a design, and the mesh of a design: one volume mesh that follows a setup."""

from __future__ import annotations

from typing import NamedTuple

from rbfevo.arrays import Array
from rbfevo.commands import doubts, volume
from rbfevo.errors import UserError
from rbfevo.meshes import Mesh
from rbfevo.meshes.faces import Between
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup


class Solution(NamedTuple):
    """What the solver makes of a design.

    Attributes:
        objective: J, minimized; sensitivity: [n, 3] dJ/dx at the vertices of the design surface.
        orthogonality, skewness: the worst of the volume mesh.
    """

    objective: float
    sensitivity: Array
    orthogonality: float
    skewness: float


class MeshError(Exception):
    """The volume mesh cannot follow a design; the solver is not run."""


def followed(mesh: Mesh, faces: Between, record: Record, chosen: Setup, weights: Array) -> Array:
    """The points [q, 3] of a mesh under weights [m, 3] of a setup, its inside carried along by the Laplacian.

    Raises:
        MeshError: if cells turn inside out, or the mesh cannot follow.
    """
    displacement = chosen.displacement(mesh.points, weights)
    try:
        moved = mesh.points + volume.carried(mesh, faces, record, chosen, displacement).displacement
    except UserError as error:
        raise MeshError(str(error)) from None
    if turned := doubts.inverted(mesh, moved):
        raise MeshError(turned)
    return moved
