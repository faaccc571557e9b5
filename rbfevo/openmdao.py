"""A setup as a component of OpenMDAO: parameters in, coordinates of deformed points out, exact derivatives.

    from rbfevo.openmdao import Deformation

    model.add_subsystem("geometry", Deformation(run="outputs/wing", pick="knee", mesh="wing.vtu", volume="laplace"))

The coordinates are those that `rbfevo.apply` writes. They are flat, x, y, z of one point after another, as MPhys has
them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbfevo import meshes
from rbfevo.arrays import Array
from rbfevo.commands import doubts, volume
from rbfevo.errors import UserError
from rbfevo.meshes.cells import solids
from rbfevo.meshes.constraints import solid_faces
from rbfevo.meshes.mesh import Cells, Mesh
from rbfevo.recorded.exported import read_export
from rbfevo.recorded.moves import spatial
from rbfevo.recorded.parameters import Displacement, Parameters, design_matrix, orthonormal
from rbfevo.recorded.picks import PICKS, pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import Setup, setup

try:
    import openmdao.api as om
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f"{error}: pip install 'rbfevo[openmdao]'", name=error.name) from None

ENTRIES = 2**21  # of a sparse Jacobian; a larger one is never made
VOLUMES = ("rbf", "laplace")


class Source(NamedTuple):
    """A setup, the run that it is of, and T of U = Q T for its columns along a symmetry plane and across it."""

    record: Record
    chosen: Setup
    triangle: Callable[[bool], Array]


class Deformation(om.ExplicitComponent):
    """Coordinates [3 n] of points under parameters [r] of one setup: X' = X + U P, and dX'/dP = U.

    Where U belongs to the original points X, and stays the same for all parameters.

    Options:
        run: a run directory, or a setup.npz of `rbfevo.export`; pick: which setup of a run directory, as of `export`.
        mesh: file of the mesh that is deformed, as `rbfevo.apply` takes it; points: or its points, [n, 3] or flat.
            Neither: the vertices of the run.
        volume: `rbf`, all points follow the setup; `laplace`, the design surface does, and the inside of `mesh` is
            carried along. design, slip: names of patches, then, as for `apply`.
        orthogonalized: whether the parameters are q = T p, those of orthonormal columns (R = 1); else p, those of the
            run's manipulation: weights, or displacements of centers.
        parameters_name, output_name: of the input [r] and the output [3 n]; input_name: of an input [3 n] to which
            displacements are added in the place of the points as they were read; None: there is none.
        matrix_free: whether products with the derivatives are computed without a Jacobian; None: for large meshes.
        check_cells: whether coordinates that turn solid cells of `mesh` inside out raise AnalysisError.
        distributed: whether each process of MPI has a part of the points of its own, given as `points`.

    Raises:
        UserError: by its setup, for a user's mistake.
    """

    def initialize(self) -> None:
        """Declare the options."""
        declare = self.options.declare
        declare("run", types=(str, Path), desc="run directory, or setup.npz of an export")
        declare("pick", default=None, types=str, allow_none=True, desc=f"setup of the run: {', '.join(PICKS)}")
        declare("mesh", default=None, types=(str, Path), allow_none=True, desc="file of the mesh to deform")
        declare("points", default=None, allow_none=True, desc="points to deform, [n, 3] or flat")
        declare("volume", default="rbf", values=VOLUMES, desc="how the inside of a volume mesh moves")
        declare("design", default=(), types=(list, tuple), desc="for laplace: patches of the design surface")
        declare("slip", default=(), types=(list, tuple), desc="for laplace: more patches that slide in their planes")
        declare("orthogonalized", default=False, types=bool, desc="parameters of orthonormal columns")
        declare("parameters_name", default="parameters", types=str, desc="name of the input")
        declare("output_name", default="x_aero0", types=str, desc="name of the output")
        declare("input_name", default=None, types=str, allow_none=True, desc="name of an input of coordinates")
        declare("matrix_free", default=None, types=bool, allow_none=True, desc="without a Jacobian")
        declare("check_cells", default=True, types=bool, desc="refuse cells that are turned inside out")

    def setup(self) -> None:
        """Read the files, and add inputs and outputs."""
        options = self.options
        found = source(Path(options["run"]), options["pick"])
        record, chosen, triangle = found
        k = record.gradient.shape[1]
        if record.vertices.shape[1] == 3 and k != 3:
            raise UserError(f"{options['run']}: its gradient has {k} components, not the three of a displacement")
        self._parameters = Parameters(chosen, k, triangle if options["orthogonalized"] else None)
        self.mesh = self._mesh(record)
        self.displacement = self._displacement(record, chosen)
        self.points = self.mesh.points
        self._check = options["check_cells"] and bool(solids(self.mesh.cells))
        parameters, output, initial = self._names()
        parts, tagged = options["distributed"], {"tags": ["mphys_coordinates"]}  # which MPhys promotes
        zero, place = np.zeros(len(self._parameters)), self.points.ravel()
        self.add_input(parameters, val=zero, distributed=False, desc="parameters of the setup")
        self.add_output(output, val=place, distributed=parts, desc="coordinates of the deformed points", **tagged)
        if initial is not None:
            self.add_input(initial, val=place, distributed=parts, desc="coordinates to displace", **tagged)
        entries = len(self._parameters) * len(self.points)
        free = options["matrix_free"]
        self.matrix_free = options["distributed"] or (entries > ENTRIES if free is None else free)

    def setup_partials(self) -> None:
        """Declare the derivatives, which are constant."""
        parameters, output, initial = self._names()
        if self.matrix_free:
            self.declare_partials(output, parameters)
            if initial is not None:
                self.declare_partials(output, initial)
            return
        entries = []
        for axis, own, columns in self.displacement.columns():
            point, column = np.nonzero(columns)
            entries.append((3 * point + axis, own[column], columns[point, column]))
        rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
        if len(rows):  # the mesh is within reach
            self.declare_partials(output, parameters, rows=rows, cols=columns, val=values)
        if initial is not None:
            every = np.arange(self.points.size)
            self.declare_partials(output, initial, rows=every, cols=every, val=1.0)

    def compute(self, inputs: Any, outputs: Any, *_: Any) -> None:
        """X' = X + U P.

        Raises:
            AnalysisError: where cells of the mesh turn inside out.
        """
        parameters, output, initial = self._names()
        start = self.points if initial is None else inputs[initial].reshape(-1, 3)
        moved = start + self.displacement(inputs[parameters])
        outputs[output] = moved.ravel()
        if self._check and (turned := doubts.inverted(self.mesh, moved.real)):
            raise om.AnalysisError(f"{self.pathname or type(self).__name__}: {turned}")

    def compute_jacvec_product(self, inputs: Any, d_inputs: Any, d_outputs: Any, mode: str, *_: Any) -> None:
        """Add dX' = dX + U dP, or its transpose."""
        parameters, output, initial = self._names()
        if output not in d_outputs:
            return
        if mode == "fwd":
            if parameters in d_inputs:
                d_outputs[output] += self.displacement(d_inputs[parameters]).ravel()
            if initial is not None and initial in d_inputs:
                d_outputs[output] += d_inputs[initial]
            return
        if parameters in d_inputs:
            pulled = self.displacement.transposed(d_outputs[output].reshape(-1, 3))
            shared = self.options["distributed"] and self.comm.size > 1
            d_inputs[parameters] += self.comm.allreduce(pulled) if shared else pulled
        if initial is not None and initial in d_inputs:
            d_inputs[initial] += d_outputs[output]

    def rows(self, parameters: Array) -> Array:
        """Rows [m, 3] for `rbfevo.apply`: displacements of centers or, of an indirect run, weights."""
        return spatial(self._parameters.rows(np.asarray(parameters, np.float64)))

    def flat(self, rows: Array) -> Array:
        """The parameters [r] of rows [m, 3] as `rbfevo.export` writes them, the inverse of `rows`."""
        rows = np.asarray(rows, np.float64)
        return self._parameters.flat(rows[:, 2:] if self._parameters.k == 1 else rows)

    def _names(self) -> tuple[str, str, str | None]:
        return tuple(self.options[f"{name}_name"] for name in ("parameters", "output", "input"))

    def _mesh(self, record: Record) -> Mesh:
        """The mesh that is deformed."""
        path, points = self.options["mesh"], self.options["points"]
        if path is not None and points is not None:
            raise UserError("mesh and points are both given: choose one")
        if self.options["distributed"] and self.comm.size > 1 and points is None:
            raise UserError("distributed: give the points of each process as points")
        if path is not None:
            with meshes.opened(path) as mesh:
                meshes.refuse_bad_points(path, mesh.points)
                return mesh
        if points is None:
            return Mesh(spatial(record.vertices), lambda *_: [], Cells.none())
        found = np.asarray(points, np.float64)
        if found.ndim not in (1, 2) or found.size % 3 or (found.ndim == 2 and found.shape[1] != 3):
            raise UserError(f"points: their shape is {list(found.shape)}, not [n, 3] or [3 n]")
        found = found.reshape(-1, 3)
        meshes.refuse_bad_points(Path("points"), found)
        return Mesh(found, lambda *_: [], Cells.none())

    def _displacement(self, record: Record, chosen: Setup) -> Displacement:
        """The linear map from parameters to displacements."""
        options, mesh = self.options, self.mesh
        if options["volume"] == "rbf":
            for name in ("design", "slip"):
                if options[name]:
                    raise UserError(f"{name}={', '.join(options[name])} is for volume=laplace")
            apart = doubts.warnings(record, chosen, mesh, mesh.points, None, 0.0) if options["mesh"] else ()
            for line in apart:
                om.issue_warning(line, prefix=self.msginfo)
            return Displacement(self._parameters, mesh.points)
        if options["mesh"] is None:
            raise UserError("volume=laplace: give the file of the volume mesh as mesh")
        path = options["mesh"]
        try:
            faces = solid_faces(mesh.cells)
            found, follows, extension = volume.carrier(
                mesh, faces, record.vertices, chosen, options["design"], options["slip"]
            )
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        reach = Displacement(self._parameters, mesh.points, follows).reach()
        if leaving := volume.leaving(mesh, found, reach, float(np.linalg.norm(reach[found.design], axis=1).max())):
            raise UserError(f"{path}: with parameters of 1, {leaving}")
        if jump := volume.jump(mesh, found, reach, float(np.linalg.norm(reach, axis=1).max())):
            om.issue_warning(f"{path}: with parameters of 1, {jump}", prefix=self.msginfo)
        return Displacement(self._parameters, mesh.points, follows, extension)


def source(run: Path, choice: str | None) -> Source:
    """A setup of a run directory by its pick, or that of a setup.npz.

    Raises:
        UserError: if files are missing or damaged, or there is no such pick.
    """
    if run.is_dir() or not run.suffix:
        record = read(run)
        if choice is None:
            raise UserError(f"{run}: choose a setup by pick: {', '.join(PICKS)}")
        chosen = setup(record, pick(record, choice))
        return Source(
            record,
            chosen,
            lambda across: orthonormal(design_matrix(chosen, record.vertices, across), record.weights)[1],
        )
    if choice is not None:
        raise UserError(f"{run} holds one setup; leave pick={choice} out")
    record, triangles = read_export(run)
    return Source(record, setup(record, 0), triangles.__getitem__)
