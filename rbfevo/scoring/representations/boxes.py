"""Boxes of free-form deformation on a scenario: which are searched, the one around the design, and points on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rbfevo.arrays import Array
from rbfevo.choices import refuse_others
from rbfevo.errors import UserError
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.representations.lattice import Lattice
from rbfevo.scoring.representations.representation import Space

SMALLEST = 0.05  # half an axis of the smallest box, of the design's size along it
FLAT = 0.1  # of the diagonal: a design that is flatter counts as that thick
ACTIVE = ("all", "inner")
DEFAULT = 4  # control points along each axis
KNOTS = (0.02, 0.98)  # where inner knots are searched
MARGIN = 1e-6  # of its size: by so much the box around the design is larger


class Parameter(NamedTuple):
    """A free parameter of genotypes.

    Attributes:
        entries: by how much each number of the genotype rises with it; read: it is the sum of these times the numbers.
        lower, upper: where it is searched.
    """

    entries: dict[int, float]
    read: dict[int, float]
    lower: float
    upper: float


def same(place: int, lower: float, upper: float) -> Parameter:
    """A parameter that is a number of the genotype itself."""
    return Parameter({place: 1.0}, {place: 1.0}, lower, upper)


def checked(
    scenario: Scenario, lattice: Any, degree: Any, active: str, continuity: int, turn: str | None, knots: bool
) -> tuple[Lattice, int]:
    """The lattice that the keys of the yaml describe, and how many layers at each face stay still.

    Raises:
        UserError: if a key has no such value, or does not fit the others.
    """
    d = scenario.vertices.shape[1]
    counts = [DEFAULT] * d if lattice is None else list(lattice) if isinstance(lattice, Sequence) else [lattice]
    if len(counts) != d or any(isinstance(n, bool) or not isinstance(n, int) or n < 2 for n in counts):
        raise UserError(
            f"representation.lattice={counts}: give {d} whole numbers of at least 2, the control points along "
            f"{', '.join('xyz'[:d])}"
        )
    degrees = _degrees(degree, counts)
    refuse_others("representation.active", active, ACTIVE)
    if active == "all" and continuity != 0:
        raise UserError(f"representation.continuity={continuity} is for representation.active=inner; leave it out")
    if continuity < 0:
        raise UserError(f"representation.continuity={continuity}: give an order of at least 0")
    still = continuity + 1 if active == "inner" else 0
    if min(counts) <= 2 * still:
        raise UserError(
            f"representation.continuity={continuity}: the outer {still} layers at each face stay still, and there are "
            f"no others in the lattice {' x '.join(map(str, counts))}; give at least {2 * still + 1} along each axis"
        )
    made = Lattice(tuple(counts), degrees, _turn(turn, scenario), knots)
    if knots and not sum(made.inner):
        raise UserError(
            "representation.knots=true: these basis functions have no inner knots; give a representation.degree below "
            "the number of control points less 1"
        )
    return made, still


def _degrees(degree: Any, counts: list[int]) -> tuple[int, ...]:
    """The degree of each axis."""
    if degree is None:
        return tuple(n - 1 for n in counts)
    each = list(degree) if isinstance(degree, list | tuple) else [degree] * len(counts)
    whole = all(isinstance(p, int) and not isinstance(p, bool) and p >= 1 for p in each)
    if len(each) != len(counts) or not whole:
        raise UserError(f"representation.degree={degree}: give a whole number of at least 1, or one for each axis")
    for axis, (p, n) in enumerate(zip(each, counts, strict=True)):
        if p > n - 1:
            raise UserError(
                f"representation.degree={degree}: {n} control points along {'xyz'[axis]} have at most degree {n - 1}"
            )
    return tuple(each)


def _turn(turn: str | None, scenario: Scenario) -> int | None:
    """The axis that boxes may be turned about."""
    if turn is None:
        return None
    d = scenario.vertices.shape[1]
    axes = {"up": 2 if d == 2 else "xyz".index(scenario.up), **({"x": 0, "y": 1} if d == 3 else {}), "z": 2}
    if turn not in axes:
        raise UserError(f"representation.turn={turn}: choose one of {', '.join(axes)}, or null")
    return axes[turn]


def refuse_unfit(lattice: Lattice, scenario: Scenario) -> None:
    """Raise UserError if a scenario asks for what boxes do not have."""
    if scenario.mirror is not None and lattice.turn not in (None, scenario.mirror.axis):
        raise UserError(
            f"representation.turn={'xyz'[lattice.turn]}: a box that is symmetric about {'xyz'[scenario.mirror.axis]} = "
            f"{scenario.mirror.at:g} can be turned about {'xyz'[scenario.mirror.axis]} alone"
        )


def sizes(scenario: Scenario) -> Tensor:
    """The sides [d] of the scenario's box, those that are almost 0 replaced."""
    return (scenario.upper - scenario.lower).clamp(min=FLAT * scenario.diagonal)


