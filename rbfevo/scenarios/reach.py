"""Warnings about a support radius that is too small for the vertices or the places of the centers, or too large."""

from __future__ import annotations

import math

import torch
from scipy.spatial import KDTree
from torch import Tensor

from rbfevo.scenarios.scenario import Scenario

FARTHEST = 2.0  # diagonals of the box
THICK = 1.5  # support radii below that many times half the thickness of a slab get a warning


def unfit(scenario: Scenario, support: float | None) -> list[str]:
    """A warning if the support radius is below the vertex spacing (the median edge), or far beyond the box."""
    faces, vertices = scenario.faces, scenario.vertices
    if support is not None and support > FARTHEST * scenario.diagonal:
        return [
            f"the support radius {support:g} is {support / scenario.diagonal:.3g} times the diagonal of "
            "the box, so every center moves everything almost alike; for a percentage write kernel.support=15%"
        ]
    if support is not None and scenario.planar is not None and support < THICK * scenario.planar.depth:
        depth, wanted = scenario.planar.depth, math.hypot(scenario.support, scenario.planar.depth)
        reach = f"{math.sqrt(support**2 - depth**2):.3g} in the plane" if support > depth else "no vertex at all"
        return [
            f"the slab is {2.0 * depth:g} thick, so a center in its mid-plane with the support radius {support:g} "
            f"reaches {reach}; a thinner slab, or a kernel.support of {wanted:.3g} or more, is better conditioned"
        ]
    if support is None or not len(faces):
        return []
    edges = torch.cat((faces[:, :2], faces[:, 1:], faces[:, ::2]))
    spacing = float((vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1).median())
    if support >= spacing:
        return []
    return [
        f"the support radius {support:g} is below the vertex spacing {spacing:g} (median edge), so a center moves "
        "one vertex or none; increase kernel.support"
    ]


def out_of_reach(scenario: Scenario, support: float | None, centers: Tensor) -> list[str]:
    """A warning if setups [p, m, d] have centers without a free vertex within the support radius, which makes R = 0."""
    if support is None or not len(centers):
        return []
    idle = idle_centers(scenario, support, centers[torch.isfinite(centers).flatten(1).all(1)]).sum(1)
    if not bool((idle > 0).any()):
        return []
    return [
        f"{int((idle > 0).sum())} of {len(idle)} setups have R = 0: some of their centers (up to {int(idle.max())}) "
        f"have no free vertex within the support radius {support:g} and move nothing"
    ]


def idle_centers(scenario: Scenario, support: float, centers: Tensor) -> Tensor:
    """Which centers [p, m, d], finite, have no free vertex in reach, and move nothing: [p, m] bool.

    A vertex is free where it is not held.
    """
    free = scenario.vertices if scenario.blend is None else scenario.vertices[scenario.blend > 0]
    tree = KDTree(free.cpu().numpy())

    def near(points: Tensor) -> Tensor:
        return torch.from_numpy(tree.query(points.flatten(0, 1).numpy())[0]).view(points.shape[:2])

    distance = near(centers.cpu())
    if scenario.mirror is not None:
        distance = torch.minimum(distance, near(scenario.mirror.image(centers.cpu())))
    return distance >= support
