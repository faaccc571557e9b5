"""Free-form deformation: basis functions beside SciPy's, scores beside the definition, runs beside plain NumPy."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.interpolate import BSpline

from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup
from rbfevo.scenarios import plane
from rbfevo.scoring.deformation import Deformation
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.evolvability import score
from rbfevo.scoring.gradients import differentiable_scores
from rbfevo.scoring.kernels import Wendland
from rbfevo.scoring.representations import FFD, ffd, representation_of
from rbfevo.scoring.representations.bsplines import basis, bernstein, clamped, greville, slopes
from rbfevo.scoring.representations.lattice import Lattice

KERNEL = Wendland(0.5)  # which plays no part
SMALL = ["scenario=plane", "scenario.resolution=[20,20]", "representation=ffd", "figures=false", "quiet=true"]
EPS = float(np.finfo(float).eps)


# --- basis functions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("degree", "inner"), [(1, 0), (1, 3), (2, 2), (3, 0), (3, 4), (4, 1)])
def test_basis_functions_are_those_of_scipy(degree: int, inner: int) -> None:
    rng = np.random.default_rng(degree + 10 * inner)
    knots = clamped(rng.random(inner), degree)
    u = np.concatenate([[0.0, 1.0], rng.random(40), knots])
    spline = BSpline(knots, np.eye(degree + 1 + inner), degree)
    found = basis(u, knots, degree)
    np.testing.assert_allclose(found, spline(u), atol=1e-14)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(found @ greville(knots, degree), u, atol=1e-14)  # control points there make the identity
    within = u[2:42]  # where the derivative of degree 1 is one
    np.testing.assert_allclose(slopes(within, knots, degree), spline.derivative()(within), atol=1e-11)
    for function in (basis, slopes):
        tensors = function(torch.from_numpy(within), torch.from_numpy(knots), degree)
        np.testing.assert_allclose(tensors, function(within, knots, degree), rtol=1e-13, atol=1e-13)


def test_knots_that_coincide_lose_smoothness_and_nothing_else() -> None:
    knots = clamped(np.array([0.7, 0.3, 0.3]), 2)
    u = np.linspace(0.0, 1.0, 21)
    np.testing.assert_allclose(basis(u, knots, 2), BSpline(knots, np.eye(6), 2)(u), atol=1e-14)


def test_batches_of_knots_are_taken_one_by_one() -> None:
    rng = np.random.default_rng(3)
    inner, u = rng.random((2, 3, 2)), rng.random((2, 3, 7))
    found = basis(u, clamped(inner, 3), 3)
    for place in np.ndindex(2, 3):
        np.testing.assert_array_equal(found[place], basis(u[place], clamped(inner[place], 3), 3))


def pygem(points: Any, origin: Any, sides: Any, counts: Any) -> Any:
    """B [q, m] by the formula that PyGeM documents: b_lmn = prod binomial (1 - s)^(L - l) s^l in the unit cube."""
    local = (points - origin) / sides
    columns = []
    for index in itertools.product(*map(range, counts)):
        column = np.ones(len(points))
        for axis, (i, n) in enumerate(zip(index, counts, strict=True)):
            s = local[:, axis]
            column = column * math.comb(n - 1, i) * (1.0 - s) ** (n - 1 - i) * s**i
        columns.append(column)
    inside = ((local >= 0.0) & (local <= 1.0)).all(axis=1)
    return np.stack(columns, axis=1) * inside[:, None]


def test_columns_are_those_of_the_formula_that_pygem_documents() -> None:
    points = np.random.default_rng(1).uniform(-1.0, 2.0, (200, 3))
    made = FFD(Lattice((4, 3, 2), (3, 2, 1)))
    genotype = np.array([0.4, 0.5, 0.3, 0.6, 0.9, 1.1])
    B = made.phi(points, genotype)
    np.testing.assert_allclose(B, pygem(points, [-0.2, -0.4, -0.8], [1.2, 1.8, 2.2], (4, 3, 2)), atol=1e-13)
    inside = B.sum(axis=1)
    assert set(np.round(inside, 12)) == {0.0, 1.0}
    np.testing.assert_allclose(B @ made.handles(genotype), inside[:, None] * points, atol=1e-13)  # nothing is deformed


@pytest.mark.parametrize("turn", [None, 0, 1, 2])
def test_one_formula_for_numpy_and_torch_and_for_turned_boxes(turn: int | None) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.0, 1.0, (100, 3))
    made = FFD(Lattice((4, 5, 3), (3, 2, 1), turn, knots=True))
    genotypes = rng.uniform(0.2, 0.9, (2, 3, made.lattice.size))
    B = made.phi(points, genotypes)
    found = made.phi(torch.from_numpy(points), torch.from_numpy(genotypes))
    np.testing.assert_allclose(found, B, atol=1e-13)
    np.testing.assert_allclose(made.handles(torch.from_numpy(genotypes)), made.handles(genotypes), atol=1e-14)
    inside = B.sum(axis=-1)
    assert 10 < (inside[0, 0] > 0.5).sum() < 90
    identity = B @ made.handles(genotypes)
    np.testing.assert_allclose(identity, inside[..., None] * points, atol=1e-13)
    if turn is not None:  # the same box, all turned back
        angle = genotypes[0, 0, 6]
        c, s = np.cos(angle), np.sin(angle)
        a, b = [(1, 2), (2, 0), (0, 1)][turn]
        back = points - genotypes[0, 0, :3]
        back[:, [a, b]] = back[:, [a, b]] @ np.array([[c, -s], [s, c]])
        straight = FFD(Lattice((4, 5, 3), (3, 2, 1), None, knots=True))
        plain = np.concatenate([np.zeros(3), genotypes[0, 0, 3:6], genotypes[0, 0, 7:]])
        np.testing.assert_allclose(straight.phi(back, plain), B[0, 0], atol=1e-13)


# --- scores ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keys", [{}, {"turn": "up"}, {"degree": [2, 3], "knots": True}, {"active": "inner"}])
def test_scores_are_those_of_the_definition_and_have_its_gradients(keys: dict[str, Any]) -> None:
    scenario = plane((23, 31))
    made = ffd(scenario, KERNEL, 0, [5, 4], **keys).for_run(scenario, "indirect")
    evaluate, space = Evaluator(scenario.vertices, scenario.gradient, made), made.space(scenario, 0)
    setups = space.place(space.sample(16, torch.Generator().manual_seed(4)))
    exact = score(Deformation(scenario.vertices, made), setups, scenario.gradient)
    found = evaluate(setups)
    for name in ("regularity", "improvement_potential", "variability"):
        torch.testing.assert_close(getattr(found, name), getattr(exact, name), rtol=1e-6, atol=1e-9)
    setups = setups[found.regularity > 1e-3][:3].requires_grad_()
    assert len(setups)
    regularity, potential = differentiable_scores(evaluate, setups)
    (gradient,) = torch.autograd.grad((2.0 * regularity + 3.0 * potential).sum(), setups)
    h = 1e-6
    for i in range(setups.shape[1]):
        step = torch.zeros(setups.shape[1], dtype=torch.float64)
        step[i] = h
        above, below = (evaluate(setups.detach() + sign * step).objectives for sign in (1.0, -1.0))
        slope = ((above - below) @ torch.tensor([2.0, 3.0], dtype=torch.float64)) / (2.0 * h)
        torch.testing.assert_close(gradient[:, i], slope, rtol=1e-5, atol=1e-6)


def test_gradients_in_closed_form_are_those_of_autograd() -> None:
    rng = torch.Generator().manual_seed(5)
    points = 2.0 * torch.rand(50, 3, generator=rng, dtype=torch.float64) - 1.0
    made = FFD(Lattice((4, 5, 3), (3, 2, 2), 1), still=1)
    setups = (0.2 + torch.rand(3, 7, generator=rng, dtype=torch.float64)).requires_grad_()
    rows = made.phi(points, setups).mT
    gradient = torch.rand(rows.shape, generator=rng, dtype=torch.float64)
    (expected,) = torch.autograd.grad(rows, setups, gradient)
    found = made.pull(points, setups.detach(), gradient)
    assert found is not None
    torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-12)


def test_on_a_sphere_quadrics_are_lost() -> None:
    """x^2 + y^2 + z^2 - 1 lies in every lattice of degree 2 or more along all axes: 4 x 3 x 3 has rank 34 of 36.

    Its multiples by a linear function of x lie in it as well.
    """
    sphere = torch.from_numpy(np.array(trimesh.creation.icosphere(4).vertices))
    g = torch.zeros_like(sphere)
    g[:, 0] = sphere[:, 2] ** 3 / (sphere[:, 2] ** 3).norm()
    for counts, degrees, rank in (((4, 3, 3), (3, 2, 2), 34), ((4, 3, 3), (1, 1, 1), 36), ((2, 2, 2), (1, 1, 1), 8)):
        made = FFD(Lattice(counts, degrees))
        setup = torch.tensor([[0.0, 0.0, 0.0, 1.01, 1.02, 1.03]], dtype=torch.float64)
        for scores in (Evaluator(sphere, g, made)(setup), Evaluator(sphere, g, made).definition(setup)):
            assert round(float(scores.variability[0]) * len(sphere)) == rank
            assert (float(scores.regularity[0]) > 0) == (rank == math.prod(counts))
            U = made.phi(sphere.numpy(), setup[0].numpy())
            left, sigma, _ = np.linalg.svd(U, full_matrices=False)
            kept = left[:, sigma > len(U) * EPS * sigma[0]]
            assert kept.shape[1] == rank
            expected = float(((kept.T @ g.numpy()) ** 2).sum())
            assert float(scores.improvement_potential[0]) == pytest.approx(expected, abs=1e-8)


def test_boxes_without_vertices_and_bad_genotypes_disturb_no_others() -> None:
    scenario = plane((20, 20))
    made = ffd(scenario, KERNEL, 0, [3, 3]).for_run(scenario, "indirect")
    evaluate = Evaluator(scenario.vertices, scenario.gradient, made)
    good = torch.tensor([0.5, 1.0, 0.6, 1.1], dtype=torch.float64)
    empty, flat, wrong = good.clone(), good.clone(), good.clone()
    empty[0], flat[2], wrong[3] = 9.0, 0.0, torch.nan
    found, alone = evaluate(torch.stack([good, empty, flat, wrong])), evaluate(good)
    assert found.failed.tolist() == [False, False, False, True]
    assert float(found.regularity[0]) == float(alone.regularity) > 0
    for column in found[:3]:
        assert column[1:].tolist() == [0.0, 0.0, 0.0]


def test_inner_control_points_leave_the_faces_smooth() -> None:
    for order in (0, 1):
        scenario = plane((10, 10))
        made = ffd(scenario, KERNEL, 0, [6, 6], active="inner", continuity=order)
        side = 6 - 2 * (order + 1)
        assert made.active == side**2
        genotype, h = np.array([0.0, 0.0, 1.0, 1.0]), 1e-5
        beside = np.column_stack([1.0 - h * np.arange(3), np.full(3, 0.3)])
        values = made.phi(beside, genotype)
        slope = np.abs(values[1]).max() / h
        assert np.abs(values[0]).max() == 0.0
        assert (slope > 0.1) == (order == 0)
        assert slope < (10.0 if order == 0 else 1e-3)


def test_a_representation_is_rebuilt_from_its_spec() -> None:
    scenario = plane((10, 10))
    points = scenario.vertices.numpy()
    for manipulation, centers in (("indirect", 0), ("indirect", 3), ("direct", 5)):
        keys = {"degree": [2, 3], "turn": "z", "knots": True}
        made = ffd(scenario, KERNEL, centers, [5, 4], **keys).for_run(scenario, manipulation)
        again = representation_of(made.spec())
        genotype = made.space(scenario, 0).sample(1, torch.Generator().manual_seed(0))[0].numpy()
        np.testing.assert_array_equal(again.phi(points, genotype), made.phi(points, genotype))
        np.testing.assert_array_equal(again.handles(genotype), made.handles(genotype))
        assert again.spec() == made.spec()


# --- runs ------------------------------------------------------------------------------------------------------------


def rescored(U: Any, g: Any) -> tuple[float, float]:
    """R and P by NumPy's SVD."""
    left, sigma, _ = np.linalg.svd(U, full_matrices=False)
    kept = left[:, sigma > max(U.shape) * EPS * sigma[0]]
    return (float(sigma[-1] / sigma[0]) if kept.shape[1] == U.shape[1] else 0.0), float(((kept.T @ g) ** 2).sum())


