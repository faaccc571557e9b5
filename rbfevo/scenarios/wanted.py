"""The wanted displacement of an objective or a target, made ready to be scored: planar, smoothed, of unit norm."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.scenarios import signs, smoothing
from rbfevo.scenarios.design import Design
from rbfevo.scenarios.objectives import Objectives
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.scenario import times_power_of_two, unit_gradient
from rbfevo.scenarios.signs import Sides

Array = NDArray[np.float64]


class Wish(NamedTuple):
    """A wanted displacement [n, 3] times 2^-exponent, and the file or array that it comes from.

    Of a sensitivity, `direction` is whether its objective is to `minimize` or `maximize`; None of a target.
    """

    source: str
    wanted: Array
    exponent: int = 0
    direction: str | None = None


class Wanted(NamedTuple):
    """One ready to be scored.

    Attributes:
        gradient: [n, 3] of unit (weighted) norm; raw: [n, 3] before smoothing in its scale, or None.
        norm: that it had, which may be infinite; notes: a line each, by title.
    """

    gradient: Tensor
    raw: Tensor | None
    norm: float
    notes: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Readiness:
    """What the wanted displacements of a design have in common.

    Attributes:
        design: areas and mass of its vertices; flat: of a planar one, or None; stays: [n] vertices that do not move.
        smooth: length over which displacements are smoothed, model units, or None.
        sides: normals, for a note on where a sensitivity moves the design; None of targets.
    """

    design: Design
    flat: Planar | None
    stays: NDArray[np.bool_]
    smooth: float | None
    sides: Sides | None

    def of(self, wish: Wish) -> Wanted:
        """The wish, ready to be scored.

        Raises:
            UserError: if no vertex is left that should move.
        """
        design, flat, notes = self.design, self.flat, {}
        wanted = np.where(self.stays[:, None], 0.0, wish.wanted)
        if not wanted.any():
            raise UserError(f"{wish.source}: no vertex is left that should move; check scenario.fixed, hold and reject")
        if flat is not None:
            wanted, more = flat.wanted(wanted, design.mass)
            notes |= more
        raw = wanted
        if self.smooth is not None:
            integrated = wish.direction is not None
            surface = design.vertices, design.elements
            found = smoothing.smoothed(wanted, *surface, design.mass, self.stays, self.smooth, integrated)
            wanted, notes["smooth"] = found.wanted, smoothing.note(found, *surface, self.smooth)
            wanted = wanted if flat is None else flat.averaged(flat.plane.flat(wanted))
        if self.sides is not None and wish.direction is not None:
            notes["largest move"] = signs.way(wanted, design.vertices, self.sides, wish.direction)
        gradient, norm = unit_gradient(torch.from_numpy(wanted), torch.from_numpy(design.mass))
        unsmoothed = None if self.smooth is None else torch.from_numpy(raw) / norm
        return Wanted(gradient, unsmoothed, times_power_of_two(norm, wish.exponent), notes)


def stacked(objectives: Objectives, wanted: Sequence[Wanted]) -> Wanted:
    """Those of several objectives as one, of unit norm, without notes."""
    raw = [one.gradient if one.raw is None else one.raw for one in wanted]
    unsmoothed = None if wanted[0].raw is None else objectives.stacked(raw)
    return Wanted(objectives.stacked([one.gradient for one in wanted]), unsmoothed, 1.0, {})


def titled(notes: dict[str, str], name: str, source: str = "") -> dict[str, str]:
    """The notes of one of several objectives, under titles of their own; as they are where it has no name.

    Args:
        source: with which lines may begin that need no name before them.
    """
    if not name:
        return notes
    known = tuple(f"{begin}: " for begin in (name, source) if begin)
    return {f"{title} {name}": line if line.startswith(known) else f"{name}: {line}" for title, line in notes.items()}
