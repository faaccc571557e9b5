"""Free-form deformation of symmetric designs and by points on the surface, beside plain NumPy."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_ffd import EPS, KERNEL, pygem, rescored
from test_mesh_runs import egg

from rbfevo.__main__ import main
from rbfevo.recorded.record import read
from rbfevo.scenarios import mesh, plane
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.gradients import differentiable_scores
from rbfevo.scoring.representations import ffd
from rbfevo.scoring.symmetric import MirroredEvaluator, evaluator_of

LATTICE = (3, 5, 2)  # the middle layer along y lies on the plane of symmetry
SEARCHES = {
    "random": ["method.population=5"],
    "nsga2": ["method.population=8", "method.generations=3"],
    "cmaes": ["preference=0.3", "method.generations=3"],
    "gradient": [
        "method.starts=16",
        "method.population=16",
        "method.generations=3",
        "method.front=4",
        "method.polish=1",
    ],
}


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"), subdivisions=2)


def symmetric(template: Path) -> list[str]:
    return [
        *("scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"),
        *("scenario.symmetry=y", "scenario.symmetry_at=0", "representation=ffd", "figures=false", "quiet=true"),
        f"representation.lattice={list(LATTICE)}".replace(" ", ""),
    ]


def blocks(points: Any, genotype: Any, counts: tuple[int, ...] = LATTICE) -> tuple[Any, Any]:
    """Columns along and across the plane y = 0, of control points above it and on it, from the whole lattice."""
    c, h = genotype[:3], genotype[3:6]
    whole = pygem(points, c - h, 2.0 * h, counts).reshape(len(points), *counts)
    along, across = [], []
    for i, j, k in itertools.product(*map(range, counts)):
        image = counts[1] - 1 - j
        if j > image:
            along.append(whole[:, i, j, k] + whole[:, i, image, k])
            across.append(whole[:, i, j, k] - whole[:, i, image, k])
        elif j == image:
            along.append(whole[:, i, j, k])
    return np.stack(along, axis=1), np.stack(across, axis=1)


def of_blocks(parts: tuple[Any, Any], g: Any) -> tuple[float, float]:
    """R and P of both blocks together."""
    sigma, P, lost = [], 0.0, False
    for U, axes in zip(parts, ([0, 2], [1]), strict=True):
        left, values, _ = np.linalg.svd(U, full_matrices=False)
        kept = values > max(U.shape) * EPS * values[0]
        lost |= not kept.all()
        sigma.append(values)
        P += float(((left[:, kept].T @ g[:, axes]) ** 2).sum())
    every = np.concatenate(sigma)
    return (0.0 if lost else float(every.min() / every.max())), P


@pytest.mark.parametrize("method", SEARCHES)
def test_symmetric_runs_are_those_of_the_whole_lattice(method: str, template: Path, tmp_path: Path) -> None:
    assert main([*symmetric(template), f"hydra.run.dir={tmp_path}/run", f"method={method}", *SEARCHES[method]]) == 0
    record = read(tmp_path / "run")
    assert record.genotype is not None
    assert record.summary["centers"] == 3 * 3 * 2
    assert record.centers.shape[1:] == (18, 3)
    assert (record.centers[..., 1] >= 0.0).all()
    assert (record.centers[..., 1] == 0.0).sum(axis=1).tolist() == [6] * len(record.centers)
    assert (record.genotype[:, 1] == 0.0).all()
    for row in range(len(record.regularity)):
        R, P = of_blocks(blocks(record.vertices, record.genotype[row]), record.gradient)
        assert record.regularity[row] == pytest.approx(R, rel=1e-6, abs=1e-12)
        assert record.improvement_potential[row] == pytest.approx(P, abs=1e-8)
    assert (record.regularity > 0).any()


def surfaced(points: Any, surface: Any, genotype: Any) -> tuple[Any, Any]:
    """U of both blocks under direct manipulation, by NumPy's pinv."""
    B, S = blocks(points, genotype), blocks(surface, genotype)
    off = surface[:, 1] != 0.0
    return tuple(  # pyright: ignore[reportReturnType]
        own @ np.linalg.pinv(there, rcond=max(there.shape) * EPS)
        for own, there in zip(B, (S[0], S[1][off]), strict=True)
    )