def search_space(lattice: Lattice, scenario: Scenario, surface: Array | None = None) -> Space:
    """Boxes with their centre in the scenario's box, and half axes from `SMALLEST` to 1 of its sides.

    Boxes of a symmetric design are symmetric about its plane. With points on the surface [k, d], which boxes that leave
    one of them out cannot move, faces lie from these on to a side of the scenario's box beyond it.
    """
    base, parameters = _parameters(lattice, scenario, surface)
    M, read = (np.zeros((lattice.size, len(parameters))) for _ in range(2))
    for column, one in enumerate(parameters):
        M[list(one.entries), column] = list(one.entries.values())
        read[list(one.read), column] = list(one.read.values())
    lower, upper = (torch.tensor([one[i] for one in parameters], dtype=torch.float64) for i in (2, 3))

    def sample(count: int, generator: torch.Generator) -> Tensor:
        draws = torch.rand(count, len(lower), generator=generator, dtype=torch.float64, device=generator.device)
        return torch.lerp(lower.to(draws), upper.to(draws), draws)

    return Space(
        lower,
        upper,
        sample,
        lambda points: points.new_tensor(base) + _mapped(M, points),
        lambda points, gradient: _mapped(M.T, gradient),
        lambda setups: _mapped(read.T, setups),
    )


def _mapped(M: Array, rows: Tensor) -> Tensor:
    """M times each of rows [..., c], added up in one order; NaN stays where it belongs."""
    matrix = rows.new_tensor(M)
    return torch.where(matrix != 0.0, matrix * rows[..., None, :], 0.0).sum(-1)


