"""Several objectives of one design, such as drag and lift or the load cases of one J, and their stacked gradient."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Objectives:
    """J objectives, two or more, whose wanted displacements g_j [n, k] of unit norm a scenario's gradient stacks.

    Attributes:
        names: unequal ones, for tables, pages and commands; sources: as `scenario.sensitivity` lists them.
        directions: `minimize` or `maximize` of each.
        shares: s_j, of sum 1, of the weighted mean of their potentials.
        worst: whether the least of the potentials is searched, not their mean.
        norms: that each sensitivity had before it was scaled; those of huge ones may be infinite.
    """

    names: tuple[str, ...]
    sources: tuple[str, ...]
    directions: tuple[str, ...]
    shares: tuple[float, ...]
    worst: bool
    norms: tuple[float, ...]

    def __len__(self) -> int:
        return len(self.names)

    def stacked(self, fields: Sequence[Tensor]) -> Tensor:
        """[sqrt(s_1) g_1 | ... | sqrt(s_J) g_J], [n, J k], of fields g_j [n, k]: of unit norm where each of them is."""
        return torch.cat([math.sqrt(share) * field for share, field in zip(self.shares, fields, strict=True)], dim=1)

    def fields(self, stacked: Tensor) -> Tensor:
        """The fields [J, n, k] that are stacked."""
        roots = torch.tensor(self.shares, dtype=stacked.dtype, device=stacked.device).sqrt()
        return stacked.unflatten(1, (len(self), -1)).movedim(1, 0) / roots[:, None, None]

    @property
    def note(self) -> str:
        """What is asked of them, in a line."""
        listed = ", ".join(
            f"{name} ({direction}{'' if self.worst else f', share {share:.3g}'})"
            for name, direction, share in zip(self.names, self.directions, self.shares, strict=True)
        )
        how = "the least of their potentials" if self.worst else "the weighted mean of their potentials"
        return f"{len(self)} objectives, searched for {how}: {listed}"
