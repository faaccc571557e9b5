"""Batches of small matrices: every element as if it were alone, to the bit, and right against NumPy and SciPy.

Equality to the bit rests on three things: every matrix starts a cache line, each operation has one thread, and BLAS and
LAPACK then do the same for the same numbers. `scripts/portability` runs this on simulated processors.
"""

from __future__ import annotations

import ctypes
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import torch
from designs import DESIGNS
from torch import Tensor

from rbfevo.methods.cmaes.algorithm import CMAES
from rbfevo.scoring import matrices
from rbfevo.scoring.deformation import MANIPULATIONS, RBFDeformation
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.evolvability import evolvability
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland
from rbfevo.scoring.threads import coarse

SIZES = range(1, 27)
COUNT = 9  # as many as there are places of a float64 in a cache line, and one more


def square(m: int, seed: int = 0) -> Tensor:
    """A matrix [m, m] of moderate condition."""
    generator = torch.Generator().manual_seed(100 * m + seed)
    return torch.randn(m, m, generator=generator, dtype=torch.float64) + m**0.5 * torch.eye(m, dtype=torch.float64)


def right(m: int, k: int) -> Tensor:
    return torch.randn(m, k, generator=torch.Generator().manual_seed(k), dtype=torch.float64)


def definite(m: int) -> Tensor:
    return square(m) @ square(m).T


def factor(m: int) -> Tensor:
    return torch.linalg.cholesky(definite(m))


