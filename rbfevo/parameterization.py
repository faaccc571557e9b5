"""Genotype -> centers: what keeps setups symmetric and out of the regions where no center may sit."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from rbfevo.mirror import Mirror


class Region(Protocol):
    """Where no center may sit."""

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest points [q, d] outside the region, and which of their coordinates [q, d] were changed for it."""
        ...


class BoxRegion:
    """The inside of a box [d], [d], which centers leave through its nearest side that lies within the scenario's."""

    def __init__(self, lower: Tensor, upper: Tensor, within: tuple[Tensor, Tensor]) -> None:
        self.lower, self.upper = lower, upper
        self._down = torch.where(lower > within[0], 0.0, torch.inf)  # a side that no center can cross is no way out
        self._up = torch.where(upper < within[1], 0.0, torch.inf)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """See `Region`; points stay where there is no way out."""
        lower, upper = self.lower.to(points), self.upper.to(points)
        inside = ((points > lower) & (points < upper)).all(-1)
        ways = torch.cat((points - lower + self._down.to(points), upper - points + self._up.to(points)), dim=-1)
        depth, way = ways.min(-1)
        axis = way % points.shape[-1]
        side = torch.where(way < points.shape[-1], lower[axis], upper[axis])
        moved = torch.zeros_like(points, dtype=torch.bool).scatter_(-1, axis[..., None], True)
        moved &= (inside & depth.isfinite())[..., None]
        return torch.where(moved, side[..., None], points), moved


class VertexRegion:
    """All that is closer to a fixed vertex than to a free one; centers go to the nearest free vertex."""

    def __init__(self, vertices: Tensor, fixed: Tensor) -> None:
        points = vertices.cpu().numpy()
        self._fixed = fixed.cpu().numpy()
        self._free = points[~self._fixed]
        self._nearest, self._nearest_free = KDTree(points), KDTree(self._free)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """See `Region`; not finite points stay."""
        flat = points.detach().cpu().reshape(-1, points.shape[-1]).numpy()
        moved = np.asarray(np.isfinite(flat).all(axis=1), bool)
        moved[moved] = self._fixed[self._nearest.query(flat[moved])[1]]
        placed = flat.copy()
        placed[moved] = self._free[self._nearest_free.query(flat[moved])[1]]
        mask = torch.from_numpy(moved)[:, None].expand(-1, flat.shape[1])
        return (
            torch.from_numpy(placed).view(points.shape).to(points),
            mask.reshape(points.shape).to(points.device),
        )


class Parameterization:
    """Centers [*pop, m, d] from points [*pop, m, d] anywhere in the box; without mirror and region the identity.

    With a mirror, points of the other side are folded over, and if m is odd the last one is put on the plane. Points
    leave the region, but the one on the plane may be moved back into it.
    """

    def __init__(self, mirror: Mirror | None = None, side: float = 1.0, region: Region | None = None) -> None:
        """`side` is +1 or -1: on which side of the mirror the centers sit; their images sit on the other."""
        self.mirror, self.side, self.region = mirror, side, region

    def __call__(self, points: Tensor) -> Tensor:
        """Centers from points."""
        return self._place(points)[0]

    def pull(self, points: Tensor, gradient: Tensor) -> Tensor:
        """The gradient [*pop, m, d] in the centers, as one in the points that they were made from."""
        if self.mirror is None and self.region is None:
            return gradient
        return gradient * self._place(points)[1]

    def settle(self, centers: Tensor) -> Tensor:
        """Centers of a heuristic [*pop, m, d]: of an odd number the one nearest to the plane is moved onto it."""
        if self.mirror is not None and centers.shape[-2] % 2:
            distance = (centers[..., self.mirror.axis] - self.mirror.at).abs()
            order = distance.argsort(dim=-1, descending=True, stable=True)
            centers = centers.gather(-2, order[..., None].expand_as(centers))
        return self(centers)

    def _place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Centers, and the derivative of each coordinate by the point's: 1, -1 or 0."""
        factor = torch.ones_like(points)
        if self.mirror is None and self.region is None:
            return points, factor
        centers, factor = self._folded(points, factor)
        if self.region is not None:
            centers, moved = self.region.project(centers)
            centers, factor = self._folded(centers, torch.where(moved, 0.0, factor))
        return centers, factor

    def _folded(self, points: Tensor, factor: Tensor) -> tuple[Tensor, Tensor]:
        """Points on one side of the mirror, the last of an odd number of them on the plane."""
        if self.mirror is None:
            return points, factor
        axis, at = self.mirror.axis, self.mirror.at
        height = self.side * (points[..., axis] - at)
        centers, factor = points.clone(), factor.clone()
        centers[..., axis] = torch.where(height < 0, 2.0 * at - points[..., axis], points[..., axis])
        factor[..., axis] *= torch.where(height < 0, -1.0, 1.0)
        if centers.shape[-2] % 2:
            centers[..., -1, axis] = at
            factor[..., -1, axis] = 0.0
        return centers, factor