def _parameters(lattice: Lattice, scenario: Scenario, surface: Array | None) -> tuple[Array, list[Parameter]]:
    """The parameters of boxes that are searched on a scenario, and the genotype [D] where all of them are 0."""
    d, mirror = lattice.dimension, scenario.mirror
    low, high, side = (part.cpu().numpy() for part in (scenario.lower, scenario.upper, sizes(scenario)))
    reach = side.copy()
    if lattice.turn is not None:
        reach[list(lattice.turned)] = reach[list(lattice.turned)].max()
    base, centres, halves = np.zeros(lattice.size), [], []
    for axis in range(d):
        least = SMALLEST * reach[axis]
        if mirror is not None and axis == mirror.axis:
            base[axis] = mirror.at
            most = max(high[axis] - mirror.at, mirror.at - low[axis], reach[axis] / 2.0)
            if surface is not None:
                least = max(least, (1.0 + MARGIN) * float(np.abs(surface[:, axis] - mirror.at).max()))
            halves.append(same(d + axis, least, max(most, 2.0 * least)))
        elif surface is None:
            centres.append(same(axis, low[axis], high[axis]))
            halves.append(same(d + axis, least, reach[axis]))
        else:
            first, last = surface[:, axis].min() - MARGIN * side[axis], surface[:, axis].max() + MARGIN * side[axis]
            face = {axis: 0.5, d + axis: -0.5}, {axis: 1.0, d + axis: -1.0}
            centres.append(Parameter(*face, min(low[axis], first) - reach[axis], first))
            face = {axis: 0.5, d + axis: 0.5}, {axis: 1.0, d + axis: 1.0}
            halves.append(Parameter(*face, last, max(high[axis], last) + reach[axis]))
    found = [*centres, *halves]
    if lattice.turn is not None:
        found.append(same(2 * d, -math.pi / 2.0, math.pi / 2.0))
    begin = lattice.first_knot
    for axis, k in enumerate(lattice.inner if lattice.knots else ()):
        if mirror is not None and axis == mirror.axis:  # knots and their images
            base[begin + (k + 1) // 2 : begin + k] = 1.0
            base[begin + k // 2 : begin + (k + 1) // 2] = 0.5
            for j in range(k // 2):
                entries = {begin + j: 1.0, begin + k - 1 - j: -1.0}
                found.append(Parameter(entries, {begin + j: 1.0}, KNOTS[0], 0.5))
        else:
            found += [same(begin + j, *KNOTS) for j in range(k)]
        begin += k
    return base, found


def around(lattice: Lattice, scenario: Scenario) -> Array:
    """The genotype [D] of the smallest box around the design, a little larger, without a turn, knots evenly spaced.

    Of a symmetric design it is symmetric about the plane.
    """
    from rbfevo.scoring.representations.bsplines import uniform

    d, mirror = lattice.dimension, scenario.mirror
    vertices = scenario.vertices.cpu().numpy()
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if mirror is not None:
        a, at = mirror.axis, mirror.at
        farthest = max(high[a] - at, at - low[a])
        low[a], high[a] = at - farthest, at + farthest
    side = np.maximum(high - low, FLAT * float(np.linalg.norm(high - low)))
    genotype = np.zeros(lattice.size)
    genotype[:d] = (low + high) / 2.0
    if mirror is not None:
        genotype[mirror.axis] = mirror.at
    genotype[d : 2 * d] = side * (1.0 + MARGIN) / 2.0
    if lattice.knots:
        every = [uniform(n, p) for n, p in zip(lattice.counts, lattice.degrees, strict=True)]
        genotype[lattice.first_knot :] = np.concatenate(every)
    return genotype


def picks(whole: Array, count: int, of: int) -> Space:
    """Setups of `count` among `of` control points of one box: they can be drawn, and not be searched."""
    box = torch.from_numpy(whole)

    def sample(number: int, generator: torch.Generator) -> Tensor:
        draws = torch.rand(number, of, generator=generator, dtype=torch.float64, device=generator.device)
        index = draws.argsort(dim=1)[:, :count].sort(dim=1).values.to(torch.float64)
        return torch.cat((box.to(index).expand(number, -1), index), dim=1)

    lower, upper = (torch.cat((box, torch.full((count,), end, dtype=torch.float64))) for end in (0.0, of - 1.0))
    return Space(lower, upper, sample, lambda points: points, lambda points, gradient: gradient)


def spread(scenario: Scenario, count: int) -> Array:
    """Points S [count, d] among the vertices, far from each other: each the farthest from those before it.

    The first is the farthest from the middle of the design. Of a symmetric design they are on one side of its plane;
    held vertices are left out.

    Raises:
        UserError: if there are not as many vertices in different places.
    """
    design = scenario.half()
    vertices = design.vertices.cpu().numpy()
    if design.blend is not None:
        vertices = vertices[design.blend.cpu().numpy() > 0.0]
    if scenario.mirror is not None:
        vertices = scenario.mirror.snapped(vertices)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    chosen = [int(np.linalg.norm(vertices - middle, axis=1).argmax())]
    nearest = np.linalg.norm(vertices - vertices[chosen[0]], axis=1)
    for _ in range(count - 1):
        if not nearest.max() > 0.0:
            raise UserError(f"centers={count}: the design has only {len(chosen)} vertices in different places")
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
    return vertices[chosen]
