"""The plane and its height field: the paper's function approximation scenario (section 5.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.scenarios.scenario import Scenario, unit_gradient


def height_field(points: Tensor) -> Tensor:
    """Evaluate the target height field at points [n, 2] in [0,1] x [0,2]; returns [n] heights in [0, 1].

    The test function of Giannelli, Jüttler and Speleers (2012), "THB-splines: The truncated basis for hierarchical
    splines", Computer Aided Geometric Design 29(7), on (u, v) = (y, x): a plateau of height 1 with its ramp where y is
    small, and a bump of height 1 and radius 1/4 about (x, y) = (1/2, 3/2).
    """
    v, u = points.unbind(-1)
    rise = 2.0 * (v - u)
    q = (u - 1.5) ** 2 + (v - 0.5) ** 2
    bump = torch.where(q <= 1.0 / 16.0, (torch.cos(4.0 * math.pi * q.sqrt()) + 1.0) / 2.0, torch.zeros_like(q))
    return torch.where(rise >= 0.0, rise.clamp(max=1.0), bump)


def plane(resolution: Sequence[int] = (150, 150), support: float = 0.5) -> Scenario:
    """Build the plane [0,1] x [0,2], a regular grid of nx times ny vertices with the box's edges among them.

    The gradient [nx*ny, 1] is the height field itself; `support` is the default support radius of compact kernels.
    Vertex ix + iy*nx sits at (ix/(nx-1), 2 iy/(ny-1)); triangles run counterclockwise.

    Raises:
        UserError: if `resolution` is not two whole numbers of at least 2.
    """
    nx, ny = _grid_size(resolution)
    x = torch.linspace(0.0, 1.0, nx, dtype=torch.float64)
    y = torch.linspace(0.0, 2.0, ny, dtype=torch.float64)
    vertices = torch.stack([x.repeat(ny), y.repeat_interleave(nx)], dim=1)

    corner = (torch.arange(nx - 1) + nx * torch.arange(ny - 1)[:, None]).reshape(-1)
    lower_right = torch.stack([corner, corner + 1, corner + nx + 1], dim=1)
    upper_left = torch.stack([corner, corner + nx + 1, corner + nx], dim=1)

    weights = torch.ones(nx * ny, dtype=torch.float64)
    gradient, norm = unit_gradient(height_field(vertices)[:, None], weights)
    lower = torch.tensor([0.0, 0.0], dtype=torch.float64)
    upper = torch.tensor([1.0, 2.0], dtype=torch.float64)

    def sample(count: int, m: int, generator: torch.Generator) -> Tensor:
        """Draw [count, m, 2] centers uniformly in the box."""
        draws = torch.rand(count, m, 2, generator=generator, dtype=torch.float64, device=generator.device)
        return draws * upper.to(draws.device)

    return Scenario(
        name="plane",
        vertices=vertices,
        faces=torch.cat([lower_right, upper_left]),
        gradient=gradient,
        weights=weights,
        lower=lower,
        upper=upper,
        support=support,
        sample=sample,
        gradient_norm=norm,
        notes={"plane": f"{nx} x {ny} vertices on [0,1] x [0,2]", "target": "height field of Giannelli et al. 2012"},
    )


def _grid_size(resolution: object) -> tuple[int, int]:
    sizes: list[Any] = list(resolution) if isinstance(resolution, Sequence) else []
    whole = all(isinstance(size, int) and not isinstance(size, bool) for size in sizes)
    if len(sizes) != 2 or not whole or min(sizes) < 2:
        raise UserError(f"scenario.resolution={resolution}: give two whole numbers of at least 2, such as [150,150]")
    return sizes[0], sizes[1]
