"""Coarsened designs: fewer vertices, nearly the same scores."""

from __future__ import annotations

import pytest
import torch

from rbfevo.scenarios import face, plane
from rbfevo.scenarios.coarse import coarsened, matched
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import Kernel, triharmonic, wendland


def scores(scenario: Scenario, kernel: Kernel, centers: torch.Tensor) -> torch.Tensor:
    evaluate = Evaluator(scenario.vertices, scenario.gradient, kernel, "direct", scenario.weights)
    return evaluate(centers).objectives


@pytest.mark.parametrize("kernel", [wendland, triharmonic])
@pytest.mark.parametrize("name", ["plane", "face"])
def test_scores_are_nearly_those_of_the_full_design(name: str, kernel) -> None:
    full = plane((80, 80)) if name == "plane" else face(4)
    centers = full.sample(30, 9, torch.Generator().manual_seed(0))
    phi = kernel(full.vertices.shape[1], full.support)
    exact = scores(full, phi, centers)
    errors = []
    for count in (600, 1300):
        fewer = coarsened(full, count)
        assert len(fewer.vertices) <= count
        assert float(fewer.weights.sum()) == pytest.approx(float(full.weights.sum()), rel=1e-12)
        found = scores(fewer, phi, centers)
        fewer = matched(fewer, found[:, 1], exact[:, 1])
        norm = float((fewer.weights[:, None] * fewer.gradient**2).sum())
        assert norm <= 1 + 1e-12
        found = scores(fewer, phi, centers)
        errors.append((found - exact).abs().amax(0))
        assert float(errors[-1][1]) < 0.03
        assert float(((found - exact).abs()[:, 0] / exact[:, 0]).median()) < 0.03
    assert (errors[1] < errors[0]).all()


def test_a_small_design_is_left_as_it_is() -> None:
    design = plane((20, 20))
    assert coarsened(design, 400) is design
    assert coarsened(design, 399) is not design


def test_cells_are_weighted_means() -> None:
    design = plane((10, 10))
    weights = torch.rand(100, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.5
    design = Scenario(**{**vars(design), "weights": weights})
    fewer = coarsened(design, 25)
    total = (design.weights[:, None] * design.vertices).sum(0)
    torch.testing.assert_close((fewer.weights[:, None] * fewer.vertices).sum(0), total)
    total = (design.weights[:, None] * design.gradient).sum(0)
    torch.testing.assert_close((fewer.weights[:, None] * fewer.gradient).sum(0), total)
    assert len(fewer.faces) == 0


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.0])
def test_p_is_matched_as_the_square_of_g(factor: float) -> None:
    fewer = coarsened(plane((30, 30)), 100)
    potential = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    scaled = matched(fewer, potential, factor**2 * potential)
    torch.testing.assert_close(scaled.gradient, factor * fewer.gradient)
    norm = (fewer.weights[:, None] * fewer.gradient.square()).sum().sqrt()
    assert float(norm) < 0.99  # means lose what g does within a cell
    scaled = matched(fewer, potential, 4.0 * potential)  # but its norm stays at most 1
    torch.testing.assert_close(scaled.gradient, fewer.gradient / norm)
