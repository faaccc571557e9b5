"""Kernels and slopes against SciPy, mpmath and autograd."""

import math

import mpmath
import numpy as np
import pytest
import torch
from designs import exact_phi
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

from rbfevo.errors import UserError
from rbfevo.scoring.distances import distances
from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland, triharmonic

ALL = [Wendland(0.25), Wendland(1.0), Wendland(3.7), ThinPlate(), Cubic()]
NAMES = ["wendland 0.25", "wendland 1", "wendland 3.7", "thin plate", "cubic"]
every_kernel = pytest.mark.parametrize("kernel", ALL, ids=NAMES)


def radii() -> torch.Tensor:
    """Distances over many magnitudes, dense about 1 and about the support radii, without 0."""
    about = torch.cat([s + 1e-3 * torch.linspace(-1.0, 1.0, 21, dtype=torch.float64) for s in (0.25, 1.0, 3.7)])
    return torch.cat([torch.logspace(-12, 3, 151, dtype=torch.float64), about]).sort().values


@pytest.mark.parametrize(("kernel", "scipy_name"), [(ThinPlate(), "thin_plate_spline"), (Cubic(), "cubic")])
@pytest.mark.parametrize("d", [2, 3])
def test_kernel_has_scipys_value_and_sign(kernel: Kernel, scipy_name: str, d: int) -> None:
    # One point of value 1, smoothed by 1, has the weight 1/(phi(0) + 1) = 1: SciPy then returns phi itself.
    x = np.random.default_rng(d).normal(size=(200, d)) * 3.0
    theirs = RBFInterpolator(np.zeros((1, d)), np.ones(1), smoothing=1.0, kernel=scipy_name, degree=-1)(x)
    ours = kernel(distances(torch.from_numpy(x), torch.zeros(1, d, dtype=torch.float64)))[:, 0].numpy()
    np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-15)


@every_kernel
def test_phi_against_many_digits(kernel: Kernel) -> None:
    r = radii()
    with mpmath.workdps(40):
        exact = [float(exact_phi(kernel, mpmath.mpf(value))) for value in r.tolist()]
    # The absolute term is the rounding of 1 - r/s and of log(r^2), both of order 1 about 0.
    np.testing.assert_allclose(kernel(r).numpy(), exact, rtol=4e-16 * 4, atol=4e-16)


@every_kernel
def test_slope_against_many_digits(kernel: Kernel) -> None:
    r = radii()
    with mpmath.workdps(60):
        points = [mpmath.mpf(value) for value in r.tolist()]
        exact = [float(mpmath.diff(lambda t: exact_phi(kernel, t), p, h=p * mpmath.mpf(10) ** -25) / p) for p in points]
    scale = 20.0 / kernel.support**2 if kernel.support else 1.0
    np.testing.assert_allclose(kernel.slope(r).numpy(), exact, rtol=2e-15, atol=1e-15 * scale)


@every_kernel
def test_slope_is_the_derivative_that_autograd_finds(kernel: Kernel) -> None:
    r = radii().requires_grad_()
    (derivative,) = torch.autograd.grad(kernel(r).sum(), r)
    r = r.detach()
    torch.testing.assert_close(kernel.slope(r) * r, derivative, rtol=1e-12, atol=2e-13)


