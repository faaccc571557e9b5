"""The result of every scenario: a mesh, the wanted displacement, the box, and a sampler of centers."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.holding import Hold
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.parameterization import Parameterization, Region
from rbfevo.geometry.planar import Plane
from rbfevo.scenarios.objectives import Objectives

Sampler = Callable[[int, int, torch.Generator], Tensor]
Closest = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A design, where it should move, and the box its control points may sit in (all tensors float64).

    Attributes:
        name: as on the command line (`plane`, `face`).
        vertices: [n, d], d = 2 or 3, in model units.
        faces: [f, 3] int64 triangles into `vertices`.
        gradient: [n, k] estimated fitness gradient g, of unit (weighted) Frobenius norm; of several objectives those of
            all, stacked to [n, J k].
        weights: [n] positive; row i of Phi and g counts with sqrt(weights[i]); ones if uniform.
        lower, upper: [d] corners of the box, model units.
        support: default support radius of compact kernels, model units.
        sample: (count, m, generator) -> [count, m, d] random centers inside the box.
        gradient_norm: the norm that g had before it was scaled (model units; displacement = gradient * gradient_norm);
            that of huge sensitivities may be infinite.
        notes: facts for the run's log and summary (rejected pairs, the scan, ...), by title.
        closest: points [q, 3] -> closest points [q, 3] on a target that may be matched anywhere (NumPy, on the host);
            None where the wanted displacement is fixed.
        stays: [n] bool, the vertices that have no pair on that target and are to stay where they are; None if all
            have one.
        direction_only: whether g gives a direction but no length, as a sensitivity does.
        mirror: the plane that setups stay symmetric about, or None.
        keep_out: where no center may sit, or None.
        search_vertices: weighted vertices that searches look at instead of all, or None for all.
        up: the axis that is up in pictures, x, y or z.
        warnings: a line for each reason to doubt the results.
        rows: [n] which points of the template's file the vertices are, or None where there is no file.
        hold: what makes the blend anywhere in space, or None where nothing is held.
        blend: [n] from 0 (held) to 1: rows of U, and not of g, are multiplied by it; g is 0 where it is 0. Or None.
        objective: of a sensitivity, `minimize` or `maximize`; None for targets.
        smooth: length over which g was smoothed, model units, or None.
        gradient_raw: [n, k] g before smoothing, in the scale of `gradient`: displacement = gradient_raw *
            gradient_norm; None where it was not smoothed, and on coarse designs.
        planar: the mid-plane of a planar design, which is a slab one cell thick or a curve, or None. Centers sit in it,
            and g has no component along its axis.
        max_displacement: [n] how far each vertex may move at most, model units, positive; None without bounds.
        pinned: whether searches put the last center on the plane of symmetry; None: where their number is odd.
        objectives: of several sensitivities, whose fields `gradient` and `gradient_raw` stack; None of one, and of
            targets: `objective` and `gradient_norm` are then its own.
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
    direction_only: bool = False
    mirror: Mirror | None = None
    keep_out: Region | None = None
    search_vertices: int | None = None
    up: str = "y"
    warnings: list[str] = dataclasses.field(default_factory=list)
    rows: Tensor | None = None
    hold: Hold | None = None
    blend: Tensor | None = None
    objective: str | None = None
    smooth: float | None = None
    gradient_raw: Tensor | None = None
    planar: Plane | None = None
    pinned: bool | None = None
    max_displacement: Tensor | None = None
    objectives: Objectives | None = None

    def __post_init__(self) -> None:
        n, d = self.vertices.shape
        if (
            self.gradient.shape[0] != n
            or self.weights.shape != (n,)
            or self.lower.shape != (d,)
            or self.upper.shape != (d,)
            or (self.stays is not None and self.stays.shape != (n,))
            or (self.blend is not None and self.blend.shape != (n,))
            or (self.max_displacement is not None and self.max_displacement.shape != (n,))
            or (self.gradient_raw is not None and self.gradient_raw.shape != self.gradient.shape)
            or (self.objectives is not None and self.gradient.shape[1] % len(self.objectives))
        ):
            raise UserError(f"scenario {self.name}: vertices, gradient, weights and box have shapes that do not match")
        for name in ("vertices", "gradient", "weights", "lower", "upper"):
            if not bool(torch.isfinite(getattr(self, name)).all()):
                raise UserError(f"scenario {self.name}: {name} has values that are not finite")

    @property
    def fields(self) -> Tensor:
        """The wanted displacement [J, n, k] of each objective, of unit norm (but for that of coarse designs)."""
        return self.gradient[None] if self.objectives is None else self.objectives.fields(self.gradient)

    def each(self) -> list[Scenario]:
        """The same design once for each objective, with its wanted displacement alone."""
        if self.objectives is None:
            return [self]
        parts = {"objectives": None, "gradient_raw": None}
        return [dataclasses.replace(self, gradient=field, **parts) for field in self.fields]

    @property
    def diagonal(self) -> float:
        """Length of the box's diagonal, of a planar design of that of its cut with the mid-plane, model units."""
        sides = self.upper - self.lower
        if self.planar is not None:
            sides = sides[self.planar.others]
        return float(sides.norm())

    @property
    def side(self) -> float:
        """On which side of the mirror the centers sit: the one that reaches farther, +1 or -1."""
        if self.mirror is None:
            return 1.0
        axis, at = self.mirror.axis, self.mirror.at
        return 1.0 if float(self.upper[axis]) - at >= at - float(self.lower[axis]) else -1.0

    @property
    def search_box(self) -> tuple[Tensor, Tensor]:
        """Corners [d], [d] of the box that centers are searched in: the half on one side of the mirror, if any."""
        lower, upper = self.lower.clone(), self.upper.clone()
        if self.mirror is not None:
            (lower if self.side > 0 else upper)[self.mirror.axis] = self.mirror.at
        return lower, upper

    @property
    def parameterization(self) -> Parameterization:
        """The map from points in the box to setups."""
        return Parameterization(self.mirror, self.side, self.keep_out, self.planar, self.pinned)

    def wanting(self, wanted: Tensor) -> Scenario:
        """The same design with another wanted displacement [n, k], model units; its notes and warnings stay.

        Raises:
            UserError: if it is 0 wherever vertices may move, or the design smooths, has several objectives or two
                dimensions: then its sensitivity has to be read again.
        """
        if self.smooth is not None or self.objectives is not None or self.planar is not None:
            raise UserError(f"scenario {self.name}: its wanted displacement cannot be replaced")
        if self.stays is not None:
            wanted = torch.where(self.stays[:, None], 0.0, wanted)
        gradient, norm = unit_gradient(wanted, self.weights)
        return dataclasses.replace(self, gradient=gradient, gradient_norm=norm)

    def half(self, open_only: bool = False) -> Scenario:
        """The design on the centers' side of the mirror, plane included; the whole one where there is no mirror.

        With `open_only`, without the vertices in the region where no center may sit. If no vertex that should move is
        left, it is the whole design. It has no faces.
        """
        if self.mirror is None and not (open_only and self.keep_out is not None):
            return self
        kept = torch.ones_like(self.weights, dtype=torch.bool)
        if self.mirror is not None:
            height = self.side * (self.vertices[:, self.mirror.axis] - self.mirror.at)
            kept = height >= -self.mirror.tolerance
        if open_only and self.keep_out is not None:
            kept &= ~self.keep_out.contains(self.vertices)
        parts = self._rows(kept)
        if not bool((parts["gradient"] != 0).any()):
            return self
        return dataclasses.replace(self, **parts, faces=self.faces[:0], closest=None, stays=None, gradient_raw=None)

    def front(self) -> Scenario:
        """Of a slab the vertices on one side, with twice their weights; any other design as it is.

        Both sides have the same distances to every center in the mid-plane and the same g, so that R and P are those of
        the whole slab. It has no faces.
        """
        if self.planar is None or self.planar.depth == 0.0:
            return self
        kept = self.vertices[:, self.planar.axis] > self.planar.at
        parts = self._rows(kept)
        parts["weights"] = 2.0 * parts["weights"]
        return dataclasses.replace(self, **parts, faces=self.faces[:0], closest=None, stays=None, gradient_raw=None)

    def _rows(self, kept: Tensor) -> dict[str, Any]:
        """What each vertex has, of those that are `kept` [n]."""
        names = ("vertices", "gradient", "weights", "blend", "max_displacement")
        return {name: getattr(self, name)[kept] for name in names if getattr(self, name) is not None}

    def to(self, device: torch.device) -> Scenario:
        """The same scenario with its tensors on `device`."""
        names = ("vertices", "faces", "gradient", "weights", "lower", "upper", "stays", "blend", "gradient_raw")
        names = (*names, "max_displacement")
        values = {name: getattr(self, name) for name in names}
        moved: dict[str, Any] = {name: value.to(device) for name, value in values.items() if value is not None}
        return dataclasses.replace(self, **moved)


