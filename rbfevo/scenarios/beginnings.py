"""Control points in files that a search begins with: centers that stay in every setup, and setups to start from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.mirror import ON_PLANE
from rbfevo.scenarios.control_points import read_centers
from rbfevo.scenarios.scenario import Scenario

ROUNDING = 10.0 * ON_PLANE  # of the box's diagonal: what symmetry and bounds may change of a center that a file gives


class Beginning(NamedTuple):
    """Centers [k, d] that stay, or the searched centers [s, f, d] of setups to start from; and notes by title."""

    centers: Tensor
    notes: dict[str, str]


def read_kept(path: str, scenario: Scenario, count: int) -> Beginning:
    """The centers [k, d] in a file with which all setups of `count` centers begin, as they are.

    Raises:
        UserError: if the file cannot be used on the scenario, or leaves no center to be placed.
    """
    placed = read_centers(path, scenario)
    k = len(placed.centers)
    if k >= count:
        why = "they alone can be scored with method=given" if k == count else "which is their total with those added"
        side = " of one half" if scenario.mirror is not None else ""
        raise UserError(f"keep={path}: it holds {k} centers{side}, and centers={count}: give more than {k}; {why}")
    note = "; ".join([f"{k} of {count} centers stay", *placed.notes])
    return Beginning(torch.from_numpy(placed.centers.copy()), {"kept centers": f"{path}: {note}"})


def read_starts(files: Sequence[str], scenario: Scenario, kept: Tensor, count: int) -> Beginning:
    """The centers [s, f, d] that a search places, of the setups in s files.

    Args:
        kept: [k, d] centers that stay; count: centers of a setup. A file holds all of them, the kept ones first, or
            the f = count - k others.

    Raises:
        UserError: if a file cannot be used on the scenario, has another number of centers, begins with others than
            those kept, or has some where no search places any.
    """
    found, notes = [], {}
    for file in files:
        placed = read_centers(file, scenario)
        centers = torch.from_numpy(placed.centers.copy())
        k, size = len(kept), len(centers)
        if size not in (count, count - k):
            others = f", or the {count - k} beside those of keep=" if k else ""
            raise UserError(
                f"method.start={file}: it has {size} centers; give {count}, as centers= says{others}"
                + ("; to go on from fewer, keep them: keep=FILE" if size < count and not k else "")
            )
        if k and size == count:
            if not torch.equal(centers[:k], kept):
                raise UserError(
                    f"method.start={file}: its first {k} centers are not those of keep=; give them as they are there, "
                    f"or the {count - k} others alone"
                )
            centers = centers[k:]
        try:
            found.append(_searched(centers, scenario))
        except UserError as error:
            raise UserError(f"method.start={file}: {error}") from None
        notes[f"start {file}"] = f"{file}: {'; '.join(['a setup to start from', *placed.notes])}"
    return Beginning(torch.stack(found), notes)


def _searched(centers: Tensor, scenario: Scenario) -> Tensor:
    """Centers [f, d] on the side of the mirror that is searched, checked to be where a search can place them."""
    rounding, mirror = ROUNDING * scenario.diagonal, scenario.mirror
    parameterization = scenario.parameterization
    if mirror is not None:
        other = scenario.side * (centers[:, mirror.axis] - mirror.at) < 0
        centers = torch.where(other[:, None], mirror.image(centers), centers)
        if parameterization.pins(len(centers)):
            distance = (centers[:, mirror.axis] - mirror.at).abs()
            if float(distance.min()) > rounding:
                raise UserError(
                    "of an odd number of centers a search keeps one on the plane of symmetry, and the closest of these "
                    f"is {float(distance.min()):g} from it"
                )
            centers = centers[distance.argsort(descending=True, stable=True)]
    lower, upper = scenario.search_box
    outside = ((centers < lower - rounding) | (centers > upper + rounding)).any(1)
    moved = (parameterization(centers) - centers).abs().amax(1) > rounding
    for wrong, where in ((outside, "outside the box of the search"), (moved, "in a region that searches keep free")):
        if bool(wrong.any()):
            raise UserError(f"{int(wrong.sum())} of {len(centers)} centers {where}; move them, or start without them")
    return centers.clamp(lower, upper)
