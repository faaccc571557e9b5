"""Symmetric setups: scores against plain NumPy, gradients against differences, and what the displacements look like."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from designs import sphere
from scipy.spatial.distance import cdist

from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.methods.gradient.tracing import soft_regularity
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.gradients import differentiable_scores
from rbfevo.scoring.kernels import Cubic, Kernel, Wendland
from rbfevo.scoring.symmetric import MirroredEvaluator, MirroredSpectrum

KERNELS = {"wendland": Wendland(0.9), "cubic": Cubic()}
AXIS, AT = 1, 0.05
DESIGN = sphere(3, weighted=True)
CORNER = 1.2 * torch.ones(3, dtype=torch.float64)
MIRROR = Mirror.across(AXIS, AT, -CORNER, CORNER)


def evaluator(kernel: Kernel, manipulation: str, backend: str = "auto") -> MirroredEvaluator:
    return MirroredEvaluator(
        DESIGN.vertices, DESIGN.gradient, kernel, manipulation, DESIGN.weights, backend, block=100, mirror=MIRROR
    )


def population() -> torch.Tensor:
    """Setups of five centers: free ones, one or more on the plane, all on it, one with a center beyond everything."""
    centers = DESIGN.centers(7, 5, seed=3)
    centers[0, -1, AXIS] = AT
    centers[1, :, AXIS] = AT
    centers[2, 1:3, AXIS] = AT
    centers[3, 0] = torch.nan
    centers[4, 0] = 60.0
    centers[5, 2] = centers[5, 3]
    return centers


def oracle(setup: np.ndarray, kernel: Kernel, manipulation: str) -> tuple[float, float]:
    """R and P of one setup, by plain NumPy from the words of `rbfevo.scoring.symmetric`."""
    X, g, w = DESIGN.vertices.numpy(), DESIGN.gradient.numpy(), DESIGN.weights.numpy()

    def phi(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return kernel(torch.from_numpy(cdist(a, b))).numpy()

    sigmas, potential = [], 0.0
    free = setup[np.abs(setup[:, AXIS] - AT) > 1e-9]
    for sign, components, C in ((1.0, [0, 2], setup), (-1.0, [1], free)):
        images = C.copy()
        images[:, AXIS] = 2 * AT - C[:, AXIS]
        U = np.sqrt(w)[:, None] * (phi(X, C) + sign * phi(X, images))
        Q, _ = np.linalg.qr(U)
        potential += float(((Q.T @ (np.sqrt(w)[:, None] * g[:, components])) ** 2).sum())
        if manipulation == "direct":
            U = U @ np.linalg.inv(phi(C, C) + sign * phi(images, C))
        sigmas.append(np.linalg.svd(U, compute_uv=False))
    every = np.concatenate(sigmas)
    return every.min() / every.max(), potential


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_the_definition_is_plain_numpy(kernel: str, manipulation: str) -> None:
    centers = population()
    scores = evaluator(KERNELS[kernel], manipulation).definition(centers)
    for i in (0, 1, 2, 6):
        regularity, potential = oracle(centers[i].numpy(), KERNELS[kernel], manipulation)
        assert float(scores.regularity[i]) == pytest.approx(regularity, rel=1e-9)
        assert float(scores.improvement_potential[i]) == pytest.approx(potential, abs=1e-10)
    assert scores.failed.tolist() == [i == 3 for i in range(7)]
    assert float(scores.regularity[5]) == 0.0  # two columns are one
    assert float(scores.variability[0]) == 5 / len(DESIGN.vertices)


@pytest.mark.parametrize("backend", ["fused", "eager"])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_the_fast_path_is_the_definition(kernel: str, manipulation: str, backend: str) -> None:
    evaluate = evaluator(KERNELS[kernel], manipulation, backend)
    centers = population()
    fast, slow = evaluate(centers), evaluate.definition(centers)
    assert bool(((fast.regularity - slow.regularity).abs() <= 1e-6 * slow.regularity + 1e-12).all())
    torch.testing.assert_close(fast.improvement_potential, slow.improvement_potential, rtol=0, atol=1e-8)
    torch.testing.assert_close(fast.variability, slow.variability, rtol=0, atol=0)
    assert fast.failed.tolist() == slow.failed.tolist()
    assert evaluate.evaluations == 7
    assert evaluate.failed_evaluations == 1


@pytest.mark.parametrize("backend", ["fused", "eager"])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_gradients_are_those_of_differences(kernel: str, manipulation: str, backend: str) -> None:
    evaluate = evaluator(KERNELS[kernel], manipulation, backend)
    generator = torch.Generator().manual_seed(5)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    centers = 1.05 * DESIGN.centers(3, 5, seed=8)
    centers[0, -1, AXIS] = AT
    slope, share, way = draw(3, 10), draw(3), draw(3, 5, 3) - 0.5
    slope[0, -1] = 0.0  # the center on the plane has no column across: its place in sigma is a filler
    way[0, -1, AXIS] = 0.0

    def value(c: torch.Tensor) -> torch.Tensor:
        spectrum = MirroredSpectrum(evaluate, c)
        return (slope * spectrum.sigma.log()).sum(1) + share * spectrum.potential

    gradient = MirroredSpectrum(evaluate, centers).backward(slope, share)
    h = 1e-6
    expected = (value(centers + h * way) - value(centers - h * way)) / (2 * h)
    torch.testing.assert_close((gradient * way).sum((1, 2)), expected, rtol=1e-5, atol=1e-5)
    spectrum, scores = MirroredSpectrum(evaluate, centers), evaluate(centers)
    torch.testing.assert_close(spectrum.regularity, scores.regularity, rtol=1e-9, atol=0)
    torch.testing.assert_close(spectrum.potential, scores.improvement_potential, rtol=0, atol=1e-12)


def test_a_spectrum_of_bad_setups_is_finite() -> None:
    evaluate = evaluator(KERNELS["wendland"], "direct")
    centers = population()
    spectrum = MirroredSpectrum(evaluate, centers)
    assert bool(spectrum.sigma.isfinite().all())
    assert bool(
        spectrum.backward(torch.ones(7, 10, dtype=torch.float64), torch.ones(7, dtype=torch.float64)).isfinite().all()
    )
    assert spectrum.regularity.tolist() == pytest.approx(evaluate(centers).regularity.tolist(), rel=1e-6, abs=1e-12)


def test_a_symmetric_pull_is_out_of_reach_of_equal_signs_alone() -> None:
    """Both flanks want outwards: columns phi_c + phi_c' for all components would reach nothing of it."""
    vertices, wanted = DESIGN.vertices, torch.zeros_like(DESIGN.vertices)
    heights = vertices[:, AXIS]
    wanted[:, AXIS] = heights
    wanted /= wanted.norm()
    mirror = Mirror.across(AXIS, 0.0, -CORNER, CORNER)
    setup = torch.tensor([[[0.0, 0.9, 0.0], [0.6, 0.6, 0.0], [-0.6, 0.6, 0.0]]], dtype=torch.float64)
    evaluate = MirroredEvaluator(vertices, wanted, Wendland(1.5), mirror=mirror)
    assert float(evaluate(setup).improvement_potential) > 0.8
    assert float(evaluate.along(setup).improvement_potential) < 1e-12


