"""What a setup makes of the displacement that its run wants: the best approximation of it, or a first step downhill."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.objectives import Candidate, Change, aimed, best_keeping, changes, gain_of, index_of, uphill
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import EPS, Setup
from rbfevo.scoring.maxnorm import Block, best_displacement, norm

RULES = ("max-norm", "natural", "steepest")
NORM = 16.0  # of the rule max-norm: near enough to the maximum, and smooth


class Move(NamedTuple):
    """What the setup makes of the wanted displacement, k components.

    Attributes:
        wanted, reached: [n, k] at the vertices; weights: [m, k]; centers: [m, k] parameters of direct manipulation, the
            displacements of the centers but for the blend of held regions.
        direction: whether only the direction was given, so that the size is that of `--step`.
        change: the predicted change of the objective, in its unit, to first order; None of a target, or where the size
            of the sensitivity is not known. Of several objectives those of each are `changes`.
        limited: vertices that move by their largest displacement (to 1 %), where that is what limits the move; else 0.
    """

    wanted: Array
    reached: Array
    weights: Array
    centers: Array
    direction: bool
    change: float | None = None
    changes: tuple[Change, ...] = ()
    limited: int = 0


def wanted_move(
    record: Record,
    chosen: Setup,
    step: float,
    rule: str = RULES[0],
    objective: str | None = None,
    keep: Sequence[str] = (),
) -> Move:
    """The best approximation of a wanted displacement; of a sensitivity, a step by a rule.

    Args:
        step: of a sensitivity, how far the vertex that moves most moves, in diagonals of the template's bounding box.
        rule: how a step is chosen, one of `RULES`; all of them go downhill of the linear objective s.U q, s the
            sensitivity of a vertex:
            `max-norm`: what gains most for its largest displacement, argmax -s.U q / |U q|_16;
            `natural`: q = -(U^T (M + l^2 K) U)^-1 U^T s, with the vertices' areas M, the stiffness K of the surface
            and the smoothing length l of the run (without one, l = 0: the least-squares projection);
            `steepest`: q = -U^T s in the parameters of the run's manipulation.
        objective: of several, the one that the step follows; None: the weighted sum of all, each of unit norm.
        keep: objectives that must not get worse: where the step would make one worse, it is the best of those (by the
            same rule) under which it neither gains nor loses, to first order.

    Raises:
        UserError: for another rule or objective, where a rule does not work for this setup, or if no step gains
            anything while all that is kept gets no worse.
    """
    if record.summary.get("gradient_is") != "direction" and record.gradient_norm is not None:
        weights = chosen.best(record)
        wanted, reached = record.gradient * record.gradient_norm, chosen.displacement(record.vertices, weights)
        factor = min(1.0, within_bounds(record, reached))
        reached, weights = factor * reached, factor * weights
        limited = at_bounds(record, reached) if factor < 1.0 else 0
        return Move(wanted, reached, weights, chosen.handles_moved(weights), False, limited=limited)
    whole, record = record, aimed(record, objective)
    fields = [uphill(whole.alone(index_of(whole, name, "--keep"))) for name in keep]
    size = step * float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    weights = _stepped(record, chosen, rule, size, fields)
    if keep and not weights.any():
        listed = " and ".join(dict.fromkeys(keep))
        raise UserError(f"--keep {listed}: no step of this setup gains anything while {listed} must not get worse")
    wanted, reached = record.gradient, chosen.displacement(record.vertices, weights)
    farthest = float(np.linalg.norm(reached, axis=1).max())
    gains = float((record.weights[:, None] * record.gradient * reached).sum())
    if not gains > 1e-18 * float(np.linalg.norm(record.weights[:, None] * record.gradient)) * farthest:
        weights, reached, farthest = 0.0 * weights, 0.0 * reached, 0.0
    free, factor = size / (farthest or 1.0), within_bounds(record, reached)
    factor = min(free, factor)
    reached, weights = factor * reached, factor * weights
    limited = at_bounds(record, reached) if factor < free else 0
    # Of this size, what is left of the wanted displacement is orthogonal to what is reached.
    matching = float((record.weights[:, None] * reached**2).sum()) / (factor * gains) if farthest else 0.0
    wanted = wanted * (matching or size / float(np.linalg.norm(wanted, axis=1).max()))
    change = predicted_change(record, reached) if whole.gradients is None else None
    moved, gained = chosen.handles_moved(weights), changes(whole, reached)
    return Move(wanted, reached, weights, moved, True, change, gained, limited)


def within_bounds(record: Record, displacement: Array) -> float:
    """The largest factor by which a displacement [n, k] keeps the largest displacements of a run; inf without any."""
    if record.max_displacement is None:
        return np.inf
    lengths = np.linalg.norm(displacement, axis=1)
    moving = lengths > 0.0
    return float((record.max_displacement[moving] / lengths[moving]).min(initial=np.inf)) * (1.0 - EPS)


def at_bounds(record: Record, displacement: Array) -> int:
    """How many vertices move by at least 99 % of their largest displacement."""
    if record.max_displacement is None:
        return 0
    return int((np.linalg.norm(displacement, axis=1) >= 0.99 * record.max_displacement).sum())


def _shares(record: Record, size: float) -> Array:
    """[n] how far each vertex may move in a step of that size, over the largest of all."""
    if record.max_displacement is None:
        return np.ones(len(record.vertices))
    most = np.minimum(record.max_displacement, size)
    return most / most.max()


def predicted_change(record: Record, displacement: Array) -> float | None:
    """The change of the objective that its sensitivities predict for a displacement [n, k], to first order.

    By the sensitivities before smoothing; None where the run did not save their size, or which way is up.
    """
    norm, way = record.summary.get("gradient_norm"), {"minimize": -1.0, "maximize": 1.0}
    sign = way.get(str(record.summary.get("objective")))
    if sign is None or not isinstance(norm, int | float):
        return None
    return sign * float(norm) * float((uphill(record) * displacement).sum())


def _stepped(record: Record, chosen: Setup, rule: str, size: float, kept: Sequence[Array] = ()) -> Array:
    """The weights [m, k] of a step by a rule, of any size, under which no objective of the fields [n, k] gets worse.

    Args:
        size: of the largest displacement in the end.
    """
    found = {"max-norm": _max_norm, "natural": _natural, "steepest": _steepest}.get(rule)
    if found is None:
        raise UserError(f"--rule {rule}: choose one of {', '.join(RULES)}")
    rising = record.weights[:, None] * record.gradient
    if not kept:
        return found(record, chosen, rising, size)
    if found is _max_norm:

        def bounded(still: Sequence[int]) -> Candidate:
            """The max-norm step under which the kept fields `still` do not change, and its gain for its length."""
            weights = _max_norm(record, chosen, rising, size, [kept[i] for i in still])
            displacement = chosen.displacement(record.vertices, weights)
            length = norm(displacement / _shares(record, size)[:, None], _areas(record), NORM) or 1.0
            return Candidate(weights, displacement, float((rising * displacement).sum()) / length)

        return best_keeping(bounded, kept).weights
    return best_keeping(
        _linear(lambda field: found(record, chosen, field, size), record, chosen, rising, kept), kept
    ).weights


def _linear(
    weights_of: Callable[[Array], Array], record: Record, chosen: Setup, rising: Array, kept: Sequence[Array]
) -> Callable[[Sequence[int]], Candidate]:
    """How a rule that is linear in the field finds its best step that neither gains nor loses by some of the `kept`.

    With the weights w(a) of a field a, the best such step is w(a + sum of mu_l a_l), with multipliers mu: the rule in
    the null space of what these gain. Its gain is that over the length of q in the metric of the rule.
    """
    moves = [(weights, chosen.displacement(record.vertices, weights)) for weights in map(weights_of, (rising, *kept))]

    def solve(still: Sequence[int]) -> Candidate:
        """The best step under which the kept fields `still` do not change, and its gain for its length."""
        weights, displacement = moves[0]
        others = [moves[1 + i] for i in still]
        gains = np.array([[gain_of(kept[i], other) for _, other in others] for i in still]).reshape(
            len(still), len(still)
        )
        for _ in range(2 * bool(still)):  # the second time for rounding
            lost = np.array([float((kept[i] * displacement).sum()) for i in still])
            multipliers = np.linalg.lstsq(gains, -lost, rcond=1e-13)[0]
            weights = weights + sum(m * own for m, (own, _) in zip(multipliers, others, strict=True))
            displacement = chosen.displacement(record.vertices, weights)
        return Candidate(weights, displacement, math.sqrt(max(float((rising * displacement).sum()), 0.0)))

    return solve


def _max_norm(record: Record, chosen: Setup, rising: Array, size: float, without: Sequence[Array] = ()) -> Array:
    """The weights [m, k] of the rule `max-norm`; `rising` [n, k] is -s but for its size.

    Among the steps that gain nothing by the fields [n, k] of `without`.
    """
    weights, blocks, backs = np.zeros((chosen.count, rising.shape[1])), [], []
    parts, share = list(_columns(record, chosen)), _shares(record, size)
    for components, _, U in parts:
        across = chosen.is_across(components, rising.shape[1])
        left, values, right = np.linalg.svd(U / share[:, None], full_matrices=False)
        kept = values > max(U.shape) * EPS * values[0]
        blocks.append(Block(components, left[:, kept]))
        backs.append(chosen.widened(right[kept].T / values[kept], across))
    found = best_displacement(
        blocks, share[:, None] * rising, _areas(record), NORM, without=[share[:, None] * field for field in without]
    )
    for (components, columns, _), back, coordinates in zip(parts, backs, found.coordinates, strict=True):
        weights[np.ix_(columns, components)] = back @ coordinates
    return weights


def _natural(record: Record, chosen: Setup, rising: Array, _size: float) -> Array:
    """The weights [m, k] of the rule `natural`."""
    weights = np.zeros((chosen.count, rising.shape[1]))
    for components, columns, U, product in metrics(record, chosen):
        left, values, _ = np.linalg.svd(product)
        kept = values > len(values) * EPS * values[0]
        inverse = (left[:, kept] / values[kept]) @ left[:, kept].T
        found = chosen.widened(inverse @ (U.T @ rising[:, components]), chosen.is_across(components, rising.shape[1]))
        weights[np.ix_(columns, components)] = found
    return weights


def metrics(record: Record, chosen: Setup) -> Iterator[tuple[Array, Array, Array, Array]]:
    """Per kind of components: which, their columns [r] of U, these [n, r], and U^T (M + l^2 K) U [r, r].

    With the vertices' areas M, the stiffness K of the surface, and the smoothing length l of the run, 0 without one.
    """
    area, stiffness, length = _areas(record), None, record.summary.get("smooth")
    if isinstance(length, int | float) and length > 0 and len(record.faces):
        from rbfevo.geometry import sobolev  # with SciPy, which takes a while

        stiffness = length**2 * sobolev.stiffness(record.vertices, record.faces)
    for components, columns, U in _columns(record, chosen):
        weighted = area[:, None] * U + (0.0 if stiffness is None else stiffness @ U)
        yield components, columns, U, U.T @ weighted


def _steepest(record: Record, chosen: Setup, rising: Array, _size: float) -> Array:
    """The weights [m, k] of the rule `steepest`."""
    weights = np.zeros((chosen.count, rising.shape[1]))
    for components, across, columns in chosen.parities(rising.shape[1]):
        if not len(columns):
            continue
        U = chosen.blended(record.vertices, across)[:, columns]
        pulled = U.T @ rising[:, components]
        if chosen.manipulation == "direct":  # U = Phi Psi^-1, and what it is pulled by goes through Psi^-1 twice
            if reason := chosen.immovable(rising.shape[1]):
                raise UserError(f"--rule steepest: {reason}; choose --rule {RULES[0]} or {RULES[1]}")
            pulled = chosen.reduced(chosen.through(pulled, across), across)
        weights[np.ix_(columns, components)] = pulled
    return weights


def _columns(record: Record, chosen: Setup) -> Iterator[tuple[Array, Array, Array]]:
    """Per kind of components of a displacement: which, their columns [r] of Phi, these times the blend [n, r].

    Where points on the surface reach less, those of U [n, m] take the place of the latter.
    """
    for components, across, columns in chosen.parities(record.gradient.shape[1]):
        if len(columns):
            yield components, columns, chosen.narrowed(chosen.blended(record.vertices, across)[:, columns], across)


def _areas(record: Record) -> Array:
    """[n] the surface about each vertex, or the run's weights where there are no faces or a vertex has none."""
    if len(record.faces) and record.vertices.shape[1] == 3:
        from rbfevo.geometry import sobolev

        areas = sobolev.mass(record.vertices, record.faces)
        if (areas > 0).all():
            return areas
    return record.weights


def places_of(chosen: Setup, what: str = "weights") -> Array:
    """Where `weights` or `displacements` act: control points [m, d] or handles [h, d]; NaN where they have no place."""
    if what == "weights" or chosen.immovable(chosen.centers.shape[1]):
        return chosen.weight_places
    return chosen.centers


def spatial(rows: Array) -> Array:
    """Rows [q, k] of a displacement or of points with three components: one component is a height, z."""
    k = rows.shape[1]
    full = np.zeros((len(rows), 3))
    full[:, 2 if k == 1 else slice(0, k)] = rows[:, 0] if k == 1 else rows
    return full
