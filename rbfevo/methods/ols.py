"""Orthogonal least squares: pick, one after the other, the centers that raise the improvement potential the most.

Chen, Billings & Luo, "Orthogonal least squares methods and their application to non-linear system identification",
Int. J. Control 50(5), 1989; section 7 of the paper. With Q [n, t] an orthonormal basis of the t columns picked so far
and r = g - Q Q^T g, a candidate with column phi and w = phi - Q Q^T phi would raise P by

    gain = |w^T r|_F^2 / (w^T w).

The textbook orthogonalizes every column against every pick. Here a candidate carries only bounds: with y = phi^T q for
the newest q, w^T w falls by y^2 and w^T r by y (q^T r); y comes from columns that are kept in single precision, and the
bounds allow for that. Who may win by them gets bounds from double precision, and only who may win by those as well is
orthogonalized against all of Q. So the picks are those of the textbook, and each costs about one product with the kept
columns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.candidates import TooFewCandidatesError, atoms_of, candidates_of
from rbfevo.methods.method import Heuristic, Problem, at_least_one
from rbfevo.methods.nested import FEWER, nested_of
from rbfevo.methods.screening import Screen
from rbfevo.scoring.combination import Combination


class Selection(NamedTuple):
    """Centers [count, d] in the order picked, their candidate indices [count], the rise of P [count] each brought."""

    centers: Tensor
    indices: Tensor
    gains: Tensor


@torch.no_grad()
def ols(
    columns: Callable[[Tensor], Tensor],
    candidates: Tensor,
    gradient: Tensor,
    count: int,
    *,
    weights: Tensor | None = None,
    tolerance: float = 1e-9,
    vanish: float = 1e-12,
    memory: float = 1.25e9,
    block: int = 32,
    kept: Tensor | None = None,
    groups: int = 1,
) -> Selection:
    """Pick `count` of `candidates` [c, d] greedily, to maximize the improvement potential P of indirect manipulation.

    With several groups of columns of g it is the least of their potentials, each relative to its own part of g.

    Gains are exact, count all columns of g together, and are in units of P: relative to the squared (weighted)
    Frobenius norm of g. Those within `tolerance` of the best tie, and the lowest index wins. A candidate is skipped if
    its column is zero or not finite, or if w^T w is below the fraction `vanish` of phi^T phi.

    Args:
        columns: maps centers [b, d] to their float64 kernel columns [n, b] at all vertices, without weights; on the CPU
            it is called from as many threads as torch would use.
        candidates: [c, d], model units.
        gradient: [n, k] float64, the estimated fitness gradient g.
        count: number of centers to pick.
        weights: [n] positive; rows of Phi and g count with their square roots.
        tolerance: width of a tie, in P.
        vanish: see above.
        memory: bytes for columns kept in single precision; those that do not fit are computed at every pick.
        block: number of candidates computed at a time.
        kept: [q, d] centers that are there already: gains are those beside them, and none of them is picked.
        groups: equally many columns of g each, one group after another.

    Raises:
        UserError: if `count` is below 1, or g is zero or not finite.
        TooFewCandidatesError: if fewer than `count` candidates can be used.
    """
    if count < 1:
        raise UserError(f"OLS has to pick at least one center, not {count}")
    if count > len(candidates):
        raise TooFewCandidatesError(
            f"OLS cannot pick {count} centers from {len(candidates)} candidates: refine the candidate grid",
            len(candidates),
        )
    root = None if weights is None or bool((weights == 1).all()) else weights.sqrt()
    residual = gradient if root is None else gradient * root[:, None]
    length = torch.linalg.vector_norm(residual)
    if not bool(length.isfinite() & (length > 0)):
        raise UserError("OLS needs an estimated fitness gradient that is finite and not zero everywhere")

    screen = Screen(columns, candidates, root, residual / length, memory, block, groups)
    before = residual.new_empty(len(residual), 0) if kept is None else screen.basis_of(kept, vanish)
    basis = residual.new_empty(before.shape[1] + count, len(residual)).T
    basis[:, : before.shape[1]] = before
    for q in before.T:
        screen.advance(q.contiguous())
    indices: list[int] = []
    gains: list[Tensor] = []
    for t in range(before.shape[1], basis.shape[1]):
        winner, gain = screen.best(basis[:, :t], tolerance, vanish)
        if winner < 0:
            raise TooFewCandidatesError(
                f"only {len(indices)} of the {len(candidates)} OLS candidates have kernel columns independent of each "
                f"other, for {count} centers: ask for fewer centers, refine the candidate grid or enlarge the support "
                "radius",
                len(indices),
            )
        indices.append(winner)
        gains.append(gain)
        basis[:, t] = screen.pick(winner, basis[:, :t])
        if t + 1 < basis.shape[1]:
            screen.advance(basis[:, t])
    chosen = torch.tensor(indices, device=candidates.device)
    return Selection(candidates[chosen], chosen, torch.stack(gains))


class OlsHeuristic(Heuristic):
    """Greedy centers by orthogonal least squares on a grid of candidates, for high improvement potential.

    They are chosen for indirect manipulation and used for both, since P is the same for both. Of a symmetric design it
    sees one half, without the images of the centers; of a planar one candidates lie in the plane alone. Where bounded
    potential is searched, the centers are those of `rbfevo.methods.nested`, on a coarse design. Of several objectives
    each center raises the mean of their potentials the most, or the least of them, whichever is searched.
    """

    name = "ols"

    def __init__(self, per_axis: int = 30) -> None:
        super().__init__()
        self.per_axis = at_least_one(f"{self.name}: per_axis", per_axis)
        self._picked: Tensor | None = None

    def place(self, problem: Problem) -> Tensor:
        """[1, m, d]."""
        self._picked = self.picks(problem)
        return problem.assembled(self.name, self._picked)[None]

    def step(self) -> None:
        """Place the centers; the row has the order in which they were picked, unless others were there before."""
        super().step()
        if self._problem is not None and len(self._problem.kept):
            return
        self._rows = [rows._replace(picked=self._picked) for rows in self._rows]

    def picks(self, problem: Problem) -> Tensor:
        """Centers [m - k, d] in the order picked, as the grid has them: the first are the picks for fewer centers.

        Raises:
            TooFewCandidatesError: if fewer candidates can be used than the problem has centers.
        """
        if problem.norm != 2.0:
            per_axis = min(self.per_axis, FEWER)
            searched = (problem.scenario, problem.representation, problem.norm)
            return nested_of(*searched, problem.free, per_axis, problem.kept_on_one_side).centers
        design, combination = problem.scenario.half(), Combination.of(problem.scenario.objectives)
        atoms, blend = atoms_of(problem.representation.placed_by, design), design.blend
        return ols(
            atoms if blend is None else lambda candidates: blend[:, None] * atoms(candidates),
            candidates_of(problem.scenario, self.per_axis, problem.representation),
            design.gradient,
            problem.free,
            weights=design.weights,
            kept=problem.kept_on_one_side,
            groups=combination.count if combination.worst else 1,
        ).centers