def unit_gradient(gradient: Tensor, weights: Tensor) -> tuple[Tensor, float]:
    """Scale `gradient` [n, k] to unit weighted Frobenius norm (paper, eq. 8); return it and the norm it had.

    The norm is right for numbers of any size, and infinite only if it is too large for a float itself.

    Raises:
        UserError: if the gradient is zero everywhere, so that there is nothing to improve.
    """
    scaled, exponent = near_one(gradient.numpy())
    gradient = torch.from_numpy(scaled)
    norm = float(torch.sqrt((weights[:, None] * gradient**2).sum()))
    if not norm > 0.0:
        raise UserError("the estimated fitness gradient is zero at every vertex: is the target the template itself?")
    return gradient / norm, times_power_of_two(norm, exponent)


def near_one(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """Values times 2^-e, and e, such that the largest is from 0.5 to 1: no square overflows or underflows.

    Powers of two are exact, so values of ordinary size lead to the same digits with and without this scaling.
    """
    exponent = math.frexp(float(np.abs(values).max(initial=0.0)))[1]
    return np.ldexp(values, -exponent), exponent


def times_power_of_two(value: float, exponent: int) -> float:
    """value 2^exponent, infinite where that is too large."""
    try:
        return math.ldexp(value, exponent)
    except OverflowError:
        return math.inf
