"""The part of a sweep's page about the number of centers: curves, nested sequences, and plain sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rbfevo.figures.curves import KNEE_POTENTIAL, KNEE_REGULARITY, is_logarithmic
from rbfevo.recorded import sweep
from rbfevo.recorded.sweep import Curve, Group, NestedSequence
from rbfevo.recorded.sweep.curves import BEST, SHARE


def numbers_of_centers(
    curves: Sequence[Curve], sequences: Sequence[NestedSequence], meshes: Sequence[str]
) -> dict[str, Any] | None:
    """What the page shows over the number of centers, by mesh; None where no settings were tried with several.

    Args:
        meshes: the fingerprints of meshes in the order in which the page counts them.
    """
    if not curves:
        return None
    sentences = sweep.advice(curves, sequences)
    return {
        "share": SHARE,
        "sentences": [sentences.get(mesh, []) for mesh in meshes],
        "logarithmic": [is_logarithmic([curve for curve in curves if curve.mesh == mesh]) for mesh in meshes],
        "curves": [_curve(curve, meshes.index(curve.mesh)) for curve in curves],
        "sequences": [
            {
                "mesh": meshes.index(sequence.mesh),
                "label": label,
                "potential": sequence.potential,
                "regularity": sequence.regularity,
            }
            for sequence, label in zip(sequences, sweep.labels_of(sequences), strict=True)
        ],
    }


def _curve(curve: Curve, mesh: int) -> dict[str, Any]:
    parts = {"best": BEST, "knee_potential": KNEE_POTENTIAL, "knee_regularity": KNEE_REGULARITY}
    return {
        "mesh": mesh,
        "label": curve.label,
        "centers": curve.centers,
        "enough": curve.enough,
        "seeds": [group.seeds for group in curve.groups],
        **{name: [_spread(group, key) for group in curve.groups] for name, key in parts.items()},
    }


def _spread(group: Group, key: str) -> dict[str, Any]:
    median, lower, upper = group.spreads[key]
    values = [_number(value) for value in group.values[key]]
    return {"median": _number(median), "first": _number(lower), "third": _number(upper), "values": values}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
