"""Flow cases: OpenFOAM's adjoint solver on the meshes of examples/openfoam, deformed in this process."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.choosing import ROOT
from benchmarks.solver.design import MeshError, Solution, followed
from rbfevo import meshes
from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.meshes.constraints import solid_faces
from rbfevo.meshes.openfoam.case import times
from rbfevo.meshes.quality import qualities
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup
from rbfevo.scenarios.templates import read_template

EXAMPLES = ROOT / "examples" / "openfoam"
DEBIAN = Path("/usr/share/openfoam")
STEEPEST = 85.0  # degrees of non-orthogonality of a mesh that is solved
FIELDS = ("U", "p", "Ua", "pa")


class Flow:
    """A case of examples/openfoam, with its mesh made and solved once in `directory`.

    Attributes:
        name: of the case; patch: its design surface; settings: of a run on it, template and patches included.
        start: the solution of the design as it is; vertices: [n, 3] of the design surface.
    """

    def __init__(self, name: str, directory: Path) -> None:
        os.environ.setdefault("WM_PROJECT_DIR", str(DEBIAN))
        sys.path.insert(0, str(EXAMPLES))
        self.name, self.root = name, directory
        self.example: Any = importlib.import_module(name).EXAMPLE
        self.case = directory / "case"
        if not (self.case / "solved").exists():
            shutil.rmtree(self.case, ignore_errors=True)
            shutil.copytree(EXAMPLES / name, self.case)
            self.example.files(self.case, 1.0)
            for command in self.example.meshing:
                _foam(self.case, *command)
            _foam(self.case, "adjointOptimisationFoam")
            (self.case / "solved").touch()
        keys = [setting for setting in self.example.settings if setting.split("=")[0] in
                ("scenario.patches", "scenario.hold")]  # fmt: skip
        self.settings = ("scenario=mesh", f"scenario.template={self.case}", *keys)
        self.patches = keys[0].partition("=")[2].strip("[]").split(",")
        with meshes.opened(self.case) as mesh:
            self.mesh = mesh
        self.faces = solid_faces(self.mesh.cells)
        template = read_template(self.case, self.patches)
        self.vertices, self.rows = template.vertices, template.rows
        quality = qualities(self.mesh.points, self.mesh.points, self.faces)[0]
        self.start = Solution(_objective(self.case, self.example.objective), self.read(self.case), *quality)

    def read(self, case: Path) -> Array:
        """dJ/dx [n, 3] at the vertices of the design surface, of the newest time of a case."""
        template = read_template(case, self.patches)
        if not np.array_equal(template.rows, self.rows):
            raise UserError(f"{case}: its design surface has other points")
        (name,) = [name for name in template.arrays if name.startswith("pointSensVec")]
        return template.arrays[name]

    def solve(self, record: Record, chosen: Setup, weights: Array, at: Path, before: Path | None = None) -> Solution:
        """Solve the design under weights [m, 3] of a setup, in the directory `at`, which is removed first.

        Args:
            before: a solved case whose fields the solver starts from; the original one unless given.

        Raises:
            MeshError: if cells turn inside out.
            subprocess.CalledProcessError: if the solver fails.
        """
        points, moved = self.mesh.points, followed(self.mesh, self.faces, record, chosen, weights)
        quality = qualities(points, moved, self.faces)[1]
        if quality.non_orthogonality > STEEPEST:
            raise MeshError(f"faces turn over: {quality.non_orthogonality:.0f} degrees")
        shutil.rmtree(at, ignore_errors=True)
        at.mkdir(parents=True)
        for part in ("constant", "system", "0"):
            shutil.copytree(self.case / part, at / part)
        warm = before or self.case
        for field in FIELDS:
            shutil.copy(warm / times(warm)[-1] / field, at / "0" / field)
        meshes.write(self.mesh, self.case, moved, moved - points, at / "0", None)
        _foam(at, "adjointOptimisationFoam")
        log = (at / "log.adjointOptimisationFoam").read_text(errors="replace")
        if len(re.findall(r"solution converged in \d+ iterations", log)) != 2:
            raise MeshError("the flow or its adjoint does not converge")
        return Solution(_objective(at, self.example.objective), self.read(at), *quality)


def _foam(case: Path, *command: str) -> None:
    with (case / f"log.{command[0]}").open("w") as log:
        subprocess.run([*command, "-case", str(case)], stdout=log, stderr=subprocess.STDOUT, check=True)


def _objective(case: Path, name: str) -> float:
    """J of a case that was solved."""
    lines = (case / "optimisation" / "objective" / "0" / name).read_text(encoding="ascii").splitlines()
    return float(lines[-1].split()[1])
