"""The later optimization in OpenMDAO: a setup of a run deforms the mesh, the solver answers, SciPy's SLSQP steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import openmdao.api as om
from elasticity import Array, Body, Solution

from rbfevo.openmdao import Deformation


class Compliance(om.ExplicitComponent):
    """Compliance and volume of a body, and their derivatives, of the flat coordinates [3 n] of its nodes.

    Options:
        body: with n nodes; solved: called with each solution.
    """

    def initialize(self) -> None:
        """Declare the options."""
        self.options.declare("body", types=Body)
        self.options.declare("solved", default=lambda _: None)

    def setup(self) -> None:
        """Add the input and the outputs."""
        self.add_input("x_aero0", shape=self.options["body"].supports.size)
        self.add_output("compliance")
        self.add_output("volume")
        self.declare_partials("*", "*")

        self.points: Array | None = None

    def compute(self, inputs: Any, outputs: Any, *_: Any) -> None:
        """Solve, unless these nodes were those of the last time, too."""
        points = np.array(inputs["x_aero0"], np.float64).reshape(-1, 3)
        if self.points is None or not np.array_equal(points, self.points):
            self.solution: Solution = self.options["body"].solve(points)
            self.points = points
            self.options["solved"](self.solution)
        outputs["compliance"], outputs["volume"] = self.solution.compliance, self.solution.volume

    def compute_partials(self, inputs: Any, partials: Any, *_: Any) -> None:
        """Those of the last solution, which is of these inputs."""
        partials["compliance", "x_aero0"] = self.solution.compliance_gradient.ravel()
        partials["volume", "x_aero0"] = self.solution.volume_gradient.ravel()


class Optimum(NamedTuple):
    """What an optimization found.

    Attributes:
        points: [n, 3] nodes of the optimized mesh; rows: [m, 3] what `rbfevo.apply` takes to make the same mesh.
        solutions: of all shapes that were solved, in order; last: of the optimized one.
        message: of SLSQP; success: whether it converged.
    """

    points: Array
    rows: Array
    solutions: list[Solution]
    last: Solution
    message: str
    success: bool


def optimized(
    body: Body, before: Solution, run: Path, choice: str, mesh: Path, bound: float, iterations: int, tolerance: float
) -> Optimum:
    """Minimize the compliance of a body, its volume being at most what it was.

    Args:
        before: the solution of the body as it is; mesh: the file with its nodes, in their order.
        run, choice: the setup that deforms; bound: of each parameter, in the unit of the mesh.
        iterations, tolerance: where SLSQP stops; the second is a share of the compliance before.
    """
    solutions: list[Solution] = []
    problem: Any = om.Problem(reports=False)
    model = problem.model
    geometry = Deformation(run=run, pick=choice, mesh=mesh, volume="laplace")
    model.add_subsystem("geometry", geometry, promotes=["*"])
    model.add_subsystem("solver", Compliance(body=body, solved=solutions.append), promotes=["*"])
    model.add_design_var("parameters", lower=-bound, upper=bound, ref=bound)
    model.add_objective("compliance", ref=before.compliance)
    model.add_constraint("volume", upper=before.volume, ref=before.volume)
    problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", maxiter=iterations, tol=tolerance, disp=False)
    problem.setup(mode="rev")
    problem.run_driver()
    found = problem.driver.result
    return Optimum(
        problem.get_val("x_aero0").reshape(-1, 3).copy(),
        geometry.rows(problem.get_val("parameters")),
        solutions,
        solutions[-1],
        str(problem.driver._scipy_optimize_result.message),
        bool(found.success),
    )
