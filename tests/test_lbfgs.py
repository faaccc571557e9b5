"""The batched quasi-Newton method against SciPy's, and its elements against each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from rbfevo.methods.gradient.lbfgs import LBFGS


def quadratics(K: int, D: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Positive definite A [K, D, D] of condition 1e3 and middles [K, D], some of them outside the unit box."""
    generator = torch.Generator().manual_seed(seed)
    Q = torch.linalg.qr(torch.randn(K, D, D, generator=generator, dtype=torch.float64))[0]
    A = Q @ torch.diag_embed(torch.logspace(0, 3, D, dtype=torch.float64).expand(K, D)) @ Q.mT
    return A, torch.rand(K, D, generator=generator, dtype=torch.float64) * 1.6 - 0.3


def climb(search: LBFGS, A: Tensor, middle: Tensor, steps: int) -> list[Tensor]:
    values = []
    for _ in range(steps):
        away = search.ask() - middle
        pull = (A @ away[:, :, None])[:, :, 0]
        search.tell(-0.5 * (away * pull).sum(1), -pull)
        values.append(search.values)
    return values


def test_bounded_quadratics_end_where_scipys_do() -> None:
    A, middle = quadratics(6, 8)
    search = LBFGS(torch.full_like(middle, 0.5))
    values = climb(search, A, middle, 400)
    for matrix, center, found in zip(A.numpy(), middle.numpy(), search.points.numpy(), strict=True):

        def loss(x: np.ndarray, matrix: np.ndarray = matrix, center: np.ndarray = center) -> tuple[float, np.ndarray]:
            pull = matrix @ (x - center)
            return 0.5 * float((x - center) @ pull), pull

        options = {"ftol": 1e-15, "gtol": 1e-12, "maxiter": 5000, "maxfun": 50000}
        peer = minimize(loss, np.full(8, 0.5), jac=True, method="L-BFGS-B", bounds=[(0, 1)] * 8, options=options)
        assert loss(found)[0] <= peer.fun + 1e-8
        np.testing.assert_allclose(found, peer.x, atol=1e-5)
    assert any((search.points[k] == 0).any() or (search.points[k] == 1).any() for k in range(6))
    steps = torch.stack(values).diff(dim=0)
    assert (steps >= 0).all()  # an accepted value is never worse


def test_rosenbrock_needs_about_as_many_evaluations_as_scipy() -> None:
    def rosen(x: Tensor) -> Tensor:
        return (100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(1)

    start = torch.full((1, 10), 0.3, dtype=torch.float64)
    search, needed = LBFGS(start, memory=10), 0
    while float(rosen(4 * search.points - 2)) > 1e-10:
        needed += 1
        assert needed < 600
        x = (4 * search.ask() - 2).requires_grad_()
        value = -rosen(x)
        search.tell(value.detach(), 4 * torch.autograd.grad(value.sum(), x)[0])

    def loss(u: np.ndarray) -> tuple[float, np.ndarray]:
        x = torch.from_numpy(4 * u[None] - 2).requires_grad_()
        value = rosen(x)
        return float(value.detach()), 4 * torch.autograd.grad(value.sum(), x)[0][0].numpy()

    options = {"ftol": 0.0, "gtol": 1e-6, "maxcor": 10}
    peer = minimize(loss, start[0].numpy(), jac=True, method="L-BFGS-B", bounds=[(0, 1)] * 10, options=options)
    assert needed <= 2 * peer.nfev


@pytest.mark.parametrize("K", [5])
def test_a_batch_is_a_loop(K: int) -> None:
    A, middle = quadratics(K, 6, seed=2)
    start = torch.full_like(middle, 0.4)
    together = LBFGS(start, memory=5)
    climb(together, A, middle, 40)
    for k in range(K):
        alone = LBFGS(start[k : k + 1], memory=5)
        climb(alone, A[k : k + 1], middle[k : k + 1], 40)
        torch.testing.assert_close(together.points[k], alone.points[0], rtol=0, atol=1e-9)


def test_values_that_are_not_numbers_are_steps_not_taken() -> None:
    A, middle = quadratics(2, 4, seed=3)
    search = LBFGS(torch.full_like(middle, 0.5))
    climb(search, A, middle, 5)
    before = search.points.clone()
    nan = torch.full((2,), torch.nan, dtype=torch.float64)
    for _ in range(20):
        search.tell(nan, torch.zeros_like(middle))
        assert not search.accepted.any()
    torch.testing.assert_close(search.points, before, rtol=0, atol=0)
    climb(search, A, middle, 300)
    assert (search.points - middle.clamp(0, 1)).isfinite().all()
    assert (search.points >= 0).all()
    assert (search.points <= 1).all()


def test_restarted_elements_forget_and_the_others_do_not() -> None:
    A, middle = quadratics(3, 5, seed=4)
    search = LBFGS(torch.full_like(middle, 0.5))
    climb(search, A, middle, 10)
    kept = search.points[[0, 2]].clone()
    search.restart(torch.tensor([1]), torch.full((1, 5), 0.25, dtype=torch.float64))
    torch.testing.assert_close(search.ask()[[0, 2]], kept, rtol=0, atol=0)
    assert (search.ask()[1] == 0.25).all()
    climb(search, A, middle, 1)
    assert search.accepted.all()  # where they stand is taken as it is
    fresh = search.anew(kept)
    assert fresh.points.shape == (2, 5)
    assert torch.isinf(fresh.values).all()


def test_gradients_of_points_that_are_not_accepted_are_not_looked_at() -> None:
    A, middle = quadratics(4, 6, seed=5)
    searches = [LBFGS(torch.full_like(middle, 0.5), memory=4) for _ in range(2)]
    rejected = 0
    for _ in range(60):
        for search, nan in zip(searches, (False, True), strict=True):
            away = search.ask() - middle
            pull = (A @ away[:, :, None])[:, :, 0]
            values = -0.5 * (away * pull).sum(1)
            accepted = search.accepts(values)
            rejected += int((~accepted).sum())
            search.tell(values, torch.where(accepted[:, None], -pull, torch.nan) if nan else -pull)
            assert torch.equal(search.accepted, accepted)
        assert torch.equal(searches[0].points, searches[1].points)
    assert rejected > 0


def test_a_search_goes_on_where_it_was_saved() -> None:
    A, middle = quadratics(3, 5, seed=6)
    whole, other = (LBFGS(torch.full_like(middle, 0.5), memory=4) for _ in range(2))
    climb(whole, A, middle, 7)  # the next pair has its place in the middle of the memory
    other.load_state_dict(whole.state_dict())
    part = whole.only(torch.tensor([2, 0]))
    climb(whole, A, middle, 9)
    climb(other, A, middle, 9)
    climb(part, A[[2, 0]], middle[[2, 0]], 9)
    assert torch.equal(other.points, whole.points)
    torch.testing.assert_close(part.points, whole.points[[2, 0]], rtol=0, atol=1e-12)
