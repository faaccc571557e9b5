"""Where control points may sit: inside some bodies, outside others."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.geometry.correspondence import Mask
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.parameterization import Region
from rbfevo.geometry.solids import Solid, within

Sampler = Callable[[int, int, torch.Generator], Tensor]

PLACES = 50_000  # of the lattice on which places are looked for
FINEST = 100  # of its points along an axis
ROOM = 0.9  # of the distance from a place to the closest boundary, how far from it a center may stop


class Packaging:
    """The region where no center may sit: outside of all `inside`, within one of `outside`, or in another region.

    A center there moves to the nearest place of a lattice over what is left of the box, but stops before it, as far as
    surely nothing else is in the way, so that two of them do not coincide. On a boundary centers may sit. With a mirror
    a point is in the region if its image is.

    Args:
        inside, outside: bodies; without `inside` all of the box.
        box: [3], [3] its corners, model units; mirror: the plane of symmetry, or None.
        flat: axis and coordinate of the plane in which all centers lie, or None.
        other: a further region, or None.

    Raises:
        UserError: if nothing is left of the box.
    """

    def __init__(
        self,
        inside: Sequence[Solid],
        outside: Sequence[Solid],
        box: tuple[Tensor, Tensor],
        mirror: Mirror | None = None,
        flat: tuple[int, float] | None = None,
        other: Region | None = None,
    ) -> None:
        self.inside, self.outside, self.mirror, self.other = list(inside), list(outside), mirror, other
        low, high = (corner.numpy() for corner in box)
        if inside:
            low = np.maximum(low, np.min([solid.low for solid in inside], axis=0))
            high = np.minimum(high, np.max([solid.high for solid in inside], axis=0))
        self._corners, self._flat = (low, high), flat
        self.share = 0.0
        if (low <= high).all():
            self.places, self.share = self._lattice(None)
        if not self.share:
            raise UserError("scenario.inside and scenario.outside leave no place for centers in the box")
        self._nearest, self._room = KDTree(self.places), self._rooms(self.places)
        self.extent = torch.from_numpy(self.places.min(axis=0)), torch.from_numpy(self.places.max(axis=0))
        self._pinned: tuple[Array, KDTree, Array] | None = None

    def _lattice(self, plane: tuple[int, float] | None) -> tuple[Array, float]:
        """The allowed points [q, 3] of a lattice over what may be left of the box, and their share of it.

        Args:
            plane: axis and coordinate of the plane to which it is restricted, besides the run's own; or None.
        """
        low, high = self._corners
        fixed = dict([one for one in (self._flat, plane) if one is not None])
        free = [axis for axis in range(3) if axis not in fixed]
        sides = np.maximum(high - low, 1e-12 * float(np.linalg.norm(high - low)))[free]
        cell = (float(np.prod(sides)) / PLACES) ** (1.0 / len(free))
        axes = [np.array([fixed.get(axis, 0.0)]) for axis in range(3)]
        for axis, side in zip(free, sides, strict=True):
            count = int(np.clip(np.ceil(side / cell), 2, FINEST))
            axes[axis] = low[axis] + (np.arange(count) + 0.5) * (high[axis] - low[axis]) / count
        points = np.stack([part.ravel() for part in np.meshgrid(*axes, indexing="ij")], axis=1)
        kept = points[~self._forbidden(points)]
        return kept, len(kept) / len(points)

    def _rooms(self, places: Array) -> Array:
        """How far from each place [q] no boundary is."""
        images = [places] if self.mirror is None else [places, np.asarray(self.mirror.image(places))]
        found = np.full(len(places), np.inf)
        for points in images:
            if self.inside:
                found = np.minimum(found, np.max([solid.heights(points) for solid in self.inside], axis=0))
            for solid in self.outside:
                found = np.minimum(found, -solid.heights(points))
        return ROOM * np.maximum(found, 0.0)

    def _forbidden(self, points: Array) -> Mask:
        """Which of finite points [q, 3] are in the region."""
        found = np.zeros(len(points), bool)
        for places in [points] if self.mirror is None else [points, np.asarray(self.mirror.image(points))]:
            if self.inside:
                found |= ~within(self.inside, places)
            for solid in self.outside:
                near = ~found & ((places > solid.low) & (places < solid.high)).all(axis=1)
                found[near] = solid.heights(places[near]) > 0.0
        if self.other is not None:
            found |= self.other.contains(torch.from_numpy(points)).numpy()
        return found

    def contains(self, points: Tensor) -> Tensor:
        """See `Region`."""
        flat = points.detach().cpu().reshape(-1, points.shape[-1]).numpy()
        inside = np.asarray(np.isfinite(flat).all(axis=1), bool)
        inside[inside] = self._forbidden(flat[inside])
        return torch.from_numpy(inside).view(points.shape[:-1]).to(points.device)

    def project(self, points: Tensor, kept: int | None = None) -> tuple[Tensor, Tensor]:
        """See `Region`.

        Raises:
            UserError: if a center is to stay on a plane on which nothing is left.
        """
        inside = self.contains(points)
        if not bool(inside.any()):
            return points, torch.zeros_like(points, dtype=torch.bool)
        wrong = points[inside].detach().cpu().numpy()
        places, nearest, room = (self.places, self._nearest, self._room) if kept is None else self._on_plane(kept)
        if kept is not None:
            wrong[:, kept] = places[0, kept]
        _, index = nearest.query(wrong)
        way = wrong - places[index]
        length = np.linalg.norm(way, axis=1, keepdims=True)
        stop = places[index] + way * np.minimum(1.0, room[index, None] / np.maximum(length, 1e-300))
        bad = self._forbidden(stop)  # rounding, or another region
        stop[bad] = places[index][bad]
        placed = points.clone()
        placed[inside] = torch.from_numpy(stop).to(points)
        if kept is not None:
            placed[..., kept] = points[..., kept]
        return placed, inside[..., None].expand_as(points)

    def _on_plane(self, axis: int) -> tuple[Array, KDTree, Array]:
        """The places on the plane of symmetry."""
        if self._pinned is None:
            if self.mirror is None or self.mirror.axis != axis:
                raise UserError("centers can stay on the plane of symmetry alone")
            places, share = self._lattice((axis, self.mirror.at))
            if not share:
                raise UserError(
                    "scenario.inside and scenario.outside leave no place on the plane of symmetry, where one of an odd "
                    "number of centers sits; choose an even number"
                )
            self._pinned = places, KDTree(places), self._rooms(places)
        return self._pinned

    def sampler(self, on_surface: Callable[[Region], Sampler]) -> Sampler:
        """Random centers on the parts of a surface that are left; where none are, anywhere in what is left of the box.

        Args:
            on_surface: makes the sampler of the surface outside a region, or raises UserError.
        """
        try:
            return on_surface(self)
        except UserError:
            return self.sample

    def sample(self, count: int, m: int, generator: torch.Generator) -> Tensor:
        """Draw [count, m, 3] centers, uniformly over the places and the room about each."""
        index = torch.randint(len(self.places), (count, m), generator=generator)
        noise = torch.randn(count, m, 3, generator=generator, dtype=torch.float64)
        if self._flat is not None:
            noise[..., self._flat[0]] = 0.0
        step = torch.from_numpy(np.minimum(self._room, self._spacing()))[index, None]
        drawn = torch.rand(count, m, 1, generator=generator, dtype=torch.float64)
        way = noise / noise.norm(dim=-1, keepdim=True).clamp_min(1e-300) * drawn * step
        found = torch.from_numpy(self.places)[index] + way
        bad = self.contains(found)
        return torch.where(bad[..., None], torch.from_numpy(self.places)[index], found)

    def _spacing(self) -> float:
        """The distance of neighbouring places."""
        return float(np.median(self._nearest.query(self.places[:1000], k=2)[0][:, 1])) if len(self.places) > 1 else 0.0
