"""From points in the box to centers: setups stay symmetric, planar, and out of the region where no center may sit."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.planar import Plane


class Region(Protocol):
    """Where no center may sit, and with a mirror no image of one."""

    def contains(self, points: Tensor) -> Tensor:
        """Which of points [..., d] lie in the region, [...] bool; points that are not finite do not."""
        ...

    def project(self, points: Tensor, kept: int | None = None) -> tuple[Tensor, Tensor]:
        """Points [..., d] outside the region near `points`, and where that changed a coordinate [..., d].

        Args:
            kept: an axis whose coordinate is not to change, or None.
        """
        ...


class BoxRegion:
    """The inside of a box [d], [d]; centers leave it through its nearest side that lies within the scenario's box.

    With a mirror, it is the box and its image; where they meet the plane, centers do not leave through it.
    """

    def __init__(
        self, lower: Tensor, upper: Tensor, within: tuple[Tensor, Tensor], mirror: Mirror | None = None
    ) -> None:
        self.lower, self.upper, self.mirror = lower.clone(), upper.clone(), mirror
        if mirror is not None:  # as distances from the plane, which are the same on both sides
            a, b = float(lower[mirror.axis]) - mirror.at, float(upper[mirror.axis]) - mirror.at
            near, far = sorted((abs(a), abs(b)))
            self.lower[mirror.axis], self.upper[mirror.axis] = (-torch.inf if a <= 0 <= b else near), far
            ends = torch.stack(within)[:, mirror.axis] - mirror.at
            within = (within[0].clone(), within[1].clone())
            within[0][mirror.axis], within[1][mirror.axis] = 0.0, float(ends.abs().max())
        self._down = torch.where(
            self.lower > within[0], 0.0, torch.inf
        )  # a side that no center can cross is no way out
        self._up = torch.where(self.upper < within[1], 0.0, torch.inf)

    def _heights(self, points: Tensor) -> Tensor:
        """Points with their distance from the mirror's plane in the place of the coordinate across it."""
        if self.mirror is None:
            return points
        points = points.clone()
        points[..., self.mirror.axis] = (points[..., self.mirror.axis] - self.mirror.at).abs()
        return points

    def contains(self, points: Tensor) -> Tensor:
        """See `Region`."""
        heights = self._heights(points)
        return ((heights > self.lower.to(points)) & (heights < self.upper.to(points))).all(-1)

    def project(self, points: Tensor, kept: int | None = None) -> tuple[Tensor, Tensor]:
        """See `Region`; points that cannot leave stay where they are."""
        lower, upper, heights = self.lower.to(points), self.upper.to(points), self._heights(points)
        ways = torch.stack((heights - lower + self._down.to(points), upper - heights + self._up.to(points)), dim=-2)
        if kept is not None:
            ways[..., kept] = torch.inf
        depth, way = ways.flatten(-2).min(-1)
        axis = way % points.shape[-1]
        side = torch.where(way < points.shape[-1], lower[axis], upper[axis])
        if self.mirror is not None:
            sign = torch.where(points[..., self.mirror.axis] < self.mirror.at, -1.0, 1.0)
            side = torch.where(axis == self.mirror.axis, self.mirror.at + sign * side, side)
        moved = torch.zeros_like(points, dtype=torch.bool).scatter_(-1, axis[..., None], True)
        moved &= (self.contains(points) & depth.isfinite())[..., None]
        return torch.where(moved, side[..., None], points), moved


class VertexRegion:
    """All points that are closer to a fixed vertex than to a free one.

    Centers move towards the nearest free vertex, but stop a little before it, so that two of them do not coincide.
    With a mirror a point is in the region if its image is.
    """

    def __init__(self, vertices: Tensor, fixed: Tensor, mirror: Mirror | None = None) -> None:
        self.mirror = mirror
        points, self._fixed = vertices.cpu(), fixed.cpu().numpy()
        self._all = KDTree(points.numpy())
        free, held = points[~fixed.cpu()], points[fixed.cpu()]
        open_to_centers, near = free, KDTree(free.numpy())
        if mirror is not None:
            open_to_centers, held = torch.cat((free, mirror.image(free))), torch.cat((held, mirror.image(held)))
            open_to_centers = open_to_centers[~self.contains(open_to_centers)]
        self._open = open_to_centers.numpy()
        self._nearest = KDTree(self._open) if len(self._open) else None
        own = near.query(self._open)[0] if len(self._open) else np.empty(0)
        if mirror is not None and len(self._open):
            own = np.maximum(own, near.query(mirror.image(open_to_centers).numpy())[0])
        away = KDTree(held.numpy()).query(self._open)[0] if len(self._open) else np.empty(0)
        self._room = 0.45 * (away - own)  # within this distance the free vertex is the closest

    def contains(self, points: Tensor) -> Tensor:
        """See `Region`."""
        inside = self._closest_is_fixed(points)
        return inside if self.mirror is None else inside | self._closest_is_fixed(self.mirror.image(points))

    def _closest_is_fixed(self, points: Tensor) -> Tensor:
        flat = points.detach().cpu().reshape(-1, points.shape[-1]).numpy()
        inside = np.asarray(np.isfinite(flat).all(axis=1), bool)
        inside[inside] = self._fixed[self._all.query(flat[inside])[1]]
        return torch.from_numpy(inside).view(points.shape[:-1]).to(points.device)

    def project(self, points: Tensor, kept: int | None = None) -> tuple[Tensor, Tensor]:
        """See `Region`; `kept` is put back afterwards, which may lead back into the region."""
        inside = self.contains(points)
        if self._nearest is None or not bool(inside.any()):
            return points, torch.zeros_like(points, dtype=torch.bool)
        places = points[inside].detach().cpu().numpy()
        _, index = self._nearest.query(places)
        way = places - self._open[index]
        length = np.linalg.norm(way, axis=1, keepdims=True)
        stop = self._open[index] + way * np.minimum(1.0, self._room[index, None] / np.maximum(length, 1e-300))
        placed = points.clone()
        placed[inside] = torch.from_numpy(stop).to(points)
        if kept is not None:
            placed[..., kept] = points[..., kept]
        return placed, inside[..., None].expand_as(points)


