"""Value and gradient of what setups climb on: a smooth function of log R and P, in the points of the box."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.methods.gradient.tracing import Aim, exponents, soft_potential, soft_regularity
from rbfevo.methods.method import Problem


class Rise(NamedTuple):
    """What setups [p, *setup] climb on.

    Attributes:
        values: [p], maximized; gradients: [p, *setup] in the points of the box; objectives: [p, 2] R and P themselves.
        exponents: [p] of the smooth R; near: what a spectrum of similar setups can start from, or None.
    """

    values: Tensor
    gradients: Tensor
    objectives: Tensor
    exponents: Tensor
    near: Tensor | None


def rise(
    problem: Problem,
    points: Tensor,
    aim: Aim,
    sharpness: float,
    exponent: Tensor | None,
    near: Tensor | None,
    accepts: Callable[[Tensor], Tensor],
) -> Rise:
    """The value of `aim` and its gradient at points [p, *setup] of the box.

    Args:
        sharpness: of the smooth R and least P; exponent: [p] of the smooth R, None: fitted to R at these points.
        near: of an earlier call at similar points, or None.
        accepts: tells by their values [p] which points need gradients [p]; those of the others are 0.
    """
    known = () if near is None else (near,)
    spectrum = problem.spectrum(problem.space.place(points), *known)
    objectives = torch.stack((spectrum.regularity, spectrum.potential), dim=1)
    if exponent is None:
        exponent = exponents(objectives[:, 0], sharpness)
    log_regularity, slope = soft_regularity(spectrum, exponent)
    potential, shares = soft_potential(spectrum, sharpness)
    values, in_regularity, in_potential = aim(log_regularity, potential)
    wanted = accepts(values)[:, None]
    toward = (
        torch.where(wanted, in_regularity[:, None] * slope, 0.0),
        torch.where(wanted, in_potential[:, None] * shares, 0.0),
    )
    gradient = spectrum.backward(*toward)
    return Rise(values, problem.space.pull(points, gradient), objectives, exponent, spectrum.near)