@pytest.mark.parametrize("method", SEARCHES)
def test_symmetric_direct_runs_are_those_of_the_pseudoinverse(method: str, template: Path, tmp_path: Path) -> None:
    keys = [f"method={method}", *SEARCHES[method], "manipulation=direct", "centers=7"]
    assert main([*symmetric(template), f"hydra.run.dir={tmp_path}/run", *keys]) == 0
    record = read(tmp_path / "run")
    surface = record.centers[0]
    assert surface.shape == (7, 3)
    assert (record.centers == surface).all()
    assert (np.linalg.norm(record.vertices[None] - surface[:, None], axis=2).min(axis=1) < 1e-12).all()
    assert record.genotype is not None
    for row in range(len(record.regularity)):
        R, P = of_blocks(surfaced(record.vertices, surface, record.genotype[row]), record.gradient)
        assert record.regularity[row] == pytest.approx(R, rel=1e-6, abs=1e-12)
        assert record.improvement_potential[row] == pytest.approx(P, abs=1e-8)
    assert (record.regularity > 1e-3).any()


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize("turn", [None, "y"])
def test_symmetric_scores_are_those_of_the_definition_and_have_its_gradients(
    manipulation: str, turn: str | None, template: Path
) -> None:
    scenario = mesh(str(template), sensitivity=str(template.parent / "s.npy"), symmetry="y", symmetry_at=0.0)
    keys: dict[str, Any] = {"degree": [2, 2, 1], "knots": True, "turn": turn}
    made = ffd(scenario, KERNEL, 6 if manipulation == "direct" else 0, [3, 6, 2], **keys).for_run(
        scenario, manipulation
    )
    evaluate, space = evaluator_of(scenario, made, manipulation), made.space(scenario, 0)
    assert isinstance(evaluate, MirroredEvaluator)
    points = space.sample(8, torch.Generator().manual_seed(1))
    setups = space.place(points)
    torch.testing.assert_close(space.points(setups), points, rtol=1e-14, atol=1e-14)
    begin = made.lattice.first_knot
    assert begin == 6 + (turn is not None)
    torch.testing.assert_close(setups[:, begin], 1.0 - setups[:, begin + 2])  # symmetric knots
    assert (setups[:, begin + 1] == 0.5).all()
    found, exact = evaluate(setups), evaluate.definition(setups)
    for name in ("regularity", "improvement_potential", "variability"):
        torch.testing.assert_close(getattr(found, name), getattr(exact, name), rtol=1e-6, atol=1e-9)
    points = points[found.regularity > 1e-3][:2].requires_grad_()
    assert len(points)
    regularity, potential = differentiable_scores(evaluate, space.place(points))
    (gradient,) = torch.autograd.grad((2.0 * regularity + 3.0 * potential).sum(), points)
    h = 1e-6
    for i in range(points.shape[1]):
        step = torch.zeros(points.shape[1], dtype=torch.float64)
        step[i] = h
        above, below = (evaluate(space.place(points.detach() + s * step)).objectives for s in (1.0, -1.0))
        slope = ((above - below) @ torch.tensor([2.0, 3.0], dtype=torch.float64)) / (2.0 * h)
        torch.testing.assert_close(gradient[:, i], slope, rtol=1e-5, atol=1e-6)
    pulled = space.pull(points.detach(), torch.ones(len(points), made.lattice.size, dtype=torch.float64))
    (expected,) = torch.autograd.grad(space.place(points).sum(), points)
    torch.testing.assert_close(pulled, expected)


def test_direct_manipulation_reaches_less_and_moves_the_points_one_by_one() -> None:
    scenario = plane((21, 21))
    made = {
        how: ffd(scenario, KERNEL, 8 * (how == "direct"), [4, 4]).for_run(scenario, how)
        for how in ("indirect", "direct")
    }
    setup = torch.tensor([[0.5, 1.0, 0.55, 1.1]], dtype=torch.float64)
    scores = {how: Evaluator(scenario.vertices, scenario.gradient, one, how)(setup) for how, one in made.items()}
    assert scores["direct"].improvement_potential < scores["indirect"].improvement_potential - 0.01
    assert [round(441 * float(one.variability[0])) for one in scores.values()] == [16, 8]
    surface = made["direct"].surface
    assert surface is not None
    assert len(np.unique(surface, axis=0)) == 8
    U = made["indirect"].phi(surface, setup[0].numpy()) @ made["direct"].weights(setup[0].numpy())
    np.testing.assert_allclose(U, np.eye(8), atol=1e-10)
    R, P = rescored(
        made["direct"].matrix(made["direct"].phi(scenario.vertices, setup[0]), setup[0], "direct").numpy(),
        scenario.gradient.numpy(),
    )
    assert float(scores["direct"].regularity[0]) == pytest.approx(R, rel=1e-6)
    assert float(scores["direct"].improvement_potential[0]) == pytest.approx(P, abs=1e-8)


