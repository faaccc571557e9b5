"""The mid-plane of a planar design: its centers sit in it, and no displacement leaves it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rbfevo.geometry.namespaces import copied

LAYER = 1e-6  # of the diagonal: vertices that close along the axis are in one layer
STEPS = 16  # of half the last digit, within which a middle equally far from both sides to the bit is looked for


@dataclasses.dataclass(frozen=True)
class Plane:
    """The plane on which coordinate `axis` (0, 1 or 2) is `at`, `depth` away from all vertices of the design.

    `depth` is half the thickness of a slab, and 0 of a design in the plane itself; both are in model units. Points are
    arrays of NumPy or tensors of torch.
    """

    axis: int
    at: float
    depth: float = 0.0

    @staticmethod
    def between(axis: int, low: float, high: float) -> Plane:
        """The plane midway between two coordinates, to the bit as far from the one as from the other where it can be.

        Then front and back of a slab have the same distances to every center in the plane, rounding included.
        """
        middle = low + 0.5 * (high - low)
        ulp = 0.5 * float(np.spacing(max(abs(low), abs(high))))
        for step in range(STEPS):
            for at in (middle + step * ulp, middle - step * ulp):
                if at - low == high - at:
                    return Plane(axis, at, high - at)
        return Plane(axis, middle, high - middle)

    @property
    def name(self) -> str:
        """The letter of the axis."""
        return "xyz"[self.axis]

    @property
    def others(self) -> list[int]:
        """The two axes of the plane, such that with `axis` as the third they are right-handed."""
        return [(self.axis + 1) % 3, (self.axis + 2) % 3]

    def pinned(self, points: Any) -> Any:
        """Points [..., 3], moved along the axis into the plane."""
        placed = copied(points)
        placed[..., self.axis] = self.at
        return placed

    def flat(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vectors [..., 3] without their component along the axis."""
        along = np.array(vectors)
        along[..., self.axis] = 0.0
        return along


def layers(heights: NDArray[np.float64], tolerance: float) -> list[float]:
    """The distinct values among heights [n], ascending: of those within `tolerance` of the lowest, the middle one."""
    ordered, found, start = np.sort(heights), [], 0
    while start < len(ordered):
        end = int(np.searchsorted(ordered, ordered[start] + tolerance, side="right"))
        found.append(float(ordered[(start + end) // 2]))
        start = end
    return found
