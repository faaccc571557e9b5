"""The parts of a run's setups, rebuilt from its files: representation, symmetry plane, mid-plane, held regions."""

from __future__ import annotations

import numpy as np

from rbfevo.errors import UserError
from rbfevo.geometry.holding import Hold
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.planar import Plane
from rbfevo.recorded.record import Record
from rbfevo.scoring.kernels import Wendland, triharmonic
from rbfevo.scoring.representations import RBF, Representation, representation_of


def representation_in(record: Record) -> Representation:
    """The representation of a run; of older runs, RBFs of the kernel that summary.json names.

    Raises:
        UserError: if it is not known here.
    """
    name, support = record.summary.get("kernel"), record.summary.get("support")
    spec = record.summary.get("representation")
    if isinstance(spec, dict):
        return representation_of(spec)
    if name == "wendland" and isinstance(support, int | float) and 0 < support < float("inf"):
        return RBF(Wendland(support))
    if name == "triharmonic":
        return RBF(triharmonic(record.vertices.shape[1]))
    raise UserError(f"summary.json: kernel={name} with support radius {support} is not known here")


def hold_in(record: Record, mirror: Mirror | None, planar: Plane | None) -> Hold | None:
    """The blend of a run's held points, with its symmetry plane and mid-plane; None where nothing is held.

    Raises:
        UserError: if summary.json has no width for it.
    """
    if record.held is None:
        return None
    width = record.summary.get("hold_width")
    if not isinstance(width, int | float) or not 0 < width < float("inf"):
        raise UserError(f"summary.json: hold_width={width} is not a positive number, but scenario.npz has held points")
    return Hold(record.held, float(width), mirror, planar)


def mirror_in(record: Record) -> Mirror | None:
    """The symmetry plane of a run, or None.

    Raises:
        UserError: if summary.json holds something else than an axis and a number.
    """
    found = _plane(record, "symmetry")
    return None if found is None else Mirror.of_box(*found, record.lower, record.upper)


def plane_in(record: Record) -> Plane | None:
    """The mid-plane of a planar run, or None.

    Raises:
        UserError: as for `mirror_in`.
    """
    found = _plane(record, "planar")
    if found is None:
        return None
    axis, at = found
    return Plane(axis, at, float(np.abs(record.vertices[:, axis] - at).max()))


def _plane(record: Record, key: str) -> tuple[int, float] | None:
    """The axis and the coordinate of a plane in summary.json."""
    plane = record.summary.get(key)
    if plane is None:
        return None
    axis, at = (plane.get("axis"), plane.get("at")) if isinstance(plane, dict) else (None, None)
    axes = ["x", "y", "z"][: record.vertices.shape[1]]
    if axis not in axes or not isinstance(at, int | float) or not np.isfinite(at):
        raise UserError(
            f"summary.json: {key}={plane} must have an axis ({', '.join(axes)}) and a number as its entry `at`"
        )
    return axes.index(axis), float(at)
