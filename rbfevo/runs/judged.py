"""The rows of a result as they are saved: P of the gradient, of each objective, and what was searched in its place."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from rbfevo.methods.method import Rows
from rbfevo.scoring.combination import Combination
from rbfevo.scoring.evolvability import Scores


class Judged(NamedTuple):
    """Rows of one method scored on all vertices.

    Attributes:
        rows: with R, V, and P of the scenario's gradient: of several objectives the weighted mean of their own.
        potentials: [p, J] P of each of several objectives, or None; bounded: [p, J] P_p of each objective, where
            `criterion.norm` is not 2.
        combination: how the objectives make what was searched.
    """

    rows: Rows
    potentials: Tensor | None
    bounded: Tensor | None
    combination: Combination

    @property
    def searched(self) -> Scores:
        """The scores with what was searched in the place of P."""
        found = self.potentials if self.bounded is None else self.bounded
        if found is None:
            return self.rows.scores
        return self.rows.scores._replace(improvement_potential=self.combination(found))

    def columns(self) -> dict[str, Tensor]:
        """What the table of setups has of potentials, beside R, V and the others: [p] and [p, J]."""
        found = {"improvement_potential": self.rows.scores.improvement_potential}
        if self.bounded is not None:
            found["bounded_potential"] = self.combination.mean(self.bounded)
        if self.combination.worst:
            found["worst_potential"] = self.searched.improvement_potential
        each = {"potentials": self.potentials, "bounded_potentials": self.bounded}
        several = self.combination.count > 1
        return found | {name: values for name, values in each.items() if several and values is not None}
