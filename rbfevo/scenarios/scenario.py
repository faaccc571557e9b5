"""What every scenario hands to the rest: a mesh, the wanted displacement, the box, and a way to draw centers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.errors import UserError

Sampler = Callable[[int, int, torch.Generator], Tensor]
Closest = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A design, where it should move, and the box its control points may sit in (all tensors float64).

    Attributes:
        name: as on the command line (`plane`, `face`).
        vertices: [n, d], d = 2 or 3, in model units.
        faces: [f, 3] int64 triangles into `vertices`.
        gradient: [n, k] estimated fitness gradient g, of unit (weighted) Frobenius norm.
        weights: [n] positive; row i of Phi and g counts with sqrt(weights[i]); ones if uniform.
        lower, upper: [d] corners of the box, model units.
        support: default support radius of compact kernels, model units.
        sample: (count, m, generator) -> [count, m, d] random centers inside the box.
        gradient_norm: the norm that g had before it was scaled (model units; displacement = gradient * gradient_norm).
        notes: facts worth a line in the run's log and summary (what was rejected, what the scan was, ...).
        closest: points [q, 3] -> the closest points [q, 3] of a target that may be met anywhere (NumPy, on the host);
            None where the wanted displacement is fixed.
        stays: [n] bool, the vertices that have no pair on that target and are to stay where they are; None if all
            have one.
    """

    name: str
    vertices: Tensor
    faces: Tensor
    gradient: Tensor
    weights: Tensor
    lower: Tensor
    upper: Tensor
    support: float
    sample: Sampler
    gradient_norm: float = 1.0
    notes: dict[str, str] = dataclasses.field(default_factory=dict)
    closest: Closest | None = None
    stays: Tensor | None = None

    def __post_init__(self) -> None:
        n, d = self.vertices.shape
        if (
            self.gradient.shape[0] != n
            or self.weights.shape != (n,)
            or self.lower.shape != (d,)
            or self.upper.shape != (d,)
            or (self.stays is not None and self.stays.shape != (n,))
        ):
            raise UserError(f"scenario {self.name}: vertices, gradient, weights and box do not fit together")
        for name in ("vertices", "gradient", "weights", "lower", "upper"):
            if not bool(torch.isfinite(getattr(self, name)).all()):
                raise UserError(f"scenario {self.name}: {name} has values that are not finite")

    def to(self, device: torch.device) -> Scenario:
        """The same scenario with its tensors on `device`."""
        names = ("vertices", "faces", "gradient", "weights", "lower", "upper", "stays")
        values = {name: getattr(self, name) for name in names}
        moved: dict[str, Any] = {name: value.to(device) for name, value in values.items() if value is not None}
        return dataclasses.replace(self, **moved)


def unit_gradient(gradient: Tensor, weights: Tensor) -> tuple[Tensor, float]:
    """Scale `gradient` [n, k] to unit weighted Frobenius norm (paper, eq. 8); return it and the norm it had.

    Raises:
        UserError: if the gradient is zero everywhere, so that there is nothing to improve.
    """
    norm = float(torch.sqrt((weights[:, None] * gradient**2).sum()))
    if not norm > 0.0:
        raise UserError("the estimated fitness gradient is zero at every vertex: the target moves nothing")
    return gradient / norm, norm