def test_a_setup_far_from_the_plane_scores_like_both_halves_together() -> None:
    """Where images do not overlap, U of the pair is that of 2m free centers with their columns added or subtracted."""
    vertices = torch.cat([DESIGN.vertices + 5.0 * torch.eye(3, dtype=torch.float64)[AXIS], DESIGN.vertices])
    vertices[len(DESIGN.vertices) :, AXIS] = -vertices[: len(DESIGN.vertices), AXIS]
    vertices[len(DESIGN.vertices) :, [0, 2]] = vertices[: len(DESIGN.vertices)][:, [0, 2]]
    turned = DESIGN.gradient.clone()
    turned[:, AXIS] *= -1.0
    gradient = torch.cat([DESIGN.gradient, turned]) / np.sqrt(2 * float(DESIGN.gradient.square().sum()))
    corner = 10.0 * torch.ones(3, dtype=torch.float64)
    mirror = Mirror.across(AXIS, 0.0, -corner, corner)
    setup = DESIGN.centers(4, 6) + 5.0 * torch.eye(3, dtype=torch.float64)[AXIS]
    pair = MirroredEvaluator(vertices, gradient, Wendland(0.9), mirror=mirror)(setup)
    n = len(DESIGN.vertices)
    half = Evaluator(vertices[:n], gradient[:n] * np.sqrt(2.0), Wendland(0.9))(setup)
    torch.testing.assert_close(pair.regularity, half.regularity, rtol=1e-9, atol=0)
    torch.testing.assert_close(pair.improvement_potential, half.improvement_potential, rtol=0, atol=1e-10)


