"""Smooth objectives and the geometry of fronts: bounds, gradients against autograd, archives against moocore."""

from __future__ import annotations

import math

import moocore
import numpy as np
import pytest
import torch
from designs import PAIRS
from test_gradients import evaluator, setups
from torch import Tensor

from rbfevo.methods.gradient.tracing import (
    Aim,
    Archive,
    Preference,
    Tchebycheff,
    WeightedSum,
    climbs,
    exponents,
    front_normals,
    soft_regularity,
)
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.pareto import hypervolume


def test_climbs_have_floors() -> None:
    objectives = torch.tensor([[0.5, 0.9], [0.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
    expected = [[math.log(0.5), -math.log(0.1)], [math.log(1e-12), 0.0], [0.0, -math.log(1e-9)]]
    torch.testing.assert_close(climbs(objectives), torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_soft_regularity_is_a_lower_bound_that_becomes_sharp(design: str, kernel: str, manipulation: str) -> None:
    evaluate = evaluator(design, kernel, manipulation, "fused")
    spectrum = Spectrum(evaluate, setups(evaluate, 4, 5))
    exact, before = spectrum.regularity.log(), torch.full((4,), -torch.inf, dtype=torch.float64)
    for q in (4.0, 16.0, 64.0, 1024.0):
        value, slope = soft_regularity(spectrum, torch.full_like(exact, q))
        assert (before < value + 1e-12).all()
        assert (value <= exact + 1e-12).all()
        assert (value >= exact - 2 * math.log(5) / q - 1e-12).all()
        torch.testing.assert_close(slope.sum(1), torch.zeros(4, dtype=torch.float64), rtol=0, atol=1e-12)
        before = value


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_gradient_of_the_soft_regularity(design: str, kernel: str, manipulation: str) -> None:
    evaluate = evaluator(design, kernel, manipulation, "fused")
    centers = setups(evaluate, 1, 5).detach()
    q = torch.tensor([12.0], dtype=torch.float64)
    spectrum = Spectrum(evaluate, centers)
    gradient = spectrum.backward(soft_regularity(spectrum, q)[1], torch.zeros(1, dtype=torch.float64))
    direction = torch.randn(centers.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    h = 1e-6
    ahead, behind = (soft_regularity(Spectrum(evaluate, centers + s * h * direction), q)[0] for s in (1, -1))
    expected = float((ahead - behind) / (2 * h))
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-7)


def test_setups_without_regularity_stand_on_the_floor_and_do_not_move_by_it() -> None:
    evaluate = evaluator("plane", "wendland 0.25", "direct", "fused")
    centers = setups(evaluate, 3, 5).detach()
    centers[1, 1] = centers[1, 0]
    centers[2, 0] = torch.nan
    spectrum = Spectrum(evaluate, centers)
    value, slope = soft_regularity(spectrum, exponents(spectrum.regularity, 16.0))
    assert (value[1:] == math.log(1e-12)).all()
    assert (slope[1:] == 0).all()
    gradient = spectrum.backward(slope, torch.ones(3, dtype=torch.float64))
    assert gradient.isfinite().all()
    assert (gradient[2] == 0).all()


def aims() -> dict[str, Aim]:
    generator = torch.Generator().manual_seed(1)
    normals = torch.rand(7, 2, generator=generator, dtype=torch.float64)
    normals[0, 1] = 0.0
    outwards = Tchebycheff(normals / normals.sum(1, keepdim=True), torch.tensor([2.0, 3.0], dtype=torch.float64), 0.1)
    outwards(torch.full((7,), -1.0, dtype=torch.float64), torch.full((7,), 0.8, dtype=torch.float64))
    weights = torch.linspace(0, 1, 7, dtype=torch.float64)
    return {"sum": WeightedSum(weights), "preference": Preference(weights), "outwards": outwards}


def plain(name: str, aim: Aim, log_regularity: Tensor, potential: Tensor) -> Tensor:
    """The aims as their formulas stand, for autograd."""
    lift = -(1 - potential).log()
    if isinstance(aim, WeightedSum):
        return aim.weights * log_regularity + (1 - aim.weights) * lift
    if isinstance(aim, Preference):
        return aim.preferences * log_regularity.exp() + (1 - aim.preferences) * potential
    assert isinstance(aim, Tchebycheff)
    gain = torch.stack((log_regularity + 1.0, lift + math.log(0.2)), 1) / (aim.span * aim.tau)
    return -aim.tau * (aim.normals.exp() * (-gain).exp()).sum(1).log()


@pytest.mark.parametrize("name", ["sum", "preference", "outwards"])
def test_aims_and_their_gradients(name: str) -> None:
    aim = aims()[name]
    generator = torch.Generator().manual_seed(2)
    log_regularity = (-torch.rand(7, generator=generator, dtype=torch.float64)).requires_grad_()
    potential = (0.5 + 0.4 * torch.rand(7, generator=generator, dtype=torch.float64)).requires_grad_()
    value, first, second = aim(log_regularity.detach(), potential.detach())
    expected = plain(name, aim, log_regularity, potential)
    torch.testing.assert_close(value, expected.detach())
    slopes = torch.autograd.grad(expected.sum(), [log_regularity, potential])
    torch.testing.assert_close((first, second), slopes)


def test_normals_of_a_quarter_circle_point_outwards() -> None:
    angle = torch.linspace(0.5 * math.pi, 0.0, 400, dtype=torch.float64)
    f = torch.stack((angle.cos(), angle.sin()), 1)  # on the scales of `climbs`
    front = torch.stack(((f[:, 0] - 2).exp(), 1 - (-f[:, 1]).exp()), 1)
    rows = torch.tensor([50, 200, 350])
    normals, span = front_normals(front, rows)
    torch.testing.assert_close(span, torch.ones(2, dtype=torch.float64), rtol=1e-9, atol=1e-9)
    expected = f[rows] / f[rows].sum(1, keepdim=True)
    torch.testing.assert_close(normals, expected, rtol=0, atol=0.02)


def test_a_front_of_one_point_has_normals() -> None:
    normals, span = front_normals(torch.tensor([[0.5, 0.5]], dtype=torch.float64), torch.zeros(3, dtype=torch.long))
    assert normals.isfinite().all()
    assert (span > 0).all()


def test_an_archive_is_the_nondominated_part_of_all_it_has_seen() -> None:
    generator = torch.Generator().manual_seed(5)
    seen = torch.rand(12, 40, 2, generator=generator, dtype=torch.float64)
    seen[3] = seen[2]  # duplicates
    seen[4, 0] = torch.nan
    archive = Archive(torch.zeros(1, 2, dtype=torch.float64), limit=10_000)
    for objectives in seen:
        archive.add(objectives, objectives)
    torch.testing.assert_close(archive.points, archive.objectives)
    table = seen.reshape(-1, 2)
    table = table[table.isfinite().all(1)].unique(dim=0).numpy()
    expected = table[moocore.is_nondominated(table, maximise=True)]
    np.testing.assert_array_equal(archive.objectives.numpy(), expected[expected[:, 0].argsort()])


def test_a_full_archive_keeps_its_ends_and_most_of_its_hypervolume() -> None:
    angle = torch.linspace(0, 0.5 * math.pi, 500, dtype=torch.float64)
    circle = torch.stack((angle.sin(), angle.cos()), 1)
    archive = Archive(circle, limit=100)
    archive.add(circle, circle)
    assert len(archive.objectives) == 50
    torch.testing.assert_close(archive.objectives[[0, -1]], circle[[0, -1]], rtol=0, atol=0)
    assert hypervolume(archive.objectives) > 0.98 * hypervolume(circle)
