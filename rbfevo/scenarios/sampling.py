"""Random centers on a surface or a curve, as searches start from."""

from __future__ import annotations

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.parameterization import Region
from rbfevo.scenarios.scenario import Sampler


def open_parts(vertices: Tensor, parts: Tensor, region: Region | None) -> Tensor:
    """The triangles or segments [f, k] on which centers are drawn: those with no corner where no center may sit.

    Raises:
        UserError: if there are none.
    """
    if region is None:
        return parts
    kept = parts[~region.contains(vertices)[parts].any(dim=1)]
    if not len(kept):
        name = "triangle" if parts.shape[1] == 3 else "segment"
        raise UserError(
            f"scenario.keep_out=true leaves no {name} for centers; fix fewer vertices, or set keep_out=false"
        )
    return kept


def surface_sampler(vertices: Tensor, faces: Tensor) -> Sampler:
    """Centers uniform on the surface."""
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


def curve_sampler(vertices: Tensor, segments: Tensor) -> Sampler:
    """Centers uniform on the curve."""
    ends = vertices[segments]
    cumulative = (ends[:, 1] - ends[:, 0]).norm(dim=1).cumsum(0)

    def sample(count: int, m: int, generator: torch.Generator) -> Tensor:
        """Draw [count, m, 3] centers uniformly on the curve."""
        draws = torch.rand(2, count, m, generator=generator, dtype=torch.float64)
        segment = torch.searchsorted(cumulative, draws[0] * cumulative[-1]).clamp(max=len(segments) - 1)
        return torch.lerp(ends[segment, 0], ends[segment, 1], draws[1][..., None])

    return sample
