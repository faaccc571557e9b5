"""Random centers on a surface."""

from __future__ import annotations

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.parameterization import Region
from rbfevo.scenarios.scenario import Sampler


def open_faces(vertices: Tensor, faces: Tensor, region: Region | None) -> Tensor:
    """The triangles on which centers are drawn: all, or those with no corner in the region where none may sit."""
    if region is None:
        return faces
    kept = faces[~region.contains(vertices)[faces].any(dim=1)]
    if not len(kept):
        raise UserError(
            "scenario.keep_out=true leaves no triangle for centers; fix fewer vertices, or set keep_out=false"
        )
    return kept


def surface_sampler(vertices: Tensor, faces: Tensor) -> Sampler:
    """A sampler of centers that are uniform on the triangles [f, 3]."""
    corners = vertices[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
    cumulative = area.cumsum(0)

    def sample(count: int, m: int, generator: torch.Generator) -> Tensor:
        """Draw [count, m, 3] centers uniformly on the surface."""
        draws = torch.rand(3, count, m, generator=generator, dtype=torch.float64)
        face = torch.searchsorted(cumulative, draws[0] * cumulative[-1]).clamp(max=len(faces) - 1)
        root = draws[1].sqrt()
        shares = torch.stack((1.0 - root, root * (1.0 - draws[2]), root * draws[2]), dim=-1)
        return (shares[..., None] * corners[face]).sum(-2)

    return sample