class Parameterization:
    """Centers [*pop, m, d] from points [*pop, m, d] anywhere in the box; the identity if nothing restricts them.

    With a mirror, points on the other side are mirrored, and if m is odd (or if `pinned`, whatever m) the last one is
    put on the plane. Points leave the region, the one on the plane along it. In a planar design all are put on its
    mid-plane, which is not the mirror's, and stay there: its region must reach through it, as `scenarios.fixing` makes
    it.
    """

    def __init__(
        self,
        mirror: Mirror | None = None,
        side: float = 1.0,
        region: Region | None = None,
        planar: Plane | None = None,
        pinned: bool | None = None,
    ) -> None:
        """`side` is +1 or -1: on which side of the mirror the centers sit; their images sit on the other."""
        self.mirror, self.side, self.region, self.planar = mirror, side, region, planar
        self.pinned = pinned
        self._last: tuple[Tensor, Tensor, Tensor] | None = None

    def pins(self, count: int) -> bool:
        """Whether the last of so many centers is put on the mirror's plane."""
        return self.mirror is not None and (count % 2 == 1 if self.pinned is None else self.pinned)

    @property
    def _free(self) -> bool:
        return self.mirror is None and self.region is None and self.planar is None

    def __call__(self, points: Tensor) -> Tensor:
        """Centers from points."""
        return self._place(points)[0]

    def pull(self, points: Tensor, gradient: Tensor) -> Tensor:
        """The gradient [*pop, m, d] in the centers, as one in the points that they were made from.

        A coordinate that was changed to leave the region counts as constant.
        """
        if self._free:
            return gradient
        return gradient * self._place(points)[1]

    def settle(self, centers: Tensor) -> Tensor:
        """Centers of a heuristic [*pop, m, d]: of an odd number the one nearest to the plane is moved onto it."""
        if self.mirror is not None and self.pins(centers.shape[-2]):
            distance = (centers[..., self.mirror.axis] - self.mirror.at).abs()
            order = distance.argsort(dim=-1, descending=True, stable=True)
            centers = centers.gather(-2, order[..., None].expand_as(centers))
        return self(centers)

    def _place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Centers, and the derivative of each coordinate by the point's: 1, -1 or 0."""
        if self._free:
            return points, torch.ones_like(points)
        if (
            self._last is not None and self._last[0] is points
        ):  # a gradient is pulled back where its value was asked for
            return self._last[1:]
        centers, factor = self._folded(points, torch.ones_like(points))
        if self.region is not None:
            pinned = self.pins(centers.shape[-2])
            free = centers.shape[-2] - pinned
            placed, moved = self.region.project(centers[..., :free, :])
            if pinned and self.mirror is not None:
                last, shifted = self.region.project(centers[..., free:, :], self.mirror.axis)
                placed, moved = torch.cat((placed, last), dim=-2), torch.cat((moved, shifted), dim=-2)
            centers, factor = self._folded(placed, torch.where(moved, 0.0, factor))
        self._last = points, centers, factor
        return centers, factor

    def _folded(self, points: Tensor, factor: Tensor) -> tuple[Tensor, Tensor]:
        """Points in the mid-plane and on one side of the mirror, the last of an odd number of them on its plane."""
        if self.planar is not None:
            points, factor = self.planar.pinned(points), factor.clone()
            factor[..., self.planar.axis] = 0.0
        if self.mirror is None:
            return points, factor
        axis, at = self.mirror.axis, self.mirror.at
        height = self.side * (points[..., axis] - at)
        centers, factor = points.clone(), factor.clone()
        centers[..., axis] = torch.where(height < 0, 2.0 * at - points[..., axis], points[..., axis])
        factor[..., axis] *= torch.where(height < 0, -1.0, 1.0)
        if self.pins(centers.shape[-2]):
            centers[..., -1, axis] = at
            factor[..., -1, axis] = 0.0
        return centers, factor