SEARCHES = {
    "random": ["method.population=6"],
    "nsga2": ["method.population=8", "method.generations=4"],
    "cmaes": ["preference=0.3", "method.generations=4"],
    "gradient": [
        "method.starts=16",
        "method.population=16",
        "method.generations=3",
        "method.front=6",
        "method.polish=1",
    ],
}


@pytest.mark.parametrize("method", SEARCHES)
def test_runs_are_those_of_plain_numpy(method: str, tmp_path: Path) -> None:
    place = [f"hydra.run.dir={tmp_path / 'run'}", "representation.lattice=[4,5]"]
    assert main([*SMALL, *place, f"method={method}", *SEARCHES[method]]) == 0
    record = read(tmp_path / "run")
    assert record.genotype is not None
    assert record.genotype.shape[1] == 4
    assert record.centers.shape[1:] == (20, 2)
    assert record.summary["centers"] == 20
    assert record.title == "plane · representation ffd, lattice 4 x 5 · indirect manipulation"
    for row in range(len(record.regularity)):
        c, h = record.genotype[row, :2], record.genotype[row, 2:]
        U = pygem(record.vertices, c - h, 2.0 * h, (4, 5))
        R, P = rescored(U, record.gradient)
        assert record.regularity[row] == pytest.approx(R, rel=1e-6, abs=1e-12)
        assert record.improvement_potential[row] == pytest.approx(P, abs=1e-8)
        np.testing.assert_allclose(setup(record, row).columns(record.vertices), U, atol=1e-12)


