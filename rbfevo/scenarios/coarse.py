"""A design by fewer, weighted vertices that stand for all of them: what a search may look at before the last word."""

from __future__ import annotations

import dataclasses

import torch

from rbfevo.blocks import vertex_blocks
from rbfevo.scenarios.scenario import Scenario


def coarsened(scenario: Scenario, count: int) -> Scenario:
    """The scenario on at most `count` cells of vertices, or the scenario itself where it has no more than those.

    Each compact cell becomes one vertex: the weighted mean of its vertices and of their g, with the sum of their
    weights. Sums over the vertices then keep their value but for the square of the cells' size, and so do G, b and P (g
    keeps its scale and is not brought to unit norm again). It has no faces.
    """
    n = len(scenario.vertices)
    if n <= count:
        return scenario
    blocks = vertex_blocks(scenario.vertices, scenario.gradient, scenario.weights, -(-n // count))
    cells = len(blocks)
    device = scenario.vertices.device
    sizes = blocks.starts.diff().to(device)
    cell = torch.repeat_interleave(torch.arange(cells, device=device), sizes)

    def total(rows: torch.Tensor) -> torch.Tensor:
        return rows.new_zeros(cells, rows.shape[1]).index_add_(0, cell, rows)

    roots = blocks.W[:, None]
    weights = total(roots.square())
    return dataclasses.replace(
        scenario,
        vertices=total(blocks.X.T * roots.square()) / weights,
        faces=scenario.faces[:0],
        gradient=total(blocks.g.T * roots) / weights,
        weights=weights[:, 0],
    )