def test_as_many_points_as_control_points_are_scored_by_the_pseudoinverse() -> None:
    """Points in few lines make B(S) singular; then U reaches less than B(X), though it has as many columns."""
    scenario = plane((23, 31))
    made = ffd(scenario, KERNEL, 0, [5, 4]).for_run(scenario, "direct")
    assert made.surface is not None
    assert made.surface.shape == (20, 2)
    evaluate, space = Evaluator(scenario.vertices, scenario.gradient, made, "direct"), made.space(scenario, 0)
    setups = space.place(space.sample(4, torch.Generator().manual_seed(1)))
    whole = ffd(scenario, KERNEL, 0, [5, 4]).for_run(scenario, "indirect")
    every = Evaluator(scenario.vertices, scenario.gradient, whole)(setups)
    for scores in (evaluate(setups), evaluate.definition(setups)):
        for row, genotype in enumerate(setups.numpy()):
            S = whole.phi(made.surface, genotype)
            U = whole.phi(scenario.vertices.numpy(), genotype) @ np.linalg.pinv(S, rcond=max(S.shape) * EPS)
            R, P = rescored(U, scenario.gradient.numpy())
            assert float(scores.regularity[row]) == pytest.approx(R, rel=1e-6, abs=1e-12)
            assert float(scores.improvement_potential[row]) == pytest.approx(P, abs=1e-8)
        assert (scores.variability < every.variability).any()
        assert (scores.improvement_potential < every.improvement_potential - 1e-3).any()


def test_a_point_that_the_box_leaves_out_cannot_be_moved() -> None:
    scenario = plane((21, 21))
    made = ffd(scenario, KERNEL, 4, [3, 3]).for_run(scenario, "direct")
    setups = torch.tensor([[0.5, 1.0, 0.51, 1.01], [0.5, 1.0, 0.51, 0.6]], dtype=torch.float64)
    evaluate = Evaluator(scenario.vertices, scenario.gradient, made, "direct")
    within = int((np.abs(made.handles(setups[1].numpy())[:, 1] - 1.0) < 0.6).sum())
    assert 0 < within < 4
    for scores in (evaluate(setups), evaluate.definition(setups)):
        assert float(scores.regularity[0]) > 0.0
        assert float(scores.regularity[1]) == 0.0
        assert round(441 * float(scores.variability[1])) == within
    space = made.space(scenario, 0)
    drawn = space.place(space.sample(50, torch.Generator().manual_seed(0)))
    assert (drawn[:, :2] - drawn[:, 2:] <= 0.0).all()  # boxes that are searched hold all points
    assert (drawn[:, :2] + drawn[:, 2:] >= torch.tensor([1.0, 2.0])).all()


def test_points_are_spread_over_what_can_move() -> None:
    scenario = plane((11, 11))
    made = ffd(scenario, KERNEL, 4, [3, 3]).for_run(scenario, "direct")
    assert made.surface is not None
    x = scenario.vertices.numpy()
    for count in range(1, 4):
        apart = np.linalg.norm(x[:, None] - made.surface[None, :count], axis=2).min(axis=1)
        own = np.linalg.norm(made.surface[count] - made.surface[:count], axis=1).min()
        assert own == apart.max()
    assert np.linalg.norm(made.surface[0] - [0.5, 1.0]) == pytest.approx(np.sqrt(1.25))


def test_what_does_not_go_with_symmetry_is_refused(template: Path, tmp_path: Path, capsys: Any) -> None:
    for keys, line in (
        (["representation.turn=up"], "a box that is symmetric about y = 0 can be turned about y alone"),
        (["centers=19"], "18 control points that move on one side of the symmetry plane"),
    ):
        assert main([*symmetric(template), f"hydra.run.dir={tmp_path}/run", "method=random", *keys]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert line in err


def test_a_lattice_with_nothing_but_its_middle_layer_has_no_columns_across(template: Path) -> None:
    scenario = mesh(str(template), sensitivity=str(template.parent / "s.npy"), symmetry="y", symmetry_at=0.0)
    made = ffd(scenario, KERNEL, 0, [4, 3, 4], active="inner").for_run(scenario, "indirect")
    evaluate, space = evaluator_of(scenario, made, "indirect"), made.space(scenario, 0)
    setups = space.place(space.sample(3, torch.Generator().manual_seed(1)))
    found, exact = evaluate(setups), evaluate.definition(setups)
    assert made.columns(setups) == 4
    torch.testing.assert_close(found.objectives, exact.objectives, rtol=1e-6, atol=1e-9)
    assert (found.regularity > 0).any()
