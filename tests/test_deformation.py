"""The deformation matrix U: shapes, interpolation, SciPy."""

import numpy as np
import pytest
import torch
from designs import DESIGNS, KERNELS, PAIRS, numpy_phi
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

from rbfevo.errors import UserError
from rbfevo.scoring.deformation import MANIPULATIONS, RBFDeformation

pairs = pytest.mark.parametrize(("design", "kernel"), PAIRS)
both = pytest.mark.parametrize("manipulation", MANIPULATIONS)
SMALL = {"plane": DESIGNS["plane"](12, 14), "sphere": DESIGNS["sphere"](2)}


@pairs
@both
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_a_batch_is_a_loop(design: str, kernel: str, manipulation: str, shape: tuple[int, ...]) -> None:
    built = SMALL[design]
    deformation = RBFDeformation(built.vertices, KERNELS[design][kernel], manipulation)
    centers = built.centers(*shape, 6)
    U = deformation(centers)
    n = len(built.vertices)
    assert U.shape == (*shape, n, 6)
    for one, setup in zip(U.reshape(-1, n, 6), centers.reshape(-1, *centers.shape[-2:]), strict=True):
        torch.testing.assert_close(one, deformation(setup), rtol=1e-12, atol=1e-13)


@pairs
def test_indirect_is_phi_and_direct_solves_psi(design: str, kernel: str) -> None:
    built, phi = SMALL[design], KERNELS[design][kernel]
    centers = built.centers(6)
    Phi = numpy_phi(phi, cdist(built.vertices.numpy(), centers.numpy()))
    Psi = numpy_phi(phi, cdist(centers.numpy(), centers.numpy()))
    np.testing.assert_allclose(RBFDeformation(built.vertices, phi)(centers).numpy(), Phi, rtol=1e-13, atol=2e-15)
    direct = RBFDeformation(built.vertices, phi, "direct")
    np.testing.assert_allclose(direct.psi(centers).numpy(), Psi, rtol=1e-13, atol=2e-15)
    assert torch.equal(direct.psi(centers), direct.psi(centers).mT)
    np.testing.assert_allclose(direct(centers).numpy() @ Psi, Phi, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("design", "scipy_name"), [("plane", "thin_plate_spline"), ("sphere", "cubic")])
def test_direct_is_scipys_interpolation(design: str, scipy_name: str) -> None:
    built = SMALL[design]
    centers = built.centers(8)
    theirs = RBFInterpolator(centers.numpy(), np.eye(8), kernel=scipy_name, degree=-1)(built.vertices.numpy())
    ours = RBFDeformation(built.vertices, KERNELS[design]["triharmonic"], "direct")(centers)
    np.testing.assert_allclose(ours.numpy(), theirs, rtol=1e-9, atol=1e-10)


@pairs
def test_direct_moves_a_vertex_at_a_center_with_it(design: str, kernel: str) -> None:
    built = SMALL[design]
    centers = built.centers(6)
    X = torch.cat([built.vertices, centers])
    U = RBFDeformation(X, KERNELS[design][kernel], "direct")(centers)
    torch.testing.assert_close(U[-6:], torch.eye(6, dtype=torch.float64), rtol=0.0, atol=1e-10)
    D = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)[: X.shape[1]]
    P = torch.zeros_like(centers)
    P[2] = D
    moved = X + U @ P
    torch.testing.assert_close(moved[-4], X[-4] + D, rtol=0.0, atol=1e-10)
    torch.testing.assert_close(moved[-6:-4], X[-6:-4], rtol=0.0, atol=1e-10)


def test_one_singular_psi_leaves_the_rest_of_the_batch_alone() -> None:
    built = SMALL["sphere"]
    centers = built.centers(3, 5)
    deformation = RBFDeformation(built.vertices, KERNELS["sphere"]["wendland 1"], "direct")
    alone = deformation(centers[[0, 2]])
    centers[1, 3] = centers[1, 1]
    together = deformation(centers)
    assert torch.equal(together[[0, 2]], alone)
    assert not torch.isfinite(together[1]).all() or together[1].abs().max() > 1e6


def test_u_is_differentiable_in_the_centers() -> None:
    built = SMALL["plane"]
    deformation = RBFDeformation(built.vertices[:20], KERNELS["plane"]["wendland 0.5"], "direct")
    # Off the diagonal of Psi alone: autograd has no derivative of a square root at 0, so pairs of distinct points.
    centers = built.centers(3).requires_grad_()
    assert torch.autograd.gradcheck(deformation.phi, (centers,))


def test_unknown_manipulation() -> None:
    built = SMALL["plane"]
    with pytest.raises(UserError, match="choose one of indirect, direct"):
        RBFDeformation(built.vertices, KERNELS["plane"]["triharmonic"], "sideways")
