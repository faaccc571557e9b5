"""The blocked Gram matrices, and the numba kernels under them."""

import math
import sys

import mpmath
import numpy as np
import pytest
import torch
from designs import DESIGNS, EPS, KERNELS, PAIRS
from scipy.linalg import solve_triangular

from rbfevo.errors import UserError
from rbfevo.geometry.blocks import vertex_blocks
from rbfevo.scoring import fused, gram
from rbfevo.scoring.distances import distances
from rbfevo.scoring.gram import GramAccumulator
from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland
from rbfevo.scoring.threads import run_in_slices

backends = pytest.mark.parametrize("backend", ["fused", "eager"])
pairs = pytest.mark.parametrize(("design", "kernel"), PAIRS)
CODES = [(fused.WENDLAND, Wendland(0.5)), (fused.THIN_PLATE, ThinPlate()), (fused.CUBIC, Cubic())]


def accumulator(built, kernel: Kernel, backend: str, block: int | None = None) -> GramAccumulator:
    return GramAccumulator(built.vertices, built.gradient, built.weights, kernel, backend, block)


def stored(built, kernel: Kernel, centers: torch.Tensor, factor: torch.Tensor | None = None) -> np.ndarray:
    """M [m+k, m+k] of one setup from a stored Phi, in long double."""
    roots = built.weights.sqrt()[:, None]
    Q = (roots * kernel(distances(built.vertices, centers))).numpy()
    if factor is not None:
        Q = solve_triangular(factor.numpy(), Q.T, lower=True).T
    A = np.concatenate([Q, (roots * built.gradient).numpy()], axis=1).astype(np.longdouble)
    return (A.T @ A).astype(np.float64)


# ------------------------------------------------------------------ the logarithm


def log_arguments() -> np.ndarray:
    rng = np.random.default_rng(0)
    tiny, huge = sys.float_info.min, sys.float_info.max
    steps = np.arange(1, 40)
    return np.concatenate(
        [
            np.exp(rng.uniform(math.log(tiny), math.log(huge), 2000)),
            np.array([tiny, np.nextafter(tiny, 1.0), 1e-300, 1.0, huge, 0.5, 2.0]),
            2.0 ** np.arange(-1022, 1024, 11),
            1.0 + steps * EPS,
            1.0 - steps * EPS / 2,
            1.0 + rng.uniform(-1.0, 1.0, 1000) * 10.0 ** rng.uniform(-15, -0.5, 1000),
            # about sqrt(1/2) and sqrt(2), where the exponent changes hands
            math.sqrt(0.5) * (1.0 + np.arange(-30, 31) * EPS),
            math.sqrt(2.0) * (1.0 + np.arange(-30, 31) * EPS),
        ]
    )


def test_log_to_two_units_in_the_last_place() -> None:
    x = log_arguments()
    ours = np.array([fused._log(value) for value in x])
    with mpmath.workdps(40):
        exact = [mpmath.log(mpmath.mpf(float(value))) for value in x]
        errors = [
            abs(float(mpmath.mpf(float(y)) - e)) / math.ulp(float(e)) if e else abs(y)
            for y, e in zip(ours, exact, strict=True)
        ]
    assert max(errors) < 1.0
    assert fused._log(1.0) == 0.0
    assert np.abs((ours - np.log(x)) / np.spacing(np.abs(np.log(x)) + (x == 1.0))).max() <= 2.0


