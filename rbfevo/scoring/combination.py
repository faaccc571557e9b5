"""The potentials of several objectives of one design, and how they make the one that is searched.

The gradients g_j, each of unit norm, are stacked: g = [sqrt(s_1) g_1 | ... | sqrt(s_J) g_J] with shares s_j of sum 1.
Then P of the stacked g is the weighted mean of the objectives' own P_j = |Q^T g_j|^2, and one pass over the vertices,
whose b = Phi^T g has a block of columns for each, gives all of them.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from rbfevo.scenarios.objectives import Objectives

LEAST_RESIDUAL = 1e-9  # floor of 1 - P in the smooth minimum: no gradient below


@dataclasses.dataclass(frozen=True)
class Combination:
    """How J potentials make one: their weighted mean, or the least of them.

    Attributes:
        shares: s_j [J] of sum 1: of |g|^2, and of the mean; worst: whether the least one is searched.
    """

    shares: tuple[float, ...] = (1.0,)
    worst: bool = False

    @staticmethod
    def of(objectives: Objectives | None) -> Combination:
        """That of a scenario's objectives, of one where there are none."""
        return ONE if objectives is None else Combination(objectives.shares, objectives.worst)

    @property
    def count(self) -> int:
        """J."""
        return len(self.shares)

    @property
    def mean(self) -> Combination:
        """The mean of the same objectives."""
        return dataclasses.replace(self, worst=False)

    def norms(self, rows: Tensor) -> Tensor:
        """Squared norms [*, J] of each objective's part of columns [*, q, K], as if its g had unit norm."""
        if self.count == 1:
            return rows.square().sum((-2, -1))[..., None]
        return rows.square().sum(-2).unflatten(-1, (self.count, -1)).sum(-1) / self._like(rows)

    def __call__(self, potentials: Tensor) -> Tensor:
        """The potential [*] that is searched, from those of the objectives [*, J]; maximized."""
        if self.count == 1:
            return potentials[..., 0]
        return potentials.amin(-1) if self.worst else (potentials * self._like(potentials)).sum(-1)

    def slopes(self, potentials: Tensor) -> Tensor:
        """The gradient [*, J] of that potential in those of the objectives; of equally small ones the first counts."""
        if not self.worst:
            return self._like(potentials).expand_as(potentials)
        active = potentials.argmin(-1, keepdim=True)
        return torch.zeros_like(potentials).scatter_(-1, active, 1.0)

    def smooth(self, potentials: Tensor, sharpness: float) -> tuple[Tensor, Tensor]:
        """A smooth stand-in [*] for that potential to climb on, and its gradient [*, J].

        For the least one, 1 - (mean_j r_j^q)^(1/q) with the residuals r_j = 1 - P_j and q = sharpness: the least P
        where all are equal, and never below it; its residual is too small by a factor of at most J^(1/q).
        """
        if not self.worst:
            return self(potentials), self.slopes(potentials)
        residuals = (1.0 - potentials).clamp_min(LEAST_RESIDUAL)
        powers = sharpness * residuals.log()
        whole = ((torch.logsumexp(powers, -1) - powers.new_tensor(self.count).log()) / sharpness).exp()
        slopes = torch.softmax(powers, -1) * whole[..., None] / residuals
        return 1.0 - whole, torch.where(1.0 - potentials > LEAST_RESIDUAL, slopes, 0.0)

    def spread(self, slopes: Tensor, columns: int) -> Tensor:
        """Gradients [*, K] in the squared norms of the columns of b from those in the objectives' potentials [*, J]."""
        return (slopes / self._like(slopes)).repeat_interleave(columns // self.count, -1)

    def _like(self, values: Tensor) -> Tensor:
        return values.new_tensor(self.shares)


ONE = Combination()
