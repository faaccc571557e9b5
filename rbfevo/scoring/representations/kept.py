"""Setups that begin with centers that stay: a search sees the others alone."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from rbfevo.scoring.representations.representation import Space

if TYPE_CHECKING:
    from torch import Tensor


def beginning_with(kept: Tensor, setups: Tensor) -> Tensor:
    """Setups [*pop, f, d] behind the centers that stay [k, d]: [*pop, k + f, d], these the same to the bit."""
    import torch

    return torch.cat((kept.to(setups).expand(*setups.shape[:-2], -1, -1), setups), dim=-2)


def keeping(kept: Tensor, space: Space) -> Space:
    """The space of setups [k + f, d] whose first k centers are `kept` [k, d]; `space` is that of the f others."""
    count = len(kept)
    return dataclasses.replace(
        space,
        place=lambda points: beginning_with(kept, space.place(points)),
        pull=lambda points, gradient: space.pull(points, gradient[..., count:, :]),
        points=lambda setups: setups[..., count:, :],
    )
