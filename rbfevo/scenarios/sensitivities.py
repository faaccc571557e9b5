"""From an adjoint solver's sensitivities to the wanted displacement of a design.

The solver gives dJ/dx at every vertex, either integrated over the vertex's share of the surface (nodal, what a discrete
adjoint returns) or per area (density). The estimated fitness gradient is the direction of steepest descent of J in the
inner product that the vertex weights define, <u, v> = sum_i w_i u_i.v_i: g_i = -s_i / w_i with nodal values s_i. So a
density is multiplied by the vertex's area with uniform weights, and used unchanged with area weights, for which g is
the same on every mesh of a shape, up to the discretization.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rbfevo.errors import UserError

KINDS = ("nodal", "density")
OBJECTIVES = ("minimize", "maximize")

Array = NDArray[np.float64]


def check(kind: str, objective: str) -> None:
    """Refuse unknown choices.

    Raises:
        UserError: naming the key and the valid choices.
    """
    if kind not in KINDS:
        raise UserError(f"scenario.sensitivity_kind={kind}: choose one of {', '.join(KINDS)}")
    if objective not in OBJECTIVES:
        raise UserError(f"scenario.objective={objective}: choose one of {', '.join(OBJECTIVES)}")


def wanted(values: Array, normals: Array, areas: Array, weights: Array, kind: str, objective: str) -> Array:
    """The wanted displacement [n, 3], up to a positive factor: downhill of an objective to be minimized, else uphill.

    Args:
        values: [n], taken along the normals, positive outwards, or [n, 3].
        normals: [n, 3] unit; areas: [n], a third of the adjacent triangles; weights: [n] positive.
        kind: `nodal` (integrated) or `density` (per area); objective: `minimize` or `maximize`.
    """
    vectors = values[:, None] * normals if values.ndim == 1 else values
    nodal = vectors if kind == "nodal" else vectors * areas[:, None]
    return (1.0 if objective == "maximize" else -1.0) * nodal / weights[:, None]
