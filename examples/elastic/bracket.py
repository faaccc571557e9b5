"""The case: half of a curved steel bracket that carries a load at its end. Millimetres, newtons, N/mm^2.

A quarter of a ring of square section. It is clamped where x = 0 and pulled down where y = 0; z = 0 is the plane of
symmetry. The design surface is all the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyvista as pv
import skfem
from elasticity import Array, Body, Solution
from numpy.typing import NDArray

INNER, OUTER, HALF = 60.0, 100.0, 20.0  # radii, and half the width
LOAD = 10_000.0  # of the whole bracket
YOUNG, POISSON = 210_000.0, 0.3


class Bracket(NamedTuple):
    """The mesh and what is solved on it.

    Attributes:
        points: [n, 3] nodes; body: cells, supports and load on them; design: [n] True for nodes of the design surface,
            held: [n] for those of it that cannot move, since they belong to an end as well.
    """

    points: Array
    body: Body
    design: NDArray[np.bool_]
    held: NDArray[np.bool_]


def bracket(cells: Sequence[int]) -> Bracket:
    """The bracket with numbers of cells along the ring, across it, and over half its width."""
    mesh = skfem.MeshHex.init_tensor(*(np.linspace(0.0, 1.0, count + 1) for count in cells))
    along, across, up = mesh.p
    radius, angle = INNER + (OUTER - INNER) * across, 0.5 * np.pi * (1.0 - along)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), HALF * up], axis=1)
    points[along == 0.0, 0] = points[along == 1.0, 1] = 0.0
    supports = np.zeros(points.shape, bool)
    supports[along == 0.0] = True
    supports[up == 0.0, 2] = True
    traction = np.array([0.0, -LOAD / ((OUTER - INNER) * 2.0 * HALF), 0.0])
    body = Body(mesh.t.T, YOUNG, POISSON, traction, supports, along == 1.0)
    design = (across == 0.0) | (across == 1.0) | (up == 1.0)
    return Bracket(points, body, design, design & ((along == 0.0) | (along == 1.0)))


def sensitivity(found: Bracket, solution: Solution) -> tuple[Array, float]:
    """dJ/dX - factor dV/dX [n, 3], the direction in which J falls while V stays, and the factor.

    The factor is dJ/dV of a design that grows by the same thickness everywhere: a mean of dJ/dV at single nodes,
    weighted by their areas |dV/dX|.
    """
    free = found.design & ~found.held
    force, normal = solution.compliance_gradient[free], solution.volume_gradient[free]
    area = np.linalg.norm(normal, axis=1)
    factor = float(((force * normal).sum(axis=1) / area).sum() / area.sum())
    return solution.compliance_gradient - factor * solution.volume_gradient, factor


def write(found: Bracket, points: Array, solution: Solution, out: Path) -> None:
    """Write the mesh with its nodes at `points` [n, 3], and the solution there, as VTU."""
    mesh = skfem.MeshHex(np.ascontiguousarray(points.T), np.ascontiguousarray(found.body.corners.T))
    arrays = {
        "sensitivity": sensitivity(found, solution)[0],
        "dJ/dX": solution.compliance_gradient,
        "dV/dX": solution.volume_gradient,
        "displacement by load": solution.displacement,
        "held": found.held.astype(np.float64),
    }
    mesh.save(str(out), point_data=arrays, cell_data={"von Mises": [solution.stress]})
    print(f"written: {out}")


def write_design(found: Bracket, volume: Path, out: Path) -> None:
    """Write the design surface of a mesh, with the point arrays of its file, as VTP."""
    mesh: Any = pv.read(volume)
    outside = mesh.extract_surface(algorithm=None)
    quads = outside["vtkOriginalPointIds"][outside.regular_faces]
    inner = [mask[quads].all(axis=1) for mask in (found.body.supports[:, 2], found.body.loaded)]
    nodes, corners = np.unique(quads[~(inner[0] | inner[1])], return_inverse=True)
    surface: Any = pv.PolyData.from_regular_faces(mesh.points[nodes], corners.reshape(-1, 4))
    for name, values in mesh.point_data.items():
        surface.point_data[name] = values[nodes]
    surface.save(out)
    print(f"written: {out}")
