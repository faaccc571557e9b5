"""What a descent knows: the best design with its sensitivity, the one that waits for its solution, and the history."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError

VERSION = 1


class Solved(NamedTuple):
    """A design with its solution.

    Attributes:
        number: 0 is the original design; weights: [m, k] of the RBFs, from the original design.
        objective: J, None where it is not known (of the original design alone); sensitivity: [n, k] dJ/dx, nodal.
    """

    number: int
    weights: Array
    objective: float | None
    sensitivity: Array


class Proposal(NamedTuple):
    """A design that waits for its solution.

    Attributes:
        number: counts all designs that were proposed to the solver; weights: [m, k] from the original design.
        predicted: the change of J from the best design, to first order; None where its unit is not known.
        size: the bound of the step, a fraction of the diagonal; moved: how far a vertex moves at most, model units.
        notes: why longer steps were given up.
    """

    number: int
    weights: Array
    predicted: float | None = None
    size: float = 0.0
    moved: float = 0.0
    notes: tuple[str, ...] = ()


class Line(NamedTuple):
    """A line of the history: a design that was proposed, and what became of it.

    Attributes:
        objective: J, None where there is no solution; best: of all designs so far.
        predicted, real: changes of J from the design that the step began at; kept: whether it became the best one.
    """

    number: int
    objective: float | None
    best: float | None
    predicted: float | None
    real: float | None
    size: float
    kept: bool
    note: str


class Slope(NamedTuple):
    """The weights [m, k] of a design that was solved, and the slope [m, k] of J by them, of a J to be minimized."""

    weights: Array
    slope: Array


@dataclasses.dataclass(frozen=True)
class State:
    """A descent.

    Attributes:
        rule, step, tolerance: how steps are chosen, how long they are at most at first (a fraction of the diagonal),
            and the predicted change, relative to J, below which the descent ends.
        best: the best design that is solved; proposal: the one that waits for its solution, None at the end.
        halvings: how often the step is halved; lines: the history; slopes: of all solutions, where the rule needs them.
        ended: why nothing more is proposed, empty before the end.
        first_gain: the gain that the setup could reach of the first sensitivity, None before it.
    """

    rule: str
    step: float
    tolerance: float
    best: Solved | None
    proposal: Proposal | None
    halvings: int = 0
    lines: tuple[Line, ...] = ()
    slopes: tuple[Slope, ...] = ()
    ended: str = ""
    first_gain: float | None = None

    @staticmethod
    def begin(shape: tuple[int, int], rule: str, step: float, tolerance: float) -> State:
        """Before the first solution, that of the original design; shape: (m, k) of the weights."""
        return State(rule, step, tolerance, None, Proposal(0, np.zeros(shape)))

    def entries(self) -> dict[str, Any]:
        """All of it but the sensitivity as JSON has it; floats come back to the bit."""
        best, proposal = self.best, self.proposal
        return {
            "rule": self.rule,
            "step": self.step,
            "tolerance": self.tolerance,
            "halvings": self.halvings,
            "ended": self.ended,
            "first_gain": self.first_gain,
            "best": best and {"number": best.number, "objective": best.objective, "weights": best.weights.tolist()},
            "proposal": proposal and {**proposal._asdict(), "weights": proposal.weights.tolist()},
            "lines": [line._asdict() for line in self.lines],
            "slopes": [{"weights": one.weights.tolist(), "slope": one.slope.tolist()} for one in self.slopes],
        }

    @staticmethod
    def of(entries: dict[str, Any], sensitivity: Array | None) -> State:
        """The state of `entries`, and the sensitivity of the best design.

        Raises:
            UserError: if something is missing or of another kind.
        """
        try:
            best, proposal = entries["best"], entries["proposal"]
            if (best is None) != (sensitivity is None):
                raise ValueError("a best design without its sensitivity")
            return State(
                rule=str(entries["rule"]),
                step=float(entries["step"]),
                tolerance=float(entries["tolerance"]),
                best=None
                if best is None or sensitivity is None
                else Solved(int(best["number"]), _rows(best["weights"]), _number(best["objective"]), sensitivity),
                proposal=None
                if proposal is None
                else Proposal(**{**proposal, "weights": _rows(proposal["weights"]), "notes": tuple(proposal["notes"])}),
                halvings=int(entries["halvings"]),
                lines=tuple(Line(**line) for line in entries["lines"]),
                slopes=tuple(Slope(_rows(one["weights"]), _rows(one["slope"])) for one in entries["slopes"]),
                ended=str(entries["ended"]),
                first_gain=_number(entries["first_gain"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"it is no state of a descent: {type(error).__name__} {error}") from None


def _rows(value: Any) -> Array:
    rows = np.asarray(value, np.float64)
    if rows.ndim != 2 or not np.isfinite(rows).all():
        raise ValueError("weights that are not finite rows")
    return rows


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