@every_kernel
@pytest.mark.parametrize("d", [2, 3])
def test_slope_times_difference_is_the_gradient(kernel: Kernel, d: int) -> None:
    generator = torch.Generator().manual_seed(d)
    x = torch.randn(300, d, generator=generator, dtype=torch.float64)
    c = torch.zeros(300, d, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(kernel((c - x).square().sum(1).sqrt()).sum(), c)
    ours = kernel.slope(x.norm(dim=1))[:, None] * (c.detach() - x)
    torch.testing.assert_close(ours, gradient, rtol=1e-12, atol=1e-13)


@every_kernel
def test_at_zero(kernel: Kernel) -> None:
    zero = torch.zeros(3, dtype=torch.float64)
    assert torch.equal(kernel(zero), torch.full_like(zero, 1.0 if kernel.support else 0.0))
    assert torch.equal(kernel.slope(zero) * zero, zero)
    # The limit is continuous: close to 0 the gradient is close to 0.
    near = torch.full_like(zero, 1e-13)
    assert (kernel.slope(near) * near).abs().max() < 1e-9


@every_kernel
def test_nan_stays_nan_and_infinity_is_no_nan(kernel: Kernel) -> None:
    assert torch.isnan(kernel(torch.tensor([math.nan], dtype=torch.float64))).all()
    far = kernel(torch.tensor([math.inf, 1e200], dtype=torch.float64))
    assert (far == (0.0 if kernel.support else math.inf)).all()


@every_kernel
@given(r=st.floats(0.0, 1e100))
def test_finite_everywhere(kernel: Kernel, r: float) -> None:
    value = torch.tensor([r], dtype=torch.float64)
    assert torch.isfinite(kernel(value)).all()
    assert torch.isfinite(kernel.slope(value) * value).all()


@given(s=st.floats(1e-3, 1e3), q=st.floats(0.0, 2.0), p=st.floats(0.0, 2.0))
def test_wendland_falls_from_one_to_zero_at_its_support(s: float, q: float, p: float) -> None:
    low, high = min(p, q), max(p, q)
    near, far = Wendland(s)(torch.tensor([low * s, high * s], dtype=torch.float64)).tolist()
    assert 1.0 + 1e-15 >= near >= far - 1e-15
    assert far >= 0.0
    if high >= 1.0 + 1e-15:
        assert far == 0.0
        assert Wendland(s).slope(torch.tensor([high * s], dtype=torch.float64)).item() == 0.0


@given(m=st.integers(1, 20), d=st.sampled_from([2, 3]), s=st.floats(0.05, 5.0), seed=st.integers(0, 10**6))
def test_wendland_is_positive_definite(m: int, d: int, s: float, seed: int) -> None:
    points = torch.rand(m, d, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    eigenvalues = torch.linalg.eigvalsh(Wendland(s)(distances(points, points)))
    assert Wendland(s).positive_definite
    assert eigenvalues[0] > -1e-13 * eigenvalues[-1]


def test_triharmonic_is_indefinite() -> None:
    points = torch.rand(6, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for kernel, centers in ((triharmonic(3), points), (triharmonic(2), points[:, :2])):
        eigenvalues = torch.linalg.eigvalsh(kernel(distances(centers, centers)))
        assert not kernel.positive_definite
        assert eigenvalues[0] < 0.0 < eigenvalues[-1]


def test_triharmonic_by_dimension() -> None:
    assert isinstance(triharmonic(2), ThinPlate)
    assert isinstance(triharmonic(3), Cubic)
    for dimension in (1, 4):
        with pytest.raises(UserError, match=f"2 and 3 dimensions, not for {dimension}"):
            triharmonic(dimension)


@pytest.mark.parametrize("support", [0, 0.0, -1.0, math.nan, math.inf, None, "wide"])
def test_bad_support_radius(support: object) -> None:
    with pytest.raises(UserError, match=r"kernel\.support=.* must be a positive number") as caught:
        Wendland(support)  # pyright: ignore[reportArgumentType]
    assert "\n" not in str(caught.value)


def test_base_class_defines_nothing() -> None:
    with pytest.raises(TypeError, match="phi"):
        Kernel()  # pyright: ignore[reportAbstractUsage]


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_distances_of_batches(shape: tuple[int, ...], d: int) -> None:
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(7, d, generator=generator, dtype=torch.float64)
    b = torch.randn(*shape, 5, d, generator=generator, dtype=torch.float64)
    found = distances(a, b)
    assert found.shape == (*shape, 7, 5)
    for one, points in zip(found.reshape(-1, 7, 5), b.reshape(-1, 5, d), strict=True):
        np.testing.assert_allclose(one.numpy(), cdist(a.numpy(), points.numpy()), rtol=4e-16)


def test_small_distances_keep_their_digits_far_from_the_origin() -> None:
    a = torch.tensor([[1e6, 1e6, 1e6]], dtype=torch.float64)
    b = a + torch.tensor([[2.0**-20, 0.0, 0.0]], dtype=torch.float64)
    assert distances(a, b).item() == 2.0**-20
