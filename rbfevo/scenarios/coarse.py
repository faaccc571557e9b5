"""A coarse design: fewer, weighted vertices that represent all of them in a search."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from rbfevo.geometry.blocks import vertex_blocks
from rbfevo.scenarios.scenario import Scenario


def coarsened(scenario: Scenario, count: int) -> Scenario:
    """The scenario on at most `count` cells of vertices, or the scenario itself if it has no more vertices than that.

    Each compact cell becomes one vertex: the weighted mean of its vertices and of their g, with the sum of their
    weights. Sums over the vertices then keep their value up to the square of the cells' size. The means lose the
    variation of g within a cell: its norm falls below 1, and P with it (see `matched`). It has no faces, and its
    target is fixed. Of a slab the cells are of one side alone, since a mean of front and back would lie between them,
    closer to the centers.
    """
    if len(scenario.vertices) <= count:
        return scenario
    scenario = scenario.front()
    n = len(scenario.vertices)
    if n <= count:
        return scenario
    blocks = vertex_blocks(scenario.vertices, scenario.gradient, scenario.weights, -(-n // count))
    cells = len(blocks)
    cell = torch.repeat_interleave(blocks.starts.diff().to(scenario.vertices.device))

    def total(rows: Tensor) -> Tensor:
        return rows.new_zeros(cells, rows.shape[1]).index_add_(0, cell, rows)

    roots = blocks.W[:, None]
    most = None if scenario.max_displacement is None else scenario.max_displacement[blocks.order]
    weights, moments, blend = total(roots.square()), blocks.g.T * roots, None
    if scenario.blend is not None:
        # With these, G and b of a column that is constant over a cell are those of the cell's vertices.
        own = scenario.blend[blocks.order, None]
        blend = (total((own * roots).square()) / weights).sqrt()
        moments = moments * own / torch.where(blend > 0, blend, 1.0)[cell]
    return dataclasses.replace(
        scenario,
        vertices=total(blocks.X.T * roots.square()) / weights,
        faces=scenario.faces[:0],
        gradient=total(moments) / weights,
        weights=weights[:, 0],
        closest=None,
        stays=None,
        blend=None if blend is None else blend[:, 0],
        max_displacement=None if most is None else (total(roots.square() * most[:, None]) / weights)[:, 0],
        gradient_raw=None,
    )


def matched(scenario: Scenario, potential: Tensor, expected: Tensor) -> Scenario:
    """A coarsened scenario with g scaled so that its P of some setups [p] comes closest to the P of the full design.

    Args:
        scenario: as `coarsened` leaves it.
        potential: [p] P on it; expected: [p] P of the same setups on the full design; of several objectives both
            [p, J], and each of their g is scaled by itself.

    The norm of g stays at most 1, and with it P.
    """
    if scenario.objectives is not None:
        columns = zip(scenario.each(), potential.unbind(1), expected.unbind(1), strict=True)
        fields = [matched(alone, own, other).gradient for alone, own, other in columns]
        return dataclasses.replace(scenario, gradient=scenario.objectives.stacked(fields))
    norm = (scenario.weights[:, None] * scenario.gradient.square()).sum().sqrt()
    slope = (expected * potential).sum() / potential.square().sum().clamp_min(torch.finfo(potential.dtype).tiny)
    factor = torch.minimum(slope.sqrt(), 1.0 / norm) if bool(slope > 0) else torch.ones_like(norm)
    return dataclasses.replace(scenario, gradient=factor * scenario.gradient)