OPERATIONS: dict[str, Callable[[Tensor, int], tuple[Tensor, ...]]] = {
    # of a batch [p, ., .] of square(m), what each function gives
    "product": lambda A, m: (
        matrices.product(A, A.mT),
        matrices.product(A, right(m, 3)),
        matrices.product(right(2, m), A),
    ),
    "gram": lambda A, m: (matrices.gram(A), matrices.gram(A[:, :, : m // 2 + 1])),
    "cholesky": lambda A, m: matrices.cholesky(matrices.gram(A)),
    "solve lower": lambda A, m: tuple(
        matrices.solve_lower(matrices.cholesky(matrices.gram(A))[0], A[:, :, : m // 2 + 1], transposed)
        for transposed in (False, True)
    ),
    "solve": lambda A, m: (matrices.solve(A, A.mT), matrices.solve(A, A[:, :, :1])),
    "inverse": lambda A, m: matrices.inverse_definite(matrices.gram(A)),
    "singular values": lambda A, m: (matrices.singular_values(A),),
    "left singular": lambda A, m: matrices.left_singular(A),
    "left spectrum": lambda A, m: matrices.left_spectrum(A),
    "eigh": lambda A, m: matrices.eigh(matrices.gram(A)),
}


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("m", SIZES)
@pytest.mark.parametrize("name", OPERATIONS)
def test_identical_matrices_have_identical_results(name: str, m: int, threads: int) -> None:
    torch.set_num_threads(threads)
    alone = OPERATIONS[name](square(m)[None].clone(), m)
    together = OPERATIONS[name](square(m).repeat(COUNT, 1, 1), m)
    among = OPERATIONS[name](torch.cat([square(m, 1)[None], square(m)[None], square(m, 2)[None]]), m)
    for one, many, some in zip(alone, together, among, strict=True):
        assert torch.equal(many, one.expand(COUNT, *one.shape[1:]))
        assert torch.equal(some[1], one[0])


@pytest.mark.parametrize("m", [1, 2, 3, 4, 5, 25, 26])
def test_each_is_numpys(m: int) -> None:
    A = torch.stack([square(m), square(m, 1)])
    B = torch.stack([right(m, 3), right(m, 3) + 1.0])
    close = lambda found, wanted: np.testing.assert_allclose(found.numpy(), wanted, rtol=1e-11, atol=1e-11)  # noqa: E731
    close(matrices.product(A, B), A.numpy() @ B.numpy())
    close(matrices.product(A[0], B), A[0].numpy() @ B.numpy())
    close(matrices.product(A, B[1]), A.numpy() @ B[1].numpy())
    close(matrices.gram(B), B.numpy() @ B.mT.numpy())
    close(matrices.solve(A, B), np.linalg.solve(A.numpy(), B.numpy()))
    L, sound = matrices.cholesky(A @ A.mT)
    close(L, np.linalg.cholesky((A @ A.mT).numpy()))
    assert sound.all()
    for i in range(2):
        lower, rhs = L[i].numpy(), B[i].numpy()
        close(matrices.solve_lower(L, B)[i], scipy.linalg.solve_triangular(lower, rhs, lower=True))
        close(matrices.solve_lower(L, B, transposed=True)[i], scipy.linalg.solve_triangular(lower.T, rhs, lower=False))
    sigma = np.linalg.svd(A.numpy(), compute_uv=False)
    close(matrices.singular_values(A), sigma)
    left, values = matrices.left_singular(A)
    close(values, sigma)
    close(left.mT @ left, np.broadcast_to(np.eye(m), (2, m, m)))
    close((left.mT @ A).square().sum(2).sqrt(), sigma)  # u_i^T A = sigma_i v_i^T
    values, vectors = matrices.eigh(A + A.mT)
    close(values, np.linalg.eigvalsh((A + A.mT).numpy()))
    close((vectors * values[:, None]) @ vectors.mT, (A + A.mT).numpy())


@pytest.mark.parametrize("regularity", [0.3, 2e-4, 5e-5, 1e-9])
def test_the_spectrum_of_a_matrix_loses_little_by_squares(regularity: float) -> None:
    m = 9
    left, right = (torch.linalg.qr(square(m) + i).Q for i in range(2))
    sigma = torch.logspace(0.0, math.log10(regularity), m, dtype=torch.float64)
    A = torch.stack([(left * sigma) @ right.mT, square(m)])
    vectors, found = matrices.left_spectrum(A)
    bound = 1e-15 / min(regularity, 1.0) ** 2 if regularity >= matrices.SQUARED else 1e-15 / regularity
    np.testing.assert_allclose(found[0].numpy(), sigma.numpy(), rtol=10 * bound)
    np.testing.assert_allclose(found[1].numpy(), np.linalg.svd(square(m).numpy(), compute_uv=False), rtol=1e-12)
    expected = torch.einsum("pij,pik->pjk", vectors, A).norm(dim=2)
    np.testing.assert_allclose(expected.numpy(), found.numpy(), rtol=10 * bound + 1e-12)
    np.testing.assert_allclose((vectors[0].abs() - left.abs()).abs().max(), 0.0, atol=1e-8)


def test_one_value_that_is_not_finite_is_found() -> None:
    largest = torch.finfo(torch.float64).max
    A = torch.ones(5, 3, 4, dtype=torch.float64)
    A[1, 2, 1], A[2, 0, 0], A[3, 1, 1] = torch.nan, torch.inf, -torch.inf
    A[3, 1, 2] = torch.inf  # which the sum does not show as infinite
    A[4] = largest  # whose sum overflows
    assert matrices.all_finite(A).tolist() == [True, False, False, False, True]
    assert matrices.all_finite(A[:1]).tolist() == [True]
    assert matrices.all_finite(A[:0]).shape == (0,)


@pytest.mark.parametrize("scale", [1e-140, 1.0, 1e140])
def test_what_is_filled_up_never_shows(scale: float) -> None:
    # Negative definite, zero and indefinite: the eigenvalues that are filled up must stay the last ones.
    A = torch.stack([-definite(5), torch.zeros(5, 5, dtype=torch.float64), definite(5) - 9.0 * torch.eye(5)]) * scale
    values, vectors = matrices.eigh(A)
    np.testing.assert_allclose(values.numpy() / scale, np.linalg.eigvalsh(A.numpy() / scale), rtol=1e-11, atol=1e-11)
    assert vectors.shape == (3, 5, 5)
    np.testing.assert_allclose((vectors.mT @ vectors).numpy(), np.broadcast_to(np.eye(5), (3, 5, 5)), atol=1e-12)
    np.testing.assert_allclose(
        matrices.singular_values(A).numpy() / scale, np.linalg.svd(A.numpy() / scale, compute_uv=False), atol=1e-11
    )


def test_matrices_without_a_factor_or_an_inverse_leave_the_others_alone() -> None:
    G = torch.stack([definite(5), -definite(5), definite(5)])
    L, sound = matrices.cholesky(G)
    assert sound.tolist() == [True, False, True]
    assert torch.equal(L[1], torch.eye(5, dtype=torch.float64))
    assert torch.equal(L[0], L[2])
    assert torch.equal(L[:1], matrices.cholesky(G[:1])[0])
    A = torch.stack([square(5), torch.zeros(5, 5, dtype=torch.float64)])
    inverse, sound = matrices.inverse_definite(G)
    assert sound.tolist() == [True, False, True]
    np.testing.assert_allclose(inverse[0].numpy(), np.linalg.inv(G[0].numpy()), rtol=1e-9, atol=1e-12)
    solution = matrices.solve(A, A)
    torch.testing.assert_close(solution[0], torch.eye(5, dtype=torch.float64))
    assert not solution[1].isfinite().all()


def test_a_matrix_on_which_lapack_fails_leaves_the_others_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, broken = torch.linalg.eigh, definite(5)
    broken[0, 0] = 77.0

    def failing(C: Tensor) -> tuple[Tensor, Tensor]:
        if (C[:, 0, 0] == 77.0).any():
            raise torch.linalg.LinAlgError("no convergence")  # pyright: ignore[reportPrivateImportUsage]
        return plain(C)

    monkeypatch.setattr(torch.linalg, "eigh", failing)
    values, vectors = matrices.eigh(torch.stack([definite(5), broken, 2.0 * definite(5)]))
    assert torch.equal(values[1], torch.zeros(5, dtype=torch.float64))
    assert torch.equal(vectors[1], torch.eye(5, dtype=torch.float64))
    torch.testing.assert_close(values[[0, 2]], plain(torch.stack([definite(5), 2.0 * definite(5)]))[0])


@pytest.mark.parametrize("m", [1, 5, 8])
def test_empty_batches(m: int) -> None:
    A = torch.zeros(0, m, m, dtype=torch.float64)
    for name, operation in OPERATIONS.items():
        if name not in ("singular values", "left singular", "left spectrum", "eigh"):
            assert all(len(part) == 0 for part in operation(A, m))
    assert matrices.singular_values(A).shape == (0, m)
    assert [part.shape for part in matrices.left_singular(A)] == [(0, m, m), (0, m)]
    assert [part.shape for part in matrices.left_spectrum(A)] == [(0, m, m), (0, m)]
    assert [part.shape for part in matrices.eigh(A)] == [(0, m), (0, m, m)]


# ------------------------------------------------------------------ what is made of them

KERNELS: dict[str, Kernel] = {"wendland": Wendland(0.5), "thin plate": ThinPlate()}


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("manipulation", MANIPULATIONS)
@pytest.mark.parametrize("backend", ["fused", "eager"])
@pytest.mark.parametrize("m", SIZES)
def test_identical_setups_have_identical_scores_and_gradients(
    m: int, backend: str, manipulation: str, kernel: str
) -> None:
    some = DESIGNS["plane"](13, 11, k=3, weighted=True)
    evaluate = Evaluator(some.vertices, some.gradient, KERNELS[kernel], manipulation, some.weights, backend, block=100)
    setup = some.centers(1, m, seed=m)
    alone, together = evaluate(setup), evaluate(setup.repeat(COUNT, 1, 1))
    for one, many in zip(alone, together, strict=True):
        assert torch.equal(many, one.expand(COUNT))
    slope, share = torch.linspace(1.0, -1.0, m, dtype=torch.float64)[None], torch.ones(1, dtype=torch.float64)
    one, many = Spectrum(evaluate, setup), Spectrum(evaluate, setup.repeat(COUNT, 1, 1))
    assert torch.equal(many.sigma, one.sigma.expand(COUNT, -1))
    gradient = one.backward(slope, share)
    assert torch.equal(many.backward(slope.expand(COUNT, -1), share.expand(COUNT)), gradient.expand(COUNT, -1, -1))
    assert gradient.abs().max() > 0


@pytest.mark.parametrize("backend", ["fused", "eager"])
@pytest.mark.parametrize("manipulation", MANIPULATIONS)
def test_identical_ill_conditioned_setups_have_identical_scores(manipulation: str, backend: str) -> None:
    some = DESIGNS["sphere"](2, k=3, weighted=True)
    evaluate = Evaluator(some.vertices, some.gradient, Cubic(), manipulation, some.weights, backend, block=50)
    for distance in (1e-4, 1e-6, 1e-9, 0.0):  # second passes, further ones, QR
        setup = some.centers(1, 9, seed=1)
        setup[0, 4] = setup[0, 3] + distance
        alone, together = evaluate(setup), evaluate(setup.repeat(COUNT, 1, 1))
        for one, many in zip(alone, together, strict=True):
            assert torch.equal(many, one.expand(COUNT))
    assert evaluate.further_passes > evaluate.factorizations > 0


@pytest.mark.parametrize("m", [1, 3, 25])
def test_identical_setups_have_identical_matrices_and_scores_by_definition(m: int) -> None:
    some = DESIGNS["plane"](13, 11, k=3)
    setup = some.centers(1, m, seed=m)
    for manipulation in MANIPULATIONS:
        deformation = RBFDeformation(some.vertices, Wendland(0.7), manipulation)
        U, alone = deformation(setup.repeat(COUNT, 1, 1)), deformation(setup)
        assert torch.equal(U, alone.expand(COUNT, -1, -1))
        for many, one in zip(evolvability(U, some.gradient), evolvability(alone, some.gradient), strict=True):
            assert torch.equal(many, one.expand(COUNT))


@pytest.mark.parametrize("dimension", [1, 2, 5, 10, 25])
def test_identical_strategies_take_identical_steps(dimension: int) -> None:
    lower, upper = -torch.ones(dimension, dtype=torch.float64), 2.0 * torch.ones(dimension, dtype=torch.float64)
    axis = torch.linspace(1.0, 3.0, dimension, dtype=torch.float64)

    def path(count: int) -> tuple[Tensor, Tensor]:
        generators = [torch.Generator().manual_seed(5) for _ in range(count)]
        mean = torch.full((count, dimension), 0.7, dtype=torch.float64)
        search = CMAES(mean, 0.2, lower, upper, generators=generators, parents=4, offspring=10)
        for _ in range(25):
            search.tell(-(axis * search.ask()).square().sum(2))
        return search.mean, search.sigma

    (mean, sigma), (means, sigmas) = path(1), path(COUNT)
    assert torch.equal(means, mean.expand(COUNT, -1))
    assert torch.equal(sigmas, sigma.expand(COUNT))


# ------------------------------------------------------------------ threads


def test_the_threads_are_left_as_they_were_found() -> None:
    torch.set_num_threads(2)
    with coarse() as outer:
        assert torch.get_num_threads() == 1
        with coarse() as inner:
            assert (outer, inner) == (2, 2)
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
    with pytest.raises(RuntimeError, match="stopped"), coarse():
        raise RuntimeError("stopped")
    assert torch.get_num_threads() == 2
    matrices.product(square(5)[None], square(5)[None])
    assert torch.get_num_threads() == 2


COUNTS = """
import ctypes, sys, threading
import torch
from rbfevo.scoring.threads import coarse, run_in_slices
library, found = ctypes.CDLL(sys.argv[1]), []
def work(begin, end):
    found.append(library.mkl_serv_get_max_threads())
def elsewhere():
    torch.set_num_threads(2)
    with coarse():
        work(0, 1)
torch.set_num_threads(2)
run_in_slices(work, 16)
with coarse():
    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
print(*found, torch.get_num_threads())
"""


def test_every_thread_has_one_thread_of_mkl() -> None:
    """Torch and MKL count threads for each thread that calls them, and MKL's first call in one may take them all.

    In a process of its own: MKL takes as many as the environment gives to the process at its start.
    """
    library = Path(torch.__file__).parent / "lib" / "libtorch_cpu.so"
    if not library.exists() or not hasattr(ctypes.CDLL(str(library)), "mkl_serv_get_max_threads"):
        pytest.skip("this torch has no MKL that could be asked")
    environment = os.environ | {"OMP_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    command = [sys.executable, "-c", COUNTS, str(library)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1"] * 9 + ["2"]
