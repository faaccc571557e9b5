"""Kernels and slopes against SciPy, mpmath and autograd."""

import math
from collections.abc import Callable

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
from rbfevo.scoring.kernels import (
    Cubic,
    Gaussian,
    InverseMultiquadric,
    Kernel,
    Multiquadric,
    ThinPlate,
    Wendland,
    WendlandC0,
    WendlandC4,
    gaussian,
    kernel_of,
    triharmonic,
    wendland_c0,
    wendland_c4,
)

SMOOTH = {
    "wendland 0.25": Wendland(0.25),
    "wendland 1": Wendland(1.0),
    "wendland 3.7": Wendland(3.7),
    "thin plate": ThinPlate(),
    "cubic": Cubic(),
    "wendland_c4 0.25": WendlandC4(0.25),
    "wendland_c4 3.7": WendlandC4(3.7),
    "gaussian": Gaussian(0.7),
    "multiquadric": Multiquadric(0.7),
    "inverse multiquadric": InverseMultiquadric(0.7),
}
ALL = {**SMOOTH, "wendland_c0 0.25": WendlandC0(0.25), "wendland_c0 3.7": WendlandC0(3.7)}
every_kernel = pytest.mark.parametrize("kernel", ALL.values(), ids=ALL)
every_smooth_kernel = pytest.mark.parametrize("kernel", SMOOTH.values(), ids=SMOOTH)  # with a gradient at r = 0


def radii() -> torch.Tensor:
    """Distances over many magnitudes, dense about 1 and about the support radii, without 0."""
    about = torch.cat([s + 1e-3 * torch.linspace(-1.0, 1.0, 21, dtype=torch.float64) for s in (0.25, 1.0, 3.7)])
    return torch.cat([torch.logspace(-12, 3, 151, dtype=torch.float64), about]).sort().values


@pytest.mark.parametrize(
    ("kernel", "scipy_name", "scale"),
    [
        (ThinPlate(), "thin_plate_spline", None),
        (Cubic(), "cubic", None),
        (Gaussian(1.3), "gaussian", 1.3),
        (Multiquadric(1.3), "multiquadric", 1.3),
        (InverseMultiquadric(1.3), "inverse_multiquadric", 1.3),
    ],
)
@pytest.mark.parametrize("d", [2, 3])
def test_kernel_has_scipys_value(kernel: Kernel, scipy_name: str, scale: float | None, d: int) -> None:
    """And its sign, but for the multiquadric, which is negative in SciPy."""
    # One point of value 1, smoothed by 1, has the weight 1/(phi(0) + 1): SciPy then returns phi times that.
    sign = -1.0 if scipy_name == "multiquadric" else 1.0
    at_zero, shape = (sign if scale else 0.0), {"epsilon": 1.0 / scale} if scale else {}
    smoothing = 3.0 - at_zero  # so that the weight is a third
    x = np.random.default_rng(d).normal(size=(200, d)) * 3.0
    theirs = RBFInterpolator(np.zeros((1, d)), np.ones(1), smoothing=smoothing, kernel=scipy_name, degree=-1, **shape)(
        x
    )
    theirs = 3.0 * sign * theirs
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
    scale = max(20.0 / kernel.support**2, 1.0) if kernel.support else 4.0
    if isinstance(kernel, WendlandC0):  # whose slope grows as 1/r
        np.testing.assert_allclose(kernel.slope(r).numpy(), exact, rtol=4e-15 / min(1.0, 1e-3), atol=1e-12)
        return
    np.testing.assert_allclose(kernel.slope(r).numpy(), exact, rtol=2e-15, atol=1e-15 * scale)


@every_kernel
def test_slope_is_the_derivative_that_autograd_finds(kernel: Kernel) -> None:
    r = radii().requires_grad_()
    (derivative,) = torch.autograd.grad(kernel(r).sum(), r)
    r = r.detach()
    torch.testing.assert_close(kernel.slope(r) * r, derivative, rtol=1e-12, atol=2e-13)


