"""What a descent does with a solution: keep the design or go back to the best one, and take the next step."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.descent import bounds, curvature
from rbfevo.descent.sensitivity import NO_SEGMENTS, attainable, looking_at, sign_of
from rbfevo.descent.state import Line, Proposal, Slope, Solved, State
from rbfevo.errors import UserError
from rbfevo.recorded import moves
from rbfevo.recorded.moves import predicted_change, wanted_move
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup

QUASI_NEWTON = "quasi-newton"
RULES = (*moves.RULES, QUASI_NEWTON)
HALVINGS = 6  # of the step, after which the descent ends
TOLERANCE = 1e-5  # of |J|: a smaller predicted change ends it
NOTHING = 1e-9  # of the bound of a step: a vertex that moves less does not move
FAR = 1e6  # diagonals: a step without a bound of its own
AS_PREDICTED = 0.5  # of the predicted change: from there on a step of quasi-Newton may grow again
AT_BOUND = 0.9  # of the bound: a shorter step was not limited by it


class Step(NamedTuple):
    """The next design.

    Attributes:
        weights: [m, k]; predicted: the change of J; moved: how far a vertex moves at most by the step.
        limited: whether largest displacements limit it.
    """

    weights: Array
    predicted: float | None
    moved: float
    limited: bool = False


class Descent:
    """The descent of one setup of a run; U stays on the original design, and weights accumulate.

    Args:
        record: the run; chosen: the setup; state: where the descent is, `State.begin` before the first solution.
        segments: [s, 2] of a design that is a curve.

    Raises:
        UserError: for a run without a sensitivity, or weights that do not fit the setup.
    """

    def __init__(self, record: Record, chosen: Setup, state: State, segments: Ints = NO_SEGMENTS) -> None:
        self.sign, shape = sign_of(record), (chosen.count, record.gradient.shape[1])
        if state.rule not in RULES:
            raise UserError(f"--rule {state.rule}: choose one of {', '.join(RULES)}")
        for part in (state.best, state.proposal):
            if part is not None and part.weights.shape != shape:
                raise UserError(f"the state has {len(part.weights)} centers, the setup has {chosen.count}")
        self.record, self.chosen, self.state, self.segments = record, chosen, state, segments
        self.diagonal = float(np.linalg.norm(np.ptp(record.vertices, axis=0)))

    def displacement(self, weights: Array) -> Array:
        """The displacement [n, k] of the vertices of the run under weights [m, k]."""
        return self.chosen.displacement(self.record.vertices, weights)

    def accept(self, objective: float | None, sensitivity: Array) -> Line:
        """Take the solution of the design that was proposed: it is the best one if J is better.

        Args:
            objective: J, which may be missing (None) of the original design only.
            sensitivity: [n, k] dJ/dx on the deformed design, integrated over each vertex's share of the surface.

        Raises:
            UserError: if no design waits for a solution, or J is missing.
        """
        proposal, best, state = self._waiting(), self.state.best, self.state
        if objective is None and best is not None:
            raise UserError("the objective of a design is needed, to tell whether it rose")
        if best is None and objective is not None and not math.isfinite(objective):
            raise UserError("the objective of the original design is not finite")
        real = None if objective is None or best is None or best.objective is None else objective - best.objective
        better = objective is None or (math.isfinite(objective) and (real is None or self.sign * real < 0.0))
        note = (
            ""
            if better
            else "the objective did not get better"
            if math.isfinite(objective or 0.0)
            else "J is not finite"
        )
        solved = Solved(proposal.number, proposal.weights, objective, sensitivity)
        halvings = state.halvings if better else state.halvings + 1
        if state.rule == QUASI_NEWTON:
            state = self._with_slope(state, solved)
            if better and real is not None and self._may_grow(proposal, real):
                halvings = max(0, halvings - 1)
        self.state = dataclasses.replace(state, best=solved if better else best, proposal=None, halvings=halvings)
        return self._written(proposal, objective, real, better, note)

    def fail(self, reason: str) -> Line:
        """Go back: the design that was proposed has no solution.

        Raises:
            UserError: if none waits for a solution, or it is the original one.
        """
        proposal = self._waiting()
        if self.state.best is None:
            raise UserError("the original design has no solution, and a descent cannot go back behind it")
        self.state = dataclasses.replace(self.state, proposal=None, halvings=self.state.halvings + 1)
        return self._written(proposal, None, None, False, reason)

    def propose(self, usable: Callable[[Array], str] = lambda _: "") -> Proposal | None:
        """The next design, from the best one; None at the end, where `state.ended` is the reason.

        A design that waits for its solution is proposed again.

        Args:
            usable: weights [m, k] -> why no solver can use the mesh of a design, empty if one can. The step is halved
                until it is.

        Raises:
            UserError: before the first solution.
        """
        state = self.state
        if state.ended or state.proposal is not None:
            return state.proposal
        if state.best is None:
            raise UserError("a descent begins with the solution of the original design")
        best, notes, halvings = state.best, [], state.halvings
        number = state.lines[-1].number + 1
        while halvings < HALVINGS:
            size = state.step / 2**halvings
            step = self._step(size)
            nothing = not step.moved > NOTHING * size * self.diagonal
            if nothing or self._too_little(step.predicted, best.objective):
                self.state = dataclasses.replace(state, halvings=halvings, ended=self._why(step, nothing))
                return None
            reason = usable(step.weights)
            if not reason:
                made = Proposal(number, step.weights, step.predicted, size, step.moved, tuple(notes))
                self.state = dataclasses.replace(state, halvings=halvings, proposal=made)
                return made
            notes.append(f"step {size:.3g}: {reason}")
            halvings += 1
        ended = f"the step was halved {HALVINGS} times" + (f" ({notes[-1]})" if notes else "")
        self.state = dataclasses.replace(state, halvings=halvings, ended=ended)
        return None

    @property
    def gain(self) -> float:
        """The gain [0, 1] that the setup can reach of the best design's sensitivity."""
        return attainable(self._here, self.chosen)

    def _waiting(self) -> Proposal:
        if self.state.proposal is None:
            raise UserError("no design waits for a solution")
        return self.state.proposal

    def _written(self, proposal: Proposal, objective: float | None, real: float | None, kept: bool, note: str) -> Line:
        """Add a line to the history."""
        best = None if self.state.best is None else self.state.best.objective
        notes = "; ".join([*proposal.notes, *([note] if note else [])])
        line = Line(proposal.number, objective, best, proposal.predicted, real, proposal.size, kept, notes)
        self.state = dataclasses.replace(self.state, lines=(*self.state.lines, line))
        return line

    def _with_slope(self, state: State, solved: Solved) -> State:
        """The state with the slope of a solution, where it is known."""
        if solved.objective is not None and not math.isfinite(solved.objective):
            return state
        if not np.isfinite(solved.sensitivity).all() or not solved.sensitivity.any():
            return state
        here = looking_at(self.record, solved.sensitivity, self.segments)
        if here.summary["gradient_norm"] is None:
            return state
        return dataclasses.replace(
            state, slopes=(*state.slopes, Slope(solved.weights, self._coordinates.slope_of(here)))
        )

    def _may_grow(self, proposal: Proposal, real: float) -> bool:
        """Whether a step of quasi-Newton was limited by its bound, and did what was predicted."""
        if proposal.predicted is None or proposal.moved < AT_BOUND * proposal.size * self.diagonal:
            return False
        return self.sign * real <= AS_PREDICTED * self.sign * proposal.predicted

    def _too_little(self, predicted: float | None, objective: float | None) -> bool:
        if predicted is None or objective is None:
            return False
        return not -self.sign * predicted > self.state.tolerance * abs(objective)

    def _why(self, step: Step, nothing: bool) -> str:
        if nothing:
            within = " within largest displacements" if step.limited else ""
            return f"no step of this setup gains anything{within}"
        return f"the predicted change, {step.predicted:.3g}, is below {self.state.tolerance:g} of the objective"

    @property
    def _here(self) -> Record:
        """The run with the sensitivity of the best design."""
        if self.state.best is None:
            raise UserError("a descent begins with the solution of the original design")
        return looking_at(self.record, self.state.best.sensitivity, self.segments)

    @functools.cached_property
    def _coordinates(self) -> curvature.Coordinates:
        return curvature.Coordinates(self.record, self.chosen)

    def _step(self, size: float) -> Step:
        """The step from the best design by the rule, of at most `size` diagonals; all displacements within bounds."""
        best = self.state.best
        if best is None or not best.sensitivity.any():
            return Step(np.zeros((0, 0)), None, 0.0)
        here, start, bound = self._here, self.displacement(best.weights), size * self.diagonal
        rule = moves.RULES[0] if self.state.rule == QUASI_NEWTON else self.state.rule
        first = wanted_move(_unbounded(here), self.chosen, size, rule).weights
        value = self._value(here)
        changes = [first]
        if value.curvature is not None:
            changes = [value.best_along(first), self._quasi_newton(value, bound)]
        factors = [bounds.factor(self.record.max_displacement, start, self.displacement(change)) for change in changes]
        limited = min(factors) < 1.0
        changes = [factor * change for factor, change in zip(factors, changes, strict=True)]
        if limited:
            towards = wanted_move(here, self.chosen, FAR, moves.RULES[0]).weights - best.weights
            largest = self._largest(towards)
            changes.append(value.best_along(towards * min(1.0, bound / (largest or 1.0))))
        weights = best.weights + min(changes, key=value)
        moved = self.displacement(weights) - start
        return Step(
            weights, predicted_change(here, moved), float(np.linalg.norm(moved, axis=1).max(initial=0.0)), limited
        )

    def _largest(self, weights: Array) -> float:
        """How far a vertex moves at most under weights [m, k]."""
        return float(np.linalg.norm(self.displacement(weights), axis=1).max(initial=0.0))

    def _value(self, here: Record) -> curvature.Value:
        """What a change of the weights is predicted to change: by the quadratic model where the rule has one."""
        coordinates, known = self._coordinates, self.state.slopes
        B = None
        if self.state.rule == QUASI_NEWTON and here.summary["gradient_norm"] is not None:
            B = curvature.hessian(
                [coordinates.of(one.weights) for one in known], [coordinates.slope(one.slope) for one in known]
            )
        return curvature.Value(coordinates, coordinates.slope(coordinates.slope_of(here)), B)

    def _quasi_newton(self, value: curvature.Value, bound: float) -> Array:
        """The quasi-Newton step [m, k] with displacements within a bound, model units."""
        coordinates = self._coordinates
        return coordinates.weights(value.step(lambda z: self._largest(coordinates.weights(z)), bound))


def _unbounded(record: Record) -> Record:
    """A run without largest displacements, which are of the accumulated displacement and not of a step."""
    return dataclasses.replace(record, max_displacement=None)
