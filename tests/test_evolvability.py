"""Regularity, improvement potential and variability by definition, against plain NumPy."""

import numpy as np
import pytest
import torch
from designs import DESIGNS, EPS, KERNELS, PAIRS, numpy_scores
from hypothesis import given
from hypothesis import strategies as st

from rbfevo.scoring.deformation import MANIPULATIONS, RBFDeformation
from rbfevo.scoring.evolvability import cutoff, evolvability, score, singular
from rbfevo.scoring.kernels import ThinPlate, Wendland

both = pytest.mark.parametrize("manipulation", MANIPULATIONS)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def unit(gradient: torch.Tensor) -> torch.Tensor:
    return gradient / gradient.norm()


@pytest.mark.parametrize(("design", "kernel"), PAIRS)
@both
@pytest.mark.parametrize("m", [1, 2, 25])
@pytest.mark.parametrize(("k", "weighted"), [(1, False), (3, True)])
def test_definition_is_numpys(design: str, kernel: str, manipulation: str, m: int, k: int, weighted: bool) -> None:
    built = DESIGNS[design](*((20, 25) if design == "plane" else (3,)), k=k, weighted=weighted)
    phi = KERNELS[design][kernel]
    centers = built.centers(4, m, seed=m)
    found = score(RBFDeformation(built.vertices, phi, manipulation), centers, built.gradient, built.weights)
    wanted = np.array([numpy_scores(built, phi, manipulation, setup) for setup in centers])
    np.testing.assert_allclose(found.regularity.numpy(), wanted[:, 0], rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(found.improvement_potential.numpy(), wanted[:, 1], rtol=0.0, atol=1e-11)
    np.testing.assert_array_equal(found.variability.numpy(), wanted[:, 2])
    assert not found.failed.any()
    assert found.objectives.shape == (4, 2)
    assert all(column.dtype == torch.float64 for column in found[:3])


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
@both
def test_a_batch_is_a_loop(shape: tuple[int, ...], manipulation: str) -> None:
    built = DESIGNS["sphere"](2)
    deformation = RBFDeformation(built.vertices, Wendland(1.0), manipulation)
    centers = built.centers(*shape, 5)
    found = score(deformation, centers, built.gradient)
    assert found.regularity.shape == found.failed.shape == shape
    assert found.objectives.shape == (*shape, 2)
    ones = [score(deformation, setup, built.gradient) for setup in centers.reshape(-1, 5, 3)]
    for batch, single in zip(found, zip(*ones, strict=True), strict=True):
        assert torch.equal(batch.reshape(-1), torch.stack(single))

    U = deformation(centers)
    R, P, V = evolvability(U, built.gradient)
    torch.testing.assert_close(R, found.regularity, rtol=1e-11, atol=0.0)
    torch.testing.assert_close(P, found.improvement_potential, rtol=0.0, atol=1e-12)
    assert torch.equal(V, found.variability)


def test_orthonormal_columns() -> None:
    Q, _ = torch.linalg.qr(random(40, 6))
    g = unit(random(40, 2, seed=1))
    R, P, V = evolvability(Q, g)
    assert R.item() == pytest.approx(1.0, abs=1e-14)
    assert P.item() == pytest.approx(float((Q.mT @ g).square().sum()), abs=1e-14)
    assert V.item() == 6 / 40


def test_gradient_inside_and_outside_the_range() -> None:
    U = random(40, 6)
    Q, _ = torch.linalg.qr(U)
    inside = unit(U @ random(6, 3, seed=1))
    outside = random(40, 3, seed=2)
    outside = unit(outside - Q @ (Q.mT @ outside))
    assert evolvability(U, inside)[1].item() == pytest.approx(1.0, abs=1e-14)
    assert evolvability(U, outside)[1].item() == pytest.approx(0.0, abs=1e-14)
    assert evolvability(random(6, 6), unit(random(6, 1)))[1].item() == pytest.approx(1.0, abs=1e-14)


@given(n=st.integers(1, 30), m=st.integers(1, 12), k=st.integers(1, 3), seed=st.integers(0, 10**6))
def test_properties(n: int, m: int, k: int, seed: int) -> None:
    U, g = random(n, m, seed=seed), unit(random(n, k, seed=seed + 1))
    R, P, V = evolvability(U, g)
    assert 0.0 <= R <= 1.0
    assert 0.0 <= P <= 1.0
    assert V.item() == np.linalg.matrix_rank(U.numpy()) / n
    assert (R > 0.0) == (m <= n)
    # Scaling and rotating the control points' space changes nothing.
    Q, _ = torch.linalg.qr(random(m, m, seed=seed + 2))
    R2, P2, V2 = evolvability(7.0 * U @ Q, g)
    assert R2.item() == pytest.approx(R.item(), rel=1e-8, abs=1e-14)
    assert P2.item() == pytest.approx(P.item(), abs=1e-8)
    assert V2 == V


@pytest.mark.parametrize(("step", "rank"), [(0.5, 3), (2.0, 4)])
def test_cutoff_is_max_n_m_eps_of_the_largest(step: float, rank: int) -> None:
    n, m = 50, 4
    assert cutoff(n, m) == cutoff(m, n) == n * EPS
    left, _ = torch.linalg.qr(random(n, m))
    sigma = torch.tensor([1.0, 0.5, 0.1, step * cutoff(n, m)], dtype=torch.float64)
    # Exactly diagonal, so that rounding does not blur where the cut is.
    U = torch.zeros(n, m, dtype=torch.float64)
    U[range(m), range(m)] = sigma
    g = unit(left[:, :1])
    R, P, V = evolvability(U, g)
    assert V.item() == rank / n
    assert P.item() == pytest.approx(float(g[:rank].square().sum()), abs=1e-14)
    assert R.item() == pytest.approx(float(sigma[3]) if rank == m else 0.0, rel=1e-12)


def test_zero_matrix() -> None:
    assert [float(value) for value in evolvability(torch.zeros(9, 3, dtype=torch.float64), unit(random(9, 1)))] == [
        0,
        0,
        0,
    ]


def test_a_weight_of_two_is_a_vertex_twice() -> None:
    U, g = random(30, 5), random(30, 2, seed=1)
    weights = torch.ones(30, dtype=torch.float64)
    weights[7] = 2.0
    twice = [*range(30), 7]
    g = g / g[twice].norm()
    weighted, doubled = evolvability(U, g, weights), evolvability(U[twice], g[twice])
    assert weighted[0].item() == pytest.approx(doubled[0].item(), rel=1e-13)
    assert weighted[1].item() == pytest.approx(doubled[1].item(), abs=1e-13)


@pytest.mark.parametrize("condition", [1e3, 1e10, 1e14, 1e17, np.inf])
def test_singular(condition: float) -> None:
    m = 5
    diagonal = np.ones(m)
    diagonal[2] = 1.0 / condition
    Psi = torch.from_numpy(np.diag(diagonal))
    inverse, _ = torch.linalg.inv_ex(Psi)
    assert bool(singular(Psi, inverse)) == (condition > 1.0 / (m * EPS))


def test_singular_psi_keeps_potential_and_variability() -> None:
    # r^2 log r is 0 at distances 0 and 1: Psi of two such centers is zero.
    built = DESIGNS["plane"](12, 14)
    centers = torch.tensor([[[0.25, 0.5], [0.25, 1.5]], [[0.3, 0.5], [0.25, 1.7]]], dtype=torch.float64)
    direct = score(RBFDeformation(built.vertices, ThinPlate(), "direct"), centers, built.gradient)
    indirect = score(RBFDeformation(built.vertices, ThinPlate(), "indirect"), centers, built.gradient)
    assert direct.regularity[0] == 0.0 < direct.regularity[1]
    assert torch.equal(direct.improvement_potential, indirect.improvement_potential)
    assert torch.equal(direct.variability, indirect.variability)
    assert not direct.failed.any()


@both
def test_non_finite_setups_fail_alone(manipulation: str) -> None:
    built = DESIGNS["plane"](12, 14)
    deformation = RBFDeformation(built.vertices, Wendland(0.5), manipulation)
    centers = built.centers(4, 5)
    good = score(deformation, centers[[0, 3]], built.gradient)
    centers[1, 2, 0], centers[2, 4, 1] = torch.nan, torch.inf
    found = score(deformation, centers, built.gradient)
    assert found.failed.tolist() == [False, True, True, False]
    for column, alone in zip(found[:3], good[:3], strict=True):
        assert column[1:3].tolist() == [0.0, 0.0]
        assert torch.equal(column[[0, 3]], alone)