@every_smooth_kernel
@pytest.mark.parametrize("d", [2, 3])
def test_slope_times_difference_is_the_gradient(kernel: Kernel, d: int) -> None:
    generator = torch.Generator().manual_seed(d)
    x = torch.randn(300, d, generator=generator, dtype=torch.float64)
    c = torch.zeros(300, d, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(kernel((c - x).square().sum(1).sqrt()).sum(), c)
    ours = kernel.slope(x.norm(dim=1))[:, None] * (c.detach() - x)
    torch.testing.assert_close(ours, gradient, rtol=1e-12, atol=1e-13)


@every_smooth_kernel
def test_at_zero(kernel: Kernel) -> None:
    zero = torch.zeros(3, dtype=torch.float64)
    assert torch.equal(kernel(zero), torch.full_like(zero, 0.0 if isinstance(kernel, ThinPlate | Cubic) else 1.0))
    assert torch.equal(kernel.slope(zero) * zero, zero)
    # The limit is continuous: close to 0 the gradient is close to 0.
    near = torch.full_like(zero, 1e-13)
    assert (kernel.slope(near) * near).abs().max() < 1e-9


@every_kernel
def test_nan_stays_nan_and_infinity_is_no_nan(kernel: Kernel) -> None:
    assert torch.isnan(kernel(torch.tensor([math.nan], dtype=torch.float64))).all()
    far = kernel(torch.tensor([math.inf, 1e200], dtype=torch.float64))
    assert (far == (math.inf if isinstance(kernel, ThinPlate | Cubic | Multiquadric) else 0.0)).all()


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


@pytest.mark.parametrize("kind", [Wendland, WendlandC0, WendlandC4, Gaussian, InverseMultiquadric])
@given(m=st.integers(1, 20), d=st.sampled_from([2, 3]), s=st.floats(0.05, 5.0), seed=st.integers(0, 10**6))
def test_positive_definite_ones_are(kind: type[Kernel], m: int, d: int, s: float, seed: int) -> None:
    points = torch.rand(m, d, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    kernel: Kernel = kind(s)  # pyright: ignore[reportCallIssue]
    eigenvalues = torch.linalg.eigvalsh(kernel(distances(points, points)))
    assert kernel.positive_definite
    assert eigenvalues[0] > -1e-13 * eigenvalues[-1]


def test_the_multiquadric_has_one_positive_eigenvalue_and_is_never_singular() -> None:
    generator, kernel = torch.Generator().manual_seed(3), Multiquadric(0.4)
    assert not kernel.positive_definite
    for m in (2, 5, 12):
        points = torch.rand(m, 3, generator=generator, dtype=torch.float64)
        eigenvalues = torch.linalg.eigvalsh(kernel(distances(points, points)))
        assert float(eigenvalues[-1]) > 0
        assert float(eigenvalues[-2]) < -1e-6


def test_the_cusp_has_no_slope_at_its_tip() -> None:
    r = torch.tensor([0.0, 1e-3], dtype=torch.float64)
    kernel = WendlandC0(0.5)
    assert kernel(r).tolist() == [1.0, pytest.approx(0.998**2, rel=1e-14)]
    assert kernel.slope(r).tolist() == [0.0, pytest.approx(-4.0 * 0.998 / 1e-3, rel=1e-13)]
    assert wendland_c0(3, 0.5).phi(np.zeros(2)).tolist() == [1.0, 1.0]  # NumPy, and no warning


@pytest.mark.parametrize("make", [wendland_c0, wendland_c4])
def test_wendlands_functions_take_a_radius_and_three_dimensions_at_most(make: Callable[..., Kernel]) -> None:
    assert make(3, 0.7).support == 0.7
    assert make(2, 0.7, 5.0, "30%").support == pytest.approx(1.5)
    with pytest.raises(UserError, match="up to 3 dimensions, not for 4"):
        make(4, 0.7)


def test_a_scale_is_half_the_default_support_unless_given() -> None:
    assert gaussian(3, 0.7).numbers() == {"scale": 0.35}
    assert gaussian(3, 0.7, 5.0, "10%").numbers() == {"scale": 0.5}
    assert kernel_of(gaussian(3, 0.7).spec()).numbers() == {"scale": 0.35}
    for wrong in (0.0, -1.0, "wide", math.nan, True):
        with pytest.raises(UserError, match=r"kernel\.scale=.*give a positive number"):
            gaussian(3, 0.7, 5.0, wrong)
    for wrong in (0, math.inf, None):
        with pytest.raises(UserError, match=r"kernel\.scale=.* must be a positive number"):
            Gaussian(wrong)  # pyright: ignore[reportArgumentType]


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
