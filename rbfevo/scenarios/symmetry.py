"""The symmetry plane of a design, and how symmetric its mesh and its wanted displacement are."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.correspondence import Points, Triangles, closest_on_surface
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.topology import rim

LOOKED_AT = 20_000  # vertices: enough to measure how symmetric a mesh is
LOPSIDED = 0.01  # of the box's diagonal
MOST_OF_RIM, FLAT_RIM = 0.8, 1e-6  # of the open boundary's vertices; of the diagonal
HOPELESS = 0.999  # of |g|^2
ONE_SIDED = 0.02  # fewer vertices than this on one side, over those on the other: half a model


def mirror_of(
    axis: str | None, at: float | None, vertices: Points, triangles: Triangles, lower: Tensor, upper: Tensor
) -> Mirror | None:
    """The plane that `scenario.symmetry` and `scenario.symmetry_at` ask for.

    Where `at` is null it goes through the open side of half a model, if the template is one (most of its open boundary
    lies in one plane at its end), else through the middle of the vertices.

    Raises:
        UserError: for another axis, `at` without an axis, a plane that does not cross the box, or one that holds the
            whole template.
    """
    if axis is None:
        if at is not None:
            raise UserError("scenario.symmetry_at needs scenario.symmetry, the axis across the plane: x, y or z")
        return None
    if axis not in ("x", "y", "z"):
        raise UserError(f"scenario.symmetry={axis}: choose x, y or z, the axis across the plane, or null")
    number = "xyz".index(axis)
    low, high = float(vertices[:, number].min()), float(vertices[:, number].max())
    if at is None:
        border = vertices[rim(vertices, triangles), number]
        near = FLAT_RIM * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        cut = [end for end in (low, high) if border.size and (np.abs(border - end) <= near).mean() >= MOST_OF_RIM]
        at = cut[0] if len(cut) == 1 else (low + high) / 2.0
    mirror = Mirror.across(number, at, lower, upper)
    if max(high - at, at - low) <= mirror.tolerance:
        raise UserError(
            f"scenario.symmetry={axis}: the whole template lies in the plane {axis} = {at:g}; choose another"
        )
    return mirror


def notes_and_warnings(
    mirror: Mirror,
    vertices: Points,
    surface: tuple[Points, Triangles],
    gradient: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> tuple[dict[str, str], list[str]]:
    """Notes and warnings: how far mirror images lie from the surface, and how much of g [n, 3] is not symmetric.

    Raises:
        UserError: if g is antisymmetric.
    """
    name = f"{'xyz'[mirror.axis]} = {mirror.at:g}"
    heights = vertices[:, mirror.axis] - mirror.at
    beyond = np.sort([(heights > mirror.tolerance).sum(), (heights < -mirror.tolerance).sum()])
    if beyond[0] <= ONE_SIDED * beyond[1]:
        return {"symmetry": f"about {name}; the template is one half, and the other half is not scored"}, []
    some = np.linspace(0, len(vertices) - 1, min(len(vertices), LOOKED_AT)).astype(np.int64)
    images = mirror.image(torch.from_numpy(vertices[some])).numpy()
    closest, _ = closest_on_surface(images, *surface)
    distance = float(np.linalg.norm(closest - images, axis=1).max())
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))

    _, partner = KDTree(vertices).query(images)
    turned = gradient[partner].copy()
    turned[:, mirror.axis] *= -1.0
    odd = (weights[some, None] * ((gradient[some] - turned) / 2.0) ** 2).sum()
    share = float(odd / max((weights[some, None] * gradient[some] ** 2).sum(), np.finfo(float).tiny))
    if share > HOPELESS:
        raise UserError(
            f"symmetry about {name}: the wanted displacement is antisymmetric, so no symmetric setup can follow it; "
            "check scenario.symmetry and scenario.symmetry_at"
        )
    notes = {
        "symmetry": f"about {name}: mirror images lie within {distance:.3g} of the surface; {share:.1%} of |g|^2 is "
        "not symmetric, and out of reach"
    }
    if distance > LOPSIDED * diagonal:
        return notes, [
            f"symmetry about {name}: the template is not symmetric (mirror images lie up to {distance:.3g} from its "
            "surface); check scenario.symmetry and scenario.symmetry_at"
        ]
    return notes, []
