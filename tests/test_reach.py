"""Warnings about support radii that do not fit the mesh."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from rbfevo.geometry.mirror import Mirror
from rbfevo.scenarios import plane
from rbfevo.scenarios.reach import out_of_reach, unfit


def test_a_center_whose_image_alone_reaches_a_vertex_is_not_idle() -> None:
    whole = plane((11, 21))
    # Only the half at x <= 0.5 is left of the design; the center lies at x = 0.9, and its image at x = 0.1.
    kept = whole.vertices[:, 0] <= 0.5
    half = dataclasses.replace(
        whole, vertices=whole.vertices[kept], gradient=whole.gradient[kept], weights=whole.weights[kept]
    )
    mirror = Mirror.across(0, 0.5, whole.lower, whole.upper)
    setups = torch.tensor([[[0.9, 1.0], [0.3, 1.0]], [[0.2, 0.5], [0.3, 1.0]]], dtype=torch.float64)
    (line,) = out_of_reach(half, 0.3, setups)
    assert line.startswith(
        "1 of 2 setups have R = 0: some of their centers (up to 1) have no free vertex within the support radius 0.3"
    )
    assert out_of_reach(dataclasses.replace(half, mirror=mirror), 0.3, setups) == []
    assert out_of_reach(half, None, setups) == []


def test_a_center_as_far_away_as_the_support_radius_reaches_nothing() -> None:
    design = plane((2, 2))  # vertices at the corners of [0, 1] x [0, 2]
    setup = torch.tensor([[[-0.5, 0.0], [-0.25, 2.0]]], dtype=torch.float64)
    assert len(out_of_reach(design, 0.5, setup)) == 1
    assert out_of_reach(design, 0.5 + 1e-9, setup) == []


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_radii_are_compared_with_edges_and_with_the_box(scale: float) -> None:
    design = plane((11, 21))  # edges of 0.1
    design = dataclasses.replace(
        design, vertices=scale * design.vertices, lower=scale * design.lower, upper=scale * design.upper
    )
    (line,) = unfit(design, 0.09 * scale)
    assert "is below the vertex spacing" in line
    assert unfit(design, 0.11 * scale) == unfit(design, 4.4 * scale) == []
    (line,) = unfit(design, 4.6 * scale)  # the diagonal is 2.236
    assert "2.06 times the diagonal of the box" in line
