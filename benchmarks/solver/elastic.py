"""The bracket of examples/elastic: compliance and what the material costs, with exact derivatives, in this process."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from benchmarks.choosing import ROOT
from benchmarks.solver.design import MeshError, Solution, followed
from rbfevo import meshes
from rbfevo.arrays import Array
from rbfevo.meshes.constraints import solid_faces
from rbfevo.meshes.quality import qualities
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup
from rbfevo.scenarios.templates import read_template

EXAMPLES = ROOT / "examples" / "elastic"
CELLS = (24, 6, 3)  # along the ring, across it, over half its width


class Elastic:
    """The bracket, its mesh written once in `directory`; attributes as those of `benchmarks.solver.flow.Flow`."""

    def __init__(self, name: str, directory: Path) -> None:
        sys.path.insert(0, str(EXAMPLES))
        bracket: Any = importlib.import_module("bracket")
        self.price: float = importlib.import_module("solve").PRICE
        self.error: Any = importlib.import_module("elasticity").ShapeError
        self.name, self.case = name, bracket.bracket(CELLS)
        first, file = self.case.body.solve(self.case.points), directory / "bracket.vtu"
        if not (directory / "design.vtp").exists():
            directory.mkdir(parents=True, exist_ok=True)
            bracket.write(self.case, self.case.points, first, file)
            bracket.write_design(self.case, file, directory / "design.vtp")
        keys: Any = importlib.import_module("optimize").SETTINGS
        own = [key for key in keys if key.split("=")[0] in ("scenario.hold", "scenario.hold_width",
               "scenario.symmetry", "scenario.symmetry_at")]  # fmt: skip
        own.append("scenario.sensitivity=sensitivity")
        self.settings = ("scenario=mesh", f"scenario.template={directory / 'design.vtp'}", *own)
        with meshes.opened(file) as mesh:
            self.mesh = mesh
        self.faces = solid_faces(self.mesh.cells)
        template = read_template(directory / "design.vtp", [])
        places = {tuple(point): i for i, point in enumerate(self.mesh.points.tolist())}
        self.rows = [places[tuple(point)] for point in template.vertices.tolist()]
        self.start = self._solution(first, self.mesh.points)

    def _solution(self, found: Any, points: Array) -> Solution:
        slope = found.compliance_gradient + self.price * found.volume_gradient
        quality = qualities(self.mesh.points, points, self.faces)[1]
        return Solution(found.compliance + self.price * found.volume, slope[self.rows], *quality)

    def solve(self, record: Record, chosen: Setup, weights: Array, at: Path, before: Path | None = None) -> Solution:
        """Solve the design under weights [m, 3] of a setup; `at` is made, and holds nothing.

        Raises:
            MeshError: if cells turn inside out.
        """
        at.mkdir(parents=True, exist_ok=True)
        moved = followed(self.mesh, self.faces, record, chosen, weights)
        try:
            return self._solution(self.case.body.solve(moved), moved)
        except self.error as error:
            raise MeshError(str(error)) from None
