"""Where heuristics that pick centers one by one may put them: a grid over the box, and the columns of its points."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.packaging import Packaging
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.representations import Representation


class TooFewCandidatesError(UserError):
    """Fewer candidates can be picked than centers are asked for; `found` of them can."""

    def __init__(self, message: str, found: int) -> None:
        super().__init__(message)
        self.found = found


def grid_candidates(lower: Tensor, upper: Tensor, per_axis: int = 30) -> Tensor:
    """Return the uniform grid [per_axis**d, d] over the box `lower` [d], `upper` [d], ends included, last axis fastest.

    Raises:
        UserError: if `per_axis` is below 2.
    """
    if per_axis < 2:
        raise UserError(f"the grid of OLS candidates needs at least 2 points per axis, not {per_axis}")
    steps = torch.linspace(0.0, 1.0, per_axis, dtype=lower.dtype, device=lower.device)
    axes = [torch.lerp(low, high, steps) for low, high in zip(lower, upper, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, len(axes))


def candidates_of(scenario: Scenario, per_axis: int, representation: Representation | None = None) -> Tensor:
    """The candidates [c, d] of a representation that has its own; else a grid over the box, in what is not kept free.

    Of a planar design it is over its mid-plane.
    """
    own = None if representation is None else representation.candidates()
    if own is not None:
        return own
    (lower, upper), planar, region = scenario.search_box, scenario.planar, scenario.keep_out
    if isinstance(region, Packaging):  # the grid is over the part of the box that is left
        lower, upper = torch.maximum(lower, region.extent[0]), torch.minimum(upper, region.extent[1])
    if planar is None:
        grid = grid_candidates(lower, upper, per_axis)
    else:
        axes = sorted(planar.others)
        flat = grid_candidates(lower[axes], upper[axes], per_axis)
        grid = flat.new_full((len(flat), 3), planar.at)
        grid[:, axes] = flat
    return grid if region is None else grid[~region.contains(grid)]


def atoms_of(representation: Representation, design: Scenario) -> Callable[[Tensor], Tensor]:
    """The map from candidates [c, d] to their columns [n, c] at the vertices of a design.

    Raises:
        UserError: if the representation does not consist of centers.
    """
    atoms = representation.atoms(design.vertices)
    if atoms is None:
        representation.refuse_places("ols")
    return atoms