def test_planes_that_miss_the_box_and_heights_are_refused() -> None:
    with pytest.raises(UserError, match=r"does not cross the box \(y from -1\.2 to 1\.2\)"):
        Mirror.across(1, 3.0, -CORNER, CORNER)
    with pytest.raises(UserError, match="three components"):
        MirroredEvaluator(DESIGN.vertices, DESIGN.gradient[:, :1], Wendland(1.0), mirror=MIRROR)


def test_what_fills_the_place_of_a_missing_column_lies_between_the_extremes() -> None:
    """A filler has no part in R, sharp or soft: it is the geometric mean of the extremes of both blocks."""
    for manipulation in ("indirect", "direct"):
        evaluate = evaluator(KERNELS["wendland"], manipulation)
        centers = population()[[0, 2, 6]]
        centers[1, 3:] += 0.3  # the block along the plane has the smallest singular value, or the one across it
        spectrum = MirroredSpectrum(evaluate, centers)
        missing = [1, 2, 0]
        for sigma, scores, count in zip(spectrum.sigma, evaluate(centers).regularity, missing, strict=True):
            real = torch.cat((sigma[:5], sigma[5 : 10 - count]))
            middle = (real.amin() * real.amax()).sqrt()
            torch.testing.assert_close(sigma[10 - count :], middle.expand(count))
            assert float(real.amin() / real.amax()) == pytest.approx(float(scores), rel=1e-9)
        q = torch.full((3,), 24.0, dtype=torch.float64)
        soft, slope = soft_regularity(spectrum, q)
        assert bool((soft <= spectrum.regularity.log() + 1e-12).all())
        assert bool((soft >= spectrum.regularity.log() - 2.0 * np.log(10) / 24.0).all())
        way = torch.randn(centers.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        way[evaluate.mirror.on_plane(centers)] = 0.0
        ahead, behind = (soft_regularity(MirroredSpectrum(evaluate, centers + s * way), q)[0] for s in (1e-6, -1e-6))
        found = (spectrum.backward(slope, torch.zeros(3, dtype=torch.float64)) * way).sum((1, 2))
        torch.testing.assert_close(found, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_differentiable_scores_of_symmetric_setups_are_the_evaluators(kernel: str, manipulation: str) -> None:
    evaluate = evaluator(KERNELS[kernel], manipulation)
    centers = population()
    regularity, potential = differentiable_scores(evaluate, centers)
    scores = evaluate.definition(centers)
    assert bool(((regularity - scores.regularity).abs() <= 1e-6 * scores.regularity + 1e-12).all())
    torch.testing.assert_close(potential, scores.improvement_potential, rtol=0, atol=1e-8)
    free = DESIGN.centers(2, 3, 4, seed=8)[:, :2].clone().requires_grad_()
    way = torch.randn(free.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def value(c: torch.Tensor) -> torch.Tensor:
        R, P = differentiable_scores(evaluate, c)
        assert R.shape == P.shape == (2, 2)
        return R + P

    (gradient,) = torch.autograd.grad(value(free).sum(), free)
    expected = (value(free.detach() + 1e-6 * way) - value(free.detach() - 1e-6 * way)) / 2e-6
    torch.testing.assert_close((gradient * way).sum((2, 3)), expected.detach(), rtol=1e-4, atol=1e-7)


def test_differentiable_scores_of_ill_conditioned_symmetric_setups() -> None:
    evaluate = evaluator(KERNELS["cubic"], "indirect")
    centers = DESIGN.centers(2, 6, seed=9).requires_grad_()
    close = centers.detach().clone()
    close[0, 1] = close[0, 0] + 1e-7
    close[1, 1] = close[1, 0]  # rank-deficient
    close.requires_grad_()
    regularity, potential = differentiable_scores(evaluate, close)
    assert evaluate.further_passes > 0
    scores = evaluate.definition(close)
    assert float(regularity[0].detach()) == pytest.approx(float(scores.regularity[0]), rel=1e-3)
    assert float(regularity[1].detach()) == 0.0
    (gradient,) = torch.autograd.grad(regularity.sum() + potential.sum(), close)
    assert bool(gradient.isfinite().all())
    assert bool((gradient[1] == 0).all())