@pytest.mark.parametrize(("code", "kernel"), CODES)
def test_rows_are_the_kernels(code: int, kernel: Kernel) -> None:
    r = torch.cat([torch.zeros(3), torch.logspace(-14, 2, 400), torch.linspace(0.4, 1.1, 333)]).double()
    W = 0.5 + torch.rand(len(r), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    row, same, slopes = np.full((3, len(r)), np.nan)
    along = np.stack([r.numpy(), np.zeros(len(r))])
    given = np.zeros(2), along, 0, len(r), code, kernel.support or 0.0, W.numpy()
    fused._fill_row(*given, row)
    fused._fill_both(*given, same, slopes)
    np.testing.assert_allclose(row, (kernel(r) * W).numpy(), rtol=2e-15, atol=1e-15)
    np.testing.assert_allclose(same, row, rtol=4e-16, atol=1e-30)
    np.testing.assert_allclose(slopes, (kernel.slope(r) * W).numpy(), rtol=2e-15, atol=1e-14)
    assert (slopes[:3] * 0.0 == 0.0).all()


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize(("code", "kernel"), CODES)
def test_filled_rows_are_the_kernels_of_the_distances(code: int, kernel: Kernel, d: int) -> None:
    generator = torch.Generator().manual_seed(0)
    X, W = (torch.rand(n, 100, generator=generator, dtype=torch.float64) for n in (d, 1))
    center = X[:, 7].clone()  # the distance to one vertex is 0
    row = np.full(53, np.nan)
    fused._fill_row(center.numpy(), X.numpy(), 3, 56, code, kernel.support or 0.0, W[0, 3:56].numpy(), row)
    wanted = kernel(distances(center[None], X.T[3:56]))[0] * W[0, 3:56]
    np.testing.assert_allclose(row, wanted.numpy(), rtol=4e-15, atol=1e-15)


# ------------------------------------------------------------------ Gram matrices


@pairs
@backends
@pytest.mark.parametrize("m", [1, 2, 7, 25])
@pytest.mark.parametrize(("k", "weighted"), [(1, False), (3, True)])
@pytest.mark.parametrize("threads", [1, 2])
def test_gram_is_that_of_a_stored_phi(
    design: str, kernel: str, backend: str, m: int, k: int, weighted: bool, threads: int
) -> None:
    built, phi = DESIGNS[design](k=k, weighted=weighted), KERNELS[design][kernel]
    centers = built.centers(5, m)
    torch.set_num_threads(threads)
    M = accumulator(built, phi, backend)(centers)
    assert M.shape == (5, m + k, m + k)
    assert torch.equal(M, M.mT) or backend == "eager"
    for found, setup in zip(M.numpy(), centers, strict=True):
        wanted = stored(built, phi, setup)
        assert np.linalg.norm(found - wanted) <= 1e-14 * np.linalg.norm(wanted)


@pairs
@backends
def test_block_size_and_threads_change_nothing(design: str, kernel: str, backend: str) -> None:
    built, phi = DESIGNS[design](k=3, weighted=True), KERNELS[design][kernel]
    centers = built.centers(9, 25)
    reference = accumulator(built, phi, backend)(centers)
    for block in (None, 100, 1000, 10**6):
        for threads in (1, 2):
            torch.set_num_threads(threads)
            M = accumulator(built, phi, backend, block)(centers)
            assert ((M - reference).flatten(1).norm(dim=1) <= 1e-13 * reference.flatten(1).norm(dim=1)).all()


@backends
@pytest.mark.parametrize("block", [1, 2, 3, 5])
def test_blocks_of_a_few_vertices(backend: str, block: int) -> None:
    built = DESIGNS["plane"](9, 11)
    M = accumulator(built, Wendland(0.25), backend, block)(built.centers(3, 6))
    for found, setup in zip(M.numpy(), built.centers(3, 6), strict=True):
        np.testing.assert_allclose(found, stored(built, Wendland(0.25), setup), rtol=0.0, atol=1e-14)


@pairs
@backends
@pytest.mark.parametrize("m", [1, 3, 6, 25])
def test_gram_with_a_factor(design: str, kernel: str, backend: str, m: int) -> None:
    built, phi = DESIGNS[design](k=2, weighted=True), KERNELS[design][kernel]
    centers = built.centers(3, m)
    generator = torch.Generator().manual_seed(0)
    T = torch.randn(3, m, m, generator=generator, dtype=torch.float64).tril(-1) / m
    T = T + torch.diag_embed(0.5 + torch.rand(3, m, generator=generator, dtype=torch.float64))
    M = accumulator(built, phi, backend)(centers, T)
    for found, setup, factor in zip(M.numpy(), centers, T, strict=True):
        wanted = stored(built, phi, setup, factor)
        assert np.linalg.norm(found - wanted) <= 1e-13 * np.linalg.norm(wanted)


@backends
def test_no_setups(backend: str) -> None:
    built = DESIGNS["sphere"](2)
    M = accumulator(built, Wendland(1.0), backend)(torch.empty(0, 4, 3, dtype=torch.float64))
    assert M.shape == (0, 7, 7)


@backends
def test_centers_that_reach_nothing(backend: str) -> None:
    built = DESIGNS["plane"]()
    centers = built.centers(2, 5)
    centers[1] += 100.0
    centers[0, 3] = 1e200
    M = accumulator(built, Wendland(0.25), backend)(centers)
    assert torch.equal(M[1, :5], torch.zeros(5, 6, dtype=torch.float64))
    assert M[1, 5, 5].item() == pytest.approx(1.0, abs=1e-14)
    assert (M[0, 3] == 0).all()
    assert (M[0, [0, 1, 2, 4], [0, 1, 2, 4]] > 0).all()


@pairs
@pytest.mark.parametrize(("sign", "m"), [(0.0, 6), (0.0, 15), (1.0, 6), (-1.0, 11)])
def test_backward_is_autograds(design: str, kernel: str, sign: float, m: int) -> None:
    """With sign 0 without mirror images; their plane is y = 0.3. Nothing flows through the last setup."""
    built, phi = DESIGNS[design](k=2, weighted=True), KERNELS[design][kernel]
    k, p = 2, 4
    centers = built.centers(p, m)
    centers[1, 2] = built.vertices[5]
    generator = torch.Generator().manual_seed(1)
    dG = torch.randn(p, m, m, generator=generator, dtype=torch.float64)
    db = torch.randn(p, m, k, generator=generator, dtype=torch.float64)
    dG[2], dG[3], db[3] = 0.0, 0.0, 0.0
    blocks = accumulator(built, phi, "fused").blocks
    X, W, g, starts, low, high = (
        array.numpy() for array in (blocks.X, blocks.W, blocks.g, blocks.starts, blocks.low, blocks.high)
    )
    code = {"wendland": fused.WENDLAND}.get(phi.name, fused.THIN_PLATE if design == "plane" else fused.CUBIC)
    dC = torch.full_like(centers, torch.nan)
    given = (dG + dG.mT).numpy(), db.numpy(), dC.numpy()

    def mirrored(C: torch.Tensor) -> torch.Tensor:
        return torch.cat((C[..., :1], 0.6 - C[..., 1:2], C[..., 2:]), dim=-1)

    images = (mirrored(centers).numpy(), sign, 1)
    fused.gram_backward(centers.numpy(), *images, X, W, g, starts, low, high, code, phi.support or 0.0, *given)

    def columns(C: torch.Tensor) -> torch.Tensor:
        squared = (C[:, None] - built.vertices[:, None]).square().sum(-1)
        # Where a vertex sits on a center autograd of the square root has no value; there the product's limit is 0.
        return phi(torch.where(squared > 0, squared, 1.0).sqrt() * (squared > 0))

    C = centers.clone().requires_grad_()
    Phi = built.weights.sqrt()[:, None] * (columns(C) + sign * columns(mirrored(C)))
    weighted = built.weights.sqrt()[:, None] * built.gradient
    ((Phi.mT @ Phi * dG).sum() + (Phi.mT @ weighted * db).sum()).backward()
    assert C.grad is not None
    assert torch.isfinite(dC).all()
    assert (dC[:3] != 0).any(dim=2).any(dim=1).all()
    assert (dC[3] == 0).all()
    torch.testing.assert_close(dC, C.grad, rtol=1e-10, atol=1e-11 * float(C.grad.abs().max()))


# ------------------------------------------------------------------ blocks


@pairs
@pytest.mark.parametrize("size", [1, 7, 100, 2500, 10**6])
def test_blocks_cut_the_vertices_once_each(design: str, kernel: str, size: int) -> None:
    built = DESIGNS[design](k=2, weighted=True)
    blocks = vertex_blocks(built.vertices, built.gradient, built.weights, size)
    lengths = blocks.starts.diff()
    n = len(built.vertices)
    assert len(blocks) == len(lengths) == -(-n // size)
    assert blocks.starts[0] == 0
    assert blocks.starts[-1] == n
    assert lengths.max() <= size
    assert (lengths < size).sum() <= 1
    # Every vertex with its own weight and gradient, once.
    rows = torch.cat([blocks.X, blocks.W[None].square(), blocks.g / blocks.W]).T.numpy()
    whole = torch.cat([built.vertices, built.weights[:, None], built.gradient], dim=1).numpy()
    d = whole.shape[1] - 3
    order, wanted = np.lexsort(rows[:, :d].T), np.lexsort(whole[:, :d].T)
    np.testing.assert_allclose(rows[order], whole[wanted], rtol=1e-14)
    for i in range(0, len(blocks), max(1, len(blocks) // 20)):
        part = blocks.X[:, blocks.starts[i] : blocks.starts[i + 1]]
        assert torch.equal(blocks.low[i], part.amin(1))
        assert torch.equal(blocks.high[i], part.amax(1))


# ------------------------------------------------------------------ choosing a backend


def test_backends_and_their_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    built, phi = DESIGNS["plane"](9, 9), Wendland(0.5)
    assert accumulator(built, phi, "auto").backend == "fused"
    assert accumulator(built, phi, "eager").backend == "eager"
    with pytest.raises(UserError, match="choose one of auto, fused, eager"):
        accumulator(built, phi, "fast")

    class Linear(Kernel):
        def phi(self, r: torch.Tensor) -> torch.Tensor:
            return r

        def slope(self, r: torch.Tensor) -> torch.Tensor:
            return 1.0 / r

    assert accumulator(built, Linear(), "auto").backend == "eager"
    with pytest.raises(UserError, match="evaluator=fused needs"):
        accumulator(built, Linear(), "fused")
    monkeypatch.setattr(gram, "_fused", lambda: None)
    assert accumulator(built, phi, "auto").backend == "eager"
    with pytest.raises(UserError, match="evaluator=fused needs numba"):
        accumulator(built, phi, "fused")


def test_a_worker_threads_error_is_not_lost() -> None:
    def work(begin: int, end: int) -> None:
        if begin > 0:
            raise RuntimeError("lost")

    torch.set_num_threads(2)
    with pytest.raises(RuntimeError, match="lost"):
        run_in_slices(work, 100)
