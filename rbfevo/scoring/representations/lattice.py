"""A lattice of control points in a box that may be turned: where it lies, and its basis functions, NumPy and torch.

Sederberg & Parry, "Free-form deformation of solid geometric models", SIGGRAPH 1986, with Bernstein polynomials or
B-splines. A genotype is centre [d], half axes [d], the angle (radians) where the box is turned, and inner knots in
(0, 1), axis after axis, where these are searched.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfevo.geometry.namespaces import namespace
from rbfevo.scoring.representations import bsplines

if TYPE_CHECKING:
    from torch import Tensor

EDGE = 1e-9  # of a side of the box: so far outside a point still belongs to it; rounding


@dataclasses.dataclass(frozen=True)
class Lattice:
    """Counts [d] of control points along the axes of a box, and degrees [d] of their basis functions.

    Attributes:
        turn: the axis (0, 1, 2) that the box is turned about, on the plane 2, or None.
        knots: whether genotypes have inner knots; they are evenly spaced otherwise.
    """

    counts: tuple[int, ...]
    degrees: tuple[int, ...]
    turn: int | None = None
    knots: bool = False

    @property
    def dimension(self) -> int:
        """d."""
        return len(self.counts)

    @property
    def inner(self) -> tuple[int, ...]:
        """Inner knots of each axis."""
        return tuple(n - p - 1 for n, p in zip(self.counts, self.degrees, strict=True))

    @property
    def size(self) -> int:
        """D, the numbers of a genotype."""
        return 2 * self.dimension + (self.turn is not None) + self.knots * sum(self.inner)

    @property
    def first_knot(self) -> int:
        """Where the inner knots of a genotype begin."""
        return 2 * self.dimension + (self.turn is not None)

    @property
    def turned(self) -> tuple[int, int]:
        """The two axes that a turn mixes, the first towards the second."""
        return (0, 1) if self.dimension == 2 or self.turn is None else ((self.turn + 1) % 3, (self.turn + 2) % 3)

    def away(self, points: Any, genotypes: Any) -> Any:
        """Points [q, d] from the centre along the axes of the box: [*pop, q, d], model units."""
        away = points - genotypes[..., None, : self.dimension]
        return away if self.turn is None else self._rotated(away, -genotypes[..., None, 2 * self.dimension])

    def local(self, points: Any, genotypes: Any) -> tuple[Any, Any]:
        """Coordinates [*pop, q, d] in [0, 1] of points [q, d] in the box, and which lie in it [*pop, q].

        Those of a point outside are 0.5.
        """
        xp, d = namespace(points), self.dimension
        half = genotypes[..., None, d : 2 * d]
        with np.errstate(all="ignore") if xp is np else contextlib.nullcontext():
            u = 0.5 + self.away(points, genotypes) / (2.0 * half)
            inside = (abs(u - 0.5) <= 0.5 + EDGE).all(-1) & (half > 0.0).all(-1)
        return xp.where(inside[..., None], u, 0.5).clip(0.0, 1.0), inside

    def pull(self, points: Tensor, genotypes: Tensor, du: Tensor) -> Tensor:
        """The gradient [p, D] of a function whose gradient in the coordinates of points [q, d] is du [p, q, d].

        Inner knots get none.
        """
        import torch

        d, (a, b) = self.dimension, self.turned
        away, half = self.away(points, genotypes), genotypes[:, None, d : 2 * d]
        dv = du / (2.0 * half)
        found = torch.zeros_like(genotypes)
        found[:, d : 2 * d] = -(dv * away / half).sum(1)
        if self.turn is not None:
            found[:, 2 * d] = (dv[..., a] * away[..., b] - dv[..., b] * away[..., a]).sum(1)
            dv = self._rotated(dv, genotypes[:, None, 2 * d])
        found[:, :d] = -dv.sum(1)
        return found

    def knots_of(self, genotypes: Any, axis: int) -> Any:
        """Clamped knots [*pop, n + p + 1] of an axis."""
        k, p = self.inner[axis], self.degrees[axis]
        if self.knots:
            begin = self.first_knot + sum(self.inner[:axis])
            return bsplines.clamped(genotypes[..., begin : begin + k], p)
        knots = bsplines.clamped(bsplines.uniform(self.counts[axis], p), p)
        return knots if isinstance(genotypes, np.ndarray) else genotypes.new_tensor(knots)

    def values(self, u: Any, genotypes: Any, axis: int) -> Any:
        """The basis functions [*pop, q, n] of an axis at its coordinates u [*pop, q]."""
        p = self.degrees[axis]
        return bsplines.basis(u, self.knots_of(genotypes, axis), p) if self.inner[axis] else bsplines.bernstein(u, p)

    def slopes(self, u: Any, genotypes: Any, axis: int) -> Any:
        """Their derivatives [*pop, q, n] by u."""
        return bsplines.slopes(u, self.knots_of(genotypes, axis), self.degrees[axis])

    def places(self, genotypes: Any) -> Any:
        """The control points [*pop, n_1, ..., n_d, d] that deform nothing: at the Greville abscissae."""
        xp, d = namespace(genotypes), self.dimension
        pop, grids = genotypes.shape[:-1], []
        for axis, count in enumerate(self.counts):
            g = bsplines.greville(self.knots_of(genotypes, axis), self.degrees[axis])
            shape = [1] * d
            shape[axis] = count
            grids.append(xp.broadcast_to(g.reshape(*g.shape[:-1], *shape), (*pop, *self.counts)))
        away = (xp.stack(grids, -1) - 0.5) * (2.0 * self._along(genotypes[..., d : 2 * d]))
        if self.turn is not None:
            away = self._rotated(away, genotypes[..., 2 * d].reshape(*pop, *[1] * d))
        return away + self._along(genotypes[..., :d])

    def _along(self, rows: Any) -> Any:
        """Rows [*pop, d] for each point of a lattice: [*pop, 1, ..., 1, d]."""
        return rows.reshape(*rows.shape[:-1], *[1] * self.dimension, self.dimension)

    def _rotated(self, away: Any, angle: Any) -> Any:
        """Vectors [..., d] turned by an angle [...]."""
        xp, (a, b) = namespace(away), self.turned
        cosine, sine = xp.cos(angle), xp.sin(angle)
        parts = [away[..., axis] for axis in range(self.dimension)]
        parts[a], parts[b] = cosine * away[..., a] - sine * away[..., b], sine * away[..., a] + cosine * away[..., b]
        return xp.stack(parts, -1)
