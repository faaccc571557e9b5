"""A run that looks at another sensitivity: that of a deformed design, on the vertices of the original one."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.errors import UserError
from rbfevo.recorded.record import OF_EACH, Record
from rbfevo.recorded.setup import EPS, Setup
from rbfevo.scenarios.design import Design
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.scenario import near_one
from rbfevo.scenarios.wanted import Readiness, Wish
from rbfevo.scoring.maxnorm import Block, best_displacement, dual_norm

NO_SEGMENTS = np.empty((0, 2), np.int64)


def direction_of(record: Record) -> str:
    """`minimize` or `maximize`: what is to become of the objective of a run.

    Raises:
        UserError: for a run with a target, of several objectives, or that did not save it.
    """
    objective = str(record.summary.get("objective"))
    if record.gradients is not None:
        raise UserError(f"this run has several objectives ({', '.join(record.objectives)}), and a descent follows one")
    if record.summary.get("gradient_is") != "direction" or objective not in ("minimize", "maximize"):
        raise UserError("this run has no sensitivity: a descent needs scenario.sensitivity, not a target")
    return objective


def sign_of(record: Record) -> float:
    """1 of an objective to be minimized, -1 of one to be maximized; raises as `direction_of`."""
    return -1.0 if direction_of(record) == "maximize" else 1.0


def own(record: Record) -> Array:
    """The sensitivity dJ/dx [n, k] of the original design as the run has it, 0 where vertices are to stay.

    Without the size of it, which a run may not have saved, it is of unit norm.
    """
    raw = record.gradient if record.gradient_raw is None else record.gradient_raw
    size = record.summary.get("gradient_norm")
    factor = float(size) if isinstance(size, int | float) else 1.0
    return -sign_of(record) * factor * record.weights[:, None] * raw


def looking_at(record: Record, sensitivity: Array, segments: Ints = NO_SEGMENTS) -> Record:
    """A run's record with another sensitivity, made ready as the run made its own: held, planar, smoothed.

    Args:
        sensitivity: [n, 3] dJ/dx, integrated over each vertex's share of the surface; segments: [s, 2] of a curve.

    Raises:
        UserError: for a run without a sensitivity, or if nothing is left of this one.
    """
    sign, n = sign_of(record), len(record.vertices)
    if sensitivity.shape != record.gradient.shape or not np.isfinite(sensitivity).all():
        raise UserError(f"a sensitivity of {n} vertices with three finite components is expected")
    scaled, exponent = near_one(sensitivity)
    held = np.zeros(n, bool) if record.blend is None else record.blend == 0.0
    stays = held if record.stays is None else record.stays
    plane = record.summary.get("planar")
    flat = None if plane is None else Planar.of(plane["axis"], record.vertices, len(segments) > 0)
    nothing = np.zeros((n, 3)), np.zeros(n)
    surface = record.vertices, record.faces
    design = Design(record.vertices, record.faces, segments, *nothing, record.weights, surface)
    ready = Readiness(design, flat, stays, record.summary.get("smooth"), None)
    found = ready.of(Wish("the sensitivity", -sign * scaled / record.weights[:, None], exponent, direction_of(record)))
    return dataclasses.replace(
        record,
        gradient=found.gradient.numpy(),
        gradient_raw=None if found.raw is None else found.raw.numpy(),
        summary={**record.summary, "gradient_norm": found.norm if math.isfinite(found.norm) else None},
        **dict.fromkeys(("gradients", *OF_EACH)),
    )


def attainable(record: Record, chosen: Setup) -> float:
    """The gain [0, 1] that a setup reaches of the one that is possible with a displacement of every vertex.

    It is the square root of improvement potential, or of bounded potential where the run searched that.
    """
    rising = record.weights[:, None] * record.gradient
    p = record.summary.get("criterion_norm")
    exponent = float(p) if record.bounded_potential is not None and isinstance(p, int | float) else 2.0
    blocks = []
    for components, across, columns in chosen.parities(record.gradient.shape[1]):
        if len(columns):
            U = chosen.blended(record.vertices, across)[:, columns]
            left, values, _ = np.linalg.svd(U, full_matrices=False)
            blocks.append(Block(components, left[:, values > max(U.shape) * EPS * values[0]]))
    best = best_displacement(blocks, rising, record.weights, exponent)
    return best.gain / dual_norm(rising, record.weights, exponent)