def test_a_lattice_that_does_not_fit_is_refused_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for keys, line in (
        (["representation.lattice=[4,1]"], "representation.lattice=[4, 1]: give 2 whole numbers of at least 2"),
        (["representation.lattice=[4,3,3]"], "representation.lattice=[4, 3, 3]: give 2 whole numbers"),
        (["representation.lattice=4"], "representation.lattice=[4]: give 2 whole numbers"),
        (
            ["representation.lattice=[4,3]", "representation.degree=3"],
            "3 control points along y have at most degree",
        ),
        (["representation.lattice=[4,3]", "representation.degree=[1,0]"], "representation.degree=[1, 0]: give a whole"),
        (["representation.lattice=[4,3]", "centers=13"], "centers=13: the lattice 4 x 3 has 12 control points"),
        (["representation.lattice=[4,3]", "centers=7"], "12 control points of the lattice 4 x 3 can move"),
        (
            ["representation.lattice=[4,3]", "representation.active=inner", "representation.continuity=1"],
            "outer 2 layers",
        ),
        (["representation.lattice=[4,3]", "representation.continuity=1"], "is for representation.active=inner"),
        (["representation.lattice=[4,3]", "representation.active=outer"], "choose one of all, inner"),
        (["representation.lattice=[4,3]", "representation.turn=x"], "representation.turn=x: choose one of up, z"),
        (["representation.lattice=[4,3]", "representation.knots=true"], "have no inner knots"),
    ):
        place = f"hydra.run.dir={tmp_path / 'run'}"
        assert main([*SMALL, place, "method=nsga2", *keys]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert line in err


def test_a_lattice_alone_can_be_refused() -> None:
    with pytest.raises(UserError, match="have the shape"):
        Evaluator(plane((9, 9)).vertices, plane((9, 9)).gradient, FFD(Lattice((3, 3), (2, 2))))(torch.zeros(2, 5))


def test_bernstein_at_the_ends() -> None:
    np.testing.assert_array_equal(bernstein(np.array([0.0, 1.0]), 3), [[1, 0, 0, 0], [0, 0, 0, 1]])
