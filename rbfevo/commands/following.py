"""A mesh that follows a setup: its displacement, whether a solver can use it, and its quality."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from rbfevo import meshes
from rbfevo.arrays import Array
from rbfevo.commands import doubts, volume
from rbfevo.errors import UserError
from rbfevo.meshes.cells import solids
from rbfevo.meshes.constraints import solid_faces
from rbfevo.meshes.faces import Between
from rbfevo.meshes.quality import Quality, qualities
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup

TURNED_OVER = 90.0  # degrees of non-orthogonality


class Follower:
    """A mesh that follows a setup of a run.

    Args:
        path: the mesh's file, for messages; mesh: as it was read; record, chosen: the run and its setup.
        way: `rbf` or `laplace`, None for laplace where there are solid cells; design, slip: patches, for laplace.

    Raises:
        UserError: if the mesh cannot follow in this way.
    """

    def __init__(
        self,
        path: Path,
        mesh: meshes.Mesh,
        record: Record,
        chosen: Setup,
        way: str | None = None,
        design: Sequence[str] = (),
        slip: Sequence[str] = (),
    ) -> None:
        meshes.refuse_bad_points(path, mesh.points)
        self.path, self.mesh, self.record, self.chosen = path, mesh, record, chosen
        self.way = way or ("laplace" if solids(mesh.cells) else "rbf")
        if self.way != "laplace" and (design or slip):
            raise UserError(f"--{'design' if design else 'slip'} is for --volume laplace")
        self.faces, self._carrier = known_faces(mesh), None
        if self.way == "laplace":
            try:
                self.faces = solid_faces(mesh.cells)
                self._carrier = volume.carrier(mesh, self.faces, record.vertices, chosen, design, slip)
            except UserError as error:
                raise UserError(f"{path}: {error}") from None

    def displacement(self, weights: Array) -> Array:
        """Displacements [q, 3] of the mesh's points under weights [m, k] of the setup.

        Raises:
            UserError: if the Laplacian does not converge, or the design surface leaves a symmetry plane.
        """
        moved = self.chosen.displacement(self.mesh.points, weights)
        if self._carrier is None:
            return moved
        found, follows, extension = self._carrier
        largest = float(np.linalg.norm(moved[found.design], axis=1).max(initial=0.0))
        if leaving := volume.leaving(self.mesh, found, moved, largest):
            raise UserError(f"{self.path}: {leaving}")
        return extension(np.where(follows, moved, 0.0))

    def unusable(self, weights: Array) -> str:
        """Why no solver can use the mesh under weights [m, k], empty if one can; errors as for `displacement`."""
        moved = self.mesh.points + self.displacement(weights)
        if not np.isfinite(moved).all():
            return "points are not finite"
        if turned := doubts.inverted(self.mesh, moved):
            return turned
        if self.faces is not None:
            before, after = qualities(self.mesh.points, moved, self.faces)
            if before.non_orthogonality <= TURNED_OVER < after.non_orthogonality:
                return "the worst non-orthogonality exceeds 90 degrees: faces of cells are turned over"
        return ""

    def warnings(self, displacement: Array) -> Iterator[str]:
        """What may be wrong with displacements [q, 3] of the points."""
        moved, length = self.mesh.points + displacement, np.linalg.norm(displacement, axis=1)
        largest = float(length.max(initial=0.0))
        yield from doubts.warnings(
            self.record, self.chosen, self.mesh, moved, None if self._carrier else length, largest
        )
        if self._carrier is not None:
            found = self._carrier.constraints
            if jump := volume.jump(self.mesh, found, displacement, largest):
                yield jump

    def quality(self, displacement: Array) -> str:
        """The worst non-orthogonality and skewness before and after displacements [q, 3]; empty without cells."""
        if self.faces is None:
            return ""
        return compared(*qualities(self.mesh.points, self.mesh.points + displacement, self.faces))


def compared(before: Quality, after: Quality) -> str:
    """A line on the qualities of a mesh before and after."""
    return (
        f"worst non-orthogonality {before.non_orthogonality:.1f} degrees before, {after.non_orthogonality:.1f} after; "
        f"worst skewness {before.skewness:.3g} before, {after.skewness:.3g} after"
    )


def known_faces(mesh: meshes.Mesh) -> Between | None:
    """The faces of a mesh's solid cells; None if there are none, or of a kind whose faces are not known."""
    try:
        faces = meshes.cells.faces_of(mesh.cells)
    except meshes.FormatError:
        return None
    return Between.of(faces) if len(faces.sizes) else None
