"""Gradients of the scores in the centers, against finite differences."""

from __future__ import annotations

import pytest
import torch
from designs import DESIGNS, KERNELS, PAIRS

from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.gradients import Spectrum, differentiable_scores

BACKENDS = ("fused", "eager")


def evaluator(design: str, kernel: str, manipulation: str, backend: str, weighted: bool = True) -> Evaluator:
    mesh = DESIGNS[design](12, 9, weighted=weighted) if design == "plane" else DESIGNS[design](2, weighted=weighted)
    phi = KERNELS[design][kernel]
    return Evaluator(mesh.vertices, mesh.gradient, phi, manipulation, mesh.weights, backend, block=40)


def setups(evaluate: Evaluator, *shape: int) -> torch.Tensor:
    """Random vertices moved a little: well-conditioned setups with no center on a kink of the kernel."""
    generator = torch.Generator().manual_seed(3)
    vertices = evaluate.deformation.vertices
    picked = torch.randperm(len(vertices), generator=generator)[: torch.Size(shape).numel()]
    noise = torch.randn(*shape, vertices.shape[1], generator=generator, dtype=torch.float64)
    return (vertices[picked].reshape(*shape, -1) + 0.03 * noise).requires_grad_()


def total(evaluate: Evaluator, centers: torch.Tensor) -> torch.Tensor:
    """The sum of all scores."""
    regularity, potential = differentiable_scores(evaluate, centers)
    return regularity.sum() + potential.sum()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_gradients_pass_gradcheck(design: str, kernel: str, manipulation: str, backend: str) -> None:
    evaluate = evaluator(design, kernel, manipulation, backend)
    centers = setups(evaluate, 2, 5)
    assert torch.autograd.gradcheck(lambda c: differentiable_scores(evaluate, c), centers, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_values_are_those_of_the_evaluator(design: str, kernel: str, manipulation: str, backend: str) -> None:
    evaluate = evaluator(design, kernel, manipulation, backend)
    centers = setups(evaluate, 2, 3, 6).detach()
    scores = evaluate(centers)
    regularity, potential = differentiable_scores(evaluate, centers)
    assert regularity.shape == potential.shape == (2, 3)
    torch.testing.assert_close(regularity, scores.regularity, rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(potential, scores.improvement_potential, rtol=0, atol=1e-9)


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_backends_agree_and_a_batch_is_a_loop(design: str, kernel: str, manipulation: str) -> None:
    gradients = []
    for backend, threads in (("fused", 1), ("fused", 2), ("eager", 1), ("eager", 2)):
        torch.set_num_threads(threads)
        evaluate = evaluator(design, kernel, manipulation, backend)
        centers = setups(evaluate, 3, 5)
        for pieces in ([centers], centers.split(1)):
            value = torch.stack([total(evaluate, part) for part in pieces]).sum()
            gradients.append(torch.autograd.grad(value, centers)[0])
    for other in gradients[1:]:
        torch.testing.assert_close(other, gradients[0], rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_degenerate_setups_have_finite_gradients_and_leave_the_others_alone(
    design: str, kernel: str, manipulation: str, backend: str
) -> None:
    evaluate = evaluator(design, kernel, manipulation, backend)
    sound = setups(evaluate, 5).detach()
    on_vertices = evaluate.deformation.vertices[:: len(evaluate.deformation.vertices) // 5][:5]
    coincident = sound.clone()
    coincident[1] = coincident[0]
    away = sound.clone()
    away[2] = 40.0
    lost = sound.clone()
    lost[3, 0] = torch.nan
    alone = sound.clone().requires_grad_()
    expected = torch.autograd.grad(total(evaluate, alone), alone)[0]
    batch = torch.stack([on_vertices, coincident, sound, away, lost]).requires_grad_()
    regularity, potential = differentiable_scores(evaluate, batch)
    gradient = torch.autograd.grad(regularity.sum() + potential.sum(), batch)[0]
    assert torch.isfinite(gradient).all()
    assert torch.isfinite(regularity).all()
    assert torch.isfinite(potential).all()
    assert regularity[4] == potential[4] == 0
    torch.testing.assert_close(gradient[2], expected, rtol=1e-10, atol=1e-12)
    if evaluate.deformation.kernel.support is not None:
        assert regularity[3] == 0
        assert (gradient[3, 2] == 0).all()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("trouble", ["duplicate", "out of reach", "nan"])
def test_a_rank_deficient_setup_has_no_gradient_of_its_potential(trouble: str, backend: str) -> None:
    evaluate = evaluator("plane", "wendland 0.25", "indirect", backend)
    centers = setups(evaluate, 2, 5).detach()
    if trouble == "duplicate":
        centers[0, 1] = centers[0, 0]
    else:
        centers[0, 1] = torch.nan if trouble == "nan" else 30.0
    spectrum = Spectrum(evaluate, centers)
    # A center out of reach has a column of zeros, which takes nothing from the others: there P has a gradient.
    assert spectrum.improvable.tolist() == [trouble == "out of reach", True]
    assert spectrum.regular.tolist() == [False, True]
    centers.requires_grad_()
    _, potential = differentiable_scores(evaluate, centers)
    (gradient,) = torch.autograd.grad(potential.sum(), centers)
    assert bool((gradient[0] == 0).all()) == (trouble != "out of reach")
    assert bool((gradient[1] != 0).any())
    if trouble == "out of reach":
        assert bool((gradient[0, 1] == 0).all())
