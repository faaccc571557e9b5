"""A nested sequence for bounded potential: one center after the other, each where it raises P_p the most.

Bounded potential has no closed form for the gain of another center. What a candidate with column phi promises is
bounded from below along one line: with d the best displacement so far, |d|_p = 1, G = a.d and r = a - G h what is left
of the gradient of the gain, d moves along phi v, v = phi^T r / |phi^T r|, by the most promising of a few lengths. The
candidates that promise most are then solved exactly. For p = 2 and without the screening these are the picks of
orthogonal least squares.

Of several objectives each has a best displacement of its own; what is raised the most is the mean of their P_p, or the
least of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.candidates import TooFewCandidatesError, atoms_of, candidates_of
from rbfevo.scenarios.coarse import coarsened
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.bounded import BoundedPotential, bounded_of
from rbfevo.scoring.combination import ONE, Combination
from rbfevo.scoring.representations import Representation
from rbfevo.scoring.threads import run_in_slices

TRIED = 8  # candidates a pick that are solved exactly
LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.2)  # of a move along a candidate, over the largest |phi_i|
TIE = 1e-9  # of P_p: the lowest index wins
FEWER = 12  # candidates along an axis: each pick looks at all of them
VERTICES = 1500  # weighted ones, of the design on which centers are picked
BLOCK = 16  # candidates at a time: their columns stay in cache


class Sequence(NamedTuple):
    """Centers [count, d] in the order picked, their candidate indices [count], and P_p [count] with each added."""

    centers: Tensor
    indices: Tensor
    potential: Tensor


@torch.no_grad()
def nested(
    bounded: BoundedPotential | list[BoundedPotential],
    columns: Callable[[Tensor], Tensor],
    assemble: Callable[[Tensor], Tensor],
    candidates: Tensor,
    count: int,
    tried: int = TRIED,
    kept: Tensor | None = None,
    combination: Combination = ONE,
) -> Sequence:
    """Pick `count` of `candidates` [c, d] greedily, to maximize bounded potential.

    Args:
        bounded: P_p of the design, without a plane of symmetry; of several objectives that of each.
        columns: maps centers [b, d] to their columns [n, b], without the blend.
        assemble: makes setups of centers [*pop, m, d].
        candidates: [c, d], model units.
        tried: candidates solved exactly for each pick; all of them are those of the definition.
        kept: [q, d] centers that are there already; none of them is returned.
        combination: of several objectives.

    Raises:
        TooFewCandidatesError: if fewer than `count` candidates move anything.
    """
    each = bounded if isinstance(bounded, list) else [bounded]
    screens = [_Screen(one, columns, candidates) for one in each]
    chosen: list[int] = []
    values: list[Tensor] = []
    k = each[0].a.shape[1]
    there = candidates[:0] if kept is None else kept
    weights = [one.a.new_zeros(0, k) for one in each]
    if len(there):
        weights = [one.optima(assemble(there[None]), None, gap=0.0).weights[0] for one in each]
        for screen, own in zip(screens, weights, strict=True):
            screen.move(there, own)
    for t in range(count):
        promise = _promised(screens, combination)
        promise[chosen] = -torch.inf
        rows = promise.topk(min(tried, len(candidates) - t)).indices
        rows = rows[torch.isfinite(promise[rows])].sort().values
        if not len(rows):
            raise TooFewCandidatesError(
                f"only {t} of the {len(candidates)} candidates move anything, for {count} centers: ask for fewer "
                "centers or enlarge the support radius",
                t,
            )
        before = torch.cat((there, candidates[torch.tensor(chosen, dtype=torch.long)]))
        before = before.expand(len(rows), len(there) + t, -1)
        setups = assemble(torch.cat((before, candidates[rows, None]), dim=1))
        known = [torch.cat((own, own.new_zeros(1, k))).expand(len(rows), -1, -1) for own in weights]
        begun = t + len(there) > 0
        starts = [torch.cat((setups.flatten(1), own.flatten(1)), dim=1) if begun else None for own in known]
        pairs = zip(each, starts, strict=True)
        found = [one.optima(setups, start, gap=0.0) for one, start in pairs]
        potential = combination(torch.stack([one.values for one in found], dim=1))
        best = int((potential >= potential.max() - TIE).nonzero()[0])
        chosen.append(int(rows[best]))
        values.append(potential[best])
        weights = [one.weights[best] for one in found]
        for screen, own in zip(screens, weights, strict=True):
            screen.move(torch.cat((there, candidates[torch.tensor(chosen)])), own)
    indices = torch.tensor(chosen)
    return Sequence(candidates[indices], indices, torch.stack(values))


def nested_of(
    scenario: Scenario,
    representation: Representation,
    norm: float,
    count: int,
    per_axis: int = FEWER,
    kept: Tensor | None = None,
) -> Sequence:
    """The nested sequence of a design: on at most `VERTICES` weighted vertices, of half of a symmetric one.

    Args:
        scenario: the design; norm: p; count: centers; per_axis: candidates along each axis of the grid over the box.
        kept: [q, d] centers that are there already, beside the `count` that are picked.

    Raises:
        UserError: if the representation does not consist of centers, or too few candidates move anything.
    """
    if representation.candidates() is not None:
        raise UserError(
            f"method=ols picks control points of representation={representation.name} for criterion.norm=2 alone"
        )
    design, representation = coarsened(scenario.half(), VERTICES), representation.placed_by
    columns = atoms_of(representation, design)
    bounded = [bounded_of(alone, representation, norm) for alone in design.each()]

    def assemble(centers: Tensor) -> Tensor:
        setups = representation.assemble(centers)
        return centers if setups is None else setups

    combination, candidates = Combination.of(scenario.objectives), candidates_of(scenario, per_axis)
    return nested(bounded, columns, assemble, candidates, count, kept=kept, combination=combination)


def _promised(screens: list[_Screen], combination: Combination) -> Tensor:
    """[c] what each candidate promises, to compare candidates; -inf for those that move nothing."""
    promises = [screen.promise() for screen in screens]
    if combination.count == 1:
        return promises[0]
    moving = torch.stack(promises).isfinite().any(0)
    potentials = [
        (torch.where(promise.isfinite(), promise, screen.gain).clamp_min(0.0) / screen.bounded.dual) ** 2
        for screen, promise in zip(screens, promises, strict=True)
    ]
    return torch.where(moving, combination(torch.stack(potentials, dim=1)), -torch.inf)


class _Screen:
    """The best displacement of the centers picked so far, and what another candidate promises beside it."""

    def __init__(self, bounded: BoundedPotential, columns: Callable[[Tensor], Tensor], candidates: Tensor) -> None:
        self.bounded, self._columns, self.candidates = bounded, columns, candidates
        self.d, self.left = torch.zeros_like(bounded.a), bounded.a
        self.gain = 0.0

    def columns(self, centers: Tensor) -> Tensor:
        """[n, b] with the blend."""
        found = self._columns(centers)
        return found if self.bounded.blend is None else self.bounded.blend[:, None] * found

    def move(self, centers: Tensor, weights: Tensor) -> None:
        """Take the best displacement of the centers picked, Phi w with |Phi w|_p = 1."""
        u, p = self.bounded.u, self.bounded.p
        self.d = self.columns(centers) @ weights
        self.gain = float((self.bounded.a * self.d).sum())
        h = (u * self.d.square().sum(1) ** (0.5 * p - 1.0))[:, None] * self.d
        self.left = self.bounded.a - self.gain * h

    def promise(self) -> Tensor:
        """[c] a gain a.d / |d|_p that each candidate reaches at least; -inf for those that move nothing."""
        found = torch.full((len(self.candidates),), -torch.inf, dtype=self.d.dtype)

        def work(begin: int, end: int) -> None:
            for block in range(begin, end):
                these = slice(block * BLOCK, (block + 1) * BLOCK)
                found[these] = self._along(self.columns(self.candidates[these]).mT)

        run_in_slices(work, -(-len(self.candidates) // BLOCK))
        return found

    def _along(self, phi: Tensor) -> Tensor:
        """The most of a.d / |d|_p along the line of each candidate, columns phi [b, n]."""
        u, half, a = self.bounded.u, 0.5 * self.bounded.p, self.bounded.a
        slope = phi @ self.left
        steepness = slope.norm(dim=1)
        largest = phi.abs().amax(1)
        moving = torch.isfinite(phi).all(1) & (steepness > 0.0) & (largest > 0.0)
        direction = slope / torch.where(moving, steepness, 1.0)[:, None]
        rise = ((phi @ a) * direction).sum(1)
        cross, own, here = phi * (direction @ self.d.mT), phi.square(), self.d.square().sum(1)
        best = torch.full_like(rise, -torch.inf)
        for length in LENGTHS:
            t = length / torch.where(moving, largest, 1.0)
            squares = (here + t[:, None] * (2.0 * cross + t[:, None] * own)).clamp_min(0.0)
            most = squares.amax(1).clamp_min(torch.finfo(phi.dtype).tiny)
            size = most.sqrt() * ((squares / most[:, None]) ** half @ u) ** (0.5 / half)
            best = torch.maximum(best, (self.gain + t * rise) / size)
        return torch.where(moving, best, -torch.inf)
