"""RBFs with a linear polynomial, beside the saddle-point system, SciPy's interpolator, and plain NumPy on files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
import torch
from designs import Design, plane, sphere
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist
from test_export import parse_pygem, table
from test_mesh_runs import egg

from rbfevo import advise, apply, export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.recorded.exported import read_export
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import setup
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.gradients import differentiable_scores
from rbfevo.scoring.kernels import Cubic, Gaussian, Kernel, Multiquadric, ThinPlate, Wendland
from rbfevo.scoring.representations import representation_of
from rbfevo.scoring.representations.linear import Linear, LinearRBF
from rbfevo.scoring.symmetric import MirroredEvaluator

M = 12
SPACE = Linear((0, 1, 2), (0.1, -0.2, 0.3), 1.7)
FLAT = Linear((0, 1), (0.5, 1.0), 2.0)
CASES = {
    "wendland": (sphere, Wendland(1.0), SPACE),
    "cubic": (sphere, Cubic(), SPACE),
    "thin plate": (plane, ThinPlate(), FLAT),
}
SCIPY = {
    "cubic": (sphere, Cubic(), SPACE, 1.0),
    "thin_plate_spline": (plane, ThinPlate(), FLAT, 1.0),
    "gaussian": (sphere, Gaussian(0.8), SPACE, 1 / 0.8),
    "multiquadric": (sphere, Multiquadric(0.8), SPACE, 1 / 0.8),
}


def made(case: str) -> tuple[Design, LinearRBF, torch.Tensor]:
    """A design, its RBFs, and some setups [4, M, d], the first of which is not on the sphere."""
    design, kernel, linear = CASES[case]
    found = design(15, 15) if design is plane else design(2)
    centers = found.centers(4, M)
    centers[0] *= torch.linspace(0.6, 1.2, M, dtype=torch.float64)[:, None]
    return found, LinearRBF(kernel, linear), centers


def saddle(kernel: Kernel, X: np.ndarray, C: np.ndarray) -> np.ndarray:
    """The columns [n, m] by which the displacements of the centers act, by the saddle-point system."""
    m, d = C.shape
    ones, zero = np.ones((m, 1)), np.zeros((d + 1, d + 1))
    polynomial = np.hstack([ones, C])
    system = np.block([[kernel(cdist(C, C)), polynomial], [polynomial.T, zero]])
    columns = np.hstack([kernel(cdist(X, C)), np.ones((len(X), 1)), X])
    return np.linalg.solve(system.T, columns.T).T[:, :m]


def unsaddled(kernel: Kernel, X: np.ndarray, C: np.ndarray) -> np.ndarray:
    """The columns [n, m] of the weights: of the kernels outside the linear functions, of the polynomial within them."""
    polynomial = np.hstack([np.ones((len(C), 1)), C])
    inverse = np.linalg.pinv(polynomial)
    rest = np.eye(len(C)) - polynomial @ inverse
    return kernel(cdist(X, C)) @ rest + np.hstack([np.ones((len(X), 1)), X]) @ inverse


# --- columns ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_columns_are_those_of_the_saddle_point_system(case):
    design, representation, centers = made(case)
    X = design.vertices.numpy()
    for C in centers:
        B = representation.phi(design.vertices, C)
        np.testing.assert_allclose(B.numpy(), unsaddled(representation.kernel, X, C.numpy()), atol=1e-11)
        np.testing.assert_allclose(representation.phi(X, C.numpy()), B.numpy(), atol=1e-13)  # in NumPy
        U = representation.matrix(B, C, "direct")
        assert U is not None
        np.testing.assert_allclose(U.numpy(), saddle(representation.kernel, X, C.numpy()), atol=1e-9)
    together = representation.phi(design.vertices, centers)
    np.testing.assert_allclose(together[2].numpy(), representation.phi(X, centers[2].numpy()), atol=1e-13)


@pytest.mark.parametrize("case", CASES)
def test_coefficients_are_those_of_kernels_and_of_the_polynomial(case):
    design, representation, centers = made(case)
    X, C = design.vertices.numpy(), centers[0].numpy()
    w = np.random.default_rng(1).normal(size=(M, 3))
    kernel, polynomial = representation.coefficients(C, w)
    ones = np.ones((len(X), 1))
    u = representation.kernel(cdist(X, C)) @ kernel + np.hstack([ones, X]) @ polynomial
    np.testing.assert_allclose(u, representation.phi(X, C) @ w, atol=1e-11)
    np.testing.assert_allclose(np.hstack([ones[:M], C]).T @ kernel, 0.0, atol=1e-11)


@pytest.mark.parametrize("name", SCIPY)
def test_direct_is_scipys_interpolator(name):
    design, kernel, linear, epsilon = SCIPY[name]
    found = design(12, 12) if design is plane else design(2)
    C = found.centers(M, seed=3).numpy() * np.linspace(0.7, 1.1, M)[:, None]
    d = np.random.default_rng(0).normal(size=(M, 3))
    theirs = RBFInterpolator(C, d, kernel=name, epsilon=epsilon, degree=1)(found.vertices.numpy())
    representation = LinearRBF(kernel, linear)
    X, own = found.vertices, torch.from_numpy(C)
    U = representation.matrix(representation.phi(X, own), own, "direct")
    assert U is not None
    np.testing.assert_allclose(U.numpy() @ d, theirs, atol=1e-8)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_a_linear_field_is_reached_exactly_and_moves_all_alike(case, manipulation):
    design, representation, centers = made(case)
    X, d = design.vertices, design.vertices.shape[1]
    A = torch.tensor([[0.3, -1.0, 0.2], [0.8, 0.1, 0.5], [-0.4, 0.6, 1.1]], dtype=torch.float64)[:d]
    field = X @ A + torch.tensor([0.2, -0.1, 0.4], dtype=torch.float64)
    scores = Evaluator(X, field / field.norm(), representation, manipulation)(centers)
    np.testing.assert_allclose(scores.improvement_potential.numpy(), 1.0, atol=1e-10)
    if manipulation == "direct":
        for C in centers:
            U = representation.matrix(representation.phi(X, C), C, "direct")
            assert U is not None
            moved = U @ (C @ A + torch.tensor([0.2, -0.1, 0.4], dtype=torch.float64))
            np.testing.assert_allclose(moved.numpy(), field.numpy(), atol=1e-8)


def test_neither_origin_nor_unit_change_the_scores():
    design, representation, centers = made("wendland")
    away = LinearRBF(Wendland(10.0), Linear((0, 1, 2), (40.0, 2.0, 5.0), 3.0))
    X, g = design.vertices, design.gradient
    for manipulation in ("indirect", "direct"):
        here = Evaluator(X, g, representation, manipulation)(centers)
        there = Evaluator(10 * X + 7, g, away, manipulation)(10 * centers + 7)
        np.testing.assert_allclose(there.regularity.numpy(), here.regularity.numpy(), rtol=1e-9)
        np.testing.assert_allclose(
            there.improvement_potential.numpy(), here.improvement_potential.numpy(), rtol=0, atol=1e-10
        )


# --- scores ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_the_fast_path_is_the_definition_and_has_its_gradients(case, manipulation):
    design, representation, centers = made(case)
    evaluator = Evaluator(design.vertices, design.gradient, representation, manipulation)
    assert evaluator.backend == "eager"
    compare(evaluator, centers)


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_symmetric_setups_are_whole_ones_with_images(manipulation):
    design, representation, centers = made("wendland")
    mirror = Mirror(0, 0.0)
    centers[..., 0] = centers[..., 0].abs() + 0.05
    centers[:, 4, 0] = 0.0  # on the plane
    evaluator = MirroredEvaluator(design.vertices, design.gradient, representation, manipulation, mirror=mirror)
    compare(evaluator, centers, fixed=(4, 0))
    scores, flip = evaluator(centers), torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    for i, C in enumerate(centers):  # what a whole setup with the images reaches of a symmetric field
        whole = torch.cat((C, (C * flip)[torch.arange(M) != 4]))
        B = representation.phi(design.vertices, whole).numpy()
        even, odd = B[:, :M].copy(), np.delete(B[:, :M], 4, axis=1)
        others = B[:, M:]
        even[:, np.arange(M) != 4] += others
        odd -= others
        left = 0.0
        for columns, components in ((even, [1, 2]), (odd, [0])):
            g = design.gradient.numpy()[:, components]
            left += float(np.square(g - columns @ np.linalg.lstsq(columns, g, rcond=None)[0]).sum())
        assert float(scores.improvement_potential[i]) == pytest.approx(1 - left, abs=1e-9)


def compare(evaluator: Evaluator, centers: torch.Tensor, fixed: tuple[int, int] | None = None) -> None:
    """Assert that scores are those of the definition, and gradients those of central differences of it."""
    fast, slow = evaluator(centers), evaluator.definition(centers)
    np.testing.assert_allclose(fast.regularity.numpy(), slow.regularity.numpy(), rtol=1e-8)
    np.testing.assert_allclose(fast.improvement_potential.numpy(), slow.improvement_potential.numpy(), atol=1e-11)
    np.testing.assert_array_equal(fast.variability.numpy(), slow.variability.numpy())
    assert float(fast.regularity.min()) > 1e-5
    leaf = centers.clone().requires_grad_()
    regularity, potential = differentiable_scores(evaluator, leaf)
    (regularity.log() + 3.0 * potential).sum().backward()
    assert leaf.grad is not None
    direction, h = torch.randn(centers.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64), 1e-6
    if fixed is not None:
        direction[:, fixed[0], fixed[1]] = 0.0

    def value(setups: torch.Tensor) -> torch.Tensor:
        found = evaluator.definition(setups)
        return found.regularity.log() + 3.0 * found.improvement_potential

    rises = (value(centers + h * direction) - value(centers - h * direction)) / (2 * h)
    np.testing.assert_allclose((leaf.grad * direction).sum((1, 2)).numpy(), rises.numpy(), rtol=2e-6, atol=1e-7)


def test_setups_in_a_plane_fail_and_are_counted():
    design, representation, centers = made("wendland")
    centers[1, :, 2] = 0.25 + 0.5 * centers[1, :, 0]
    for manipulation in ("indirect", "direct"):
        evaluator = Evaluator(design.vertices, design.gradient, representation, manipulation)
        scores = evaluator(centers)
        assert scores.failed.tolist() == evaluator.definition(centers).failed.tolist() == [False, True, False, False]
        assert float(scores.improvement_potential[1]) == 0.0 < float(scores.improvement_potential[2])
        assert evaluator.failed_evaluations == 1
        leaf = centers.clone().requires_grad_()
        regularity, potential = differentiable_scores(evaluator, leaf)
        (regularity + potential).sum().backward()
        assert leaf.grad is not None
        assert bool(leaf.grad.isfinite().all())
        assert not leaf.grad[1].any()
    with pytest.raises(UserError, match="needs at least 4 centers, not 3"):
        evaluator(centers[:, :3])


def test_as_many_centers_as_determine_it_leave_the_polynomial_alone():
    design, representation, centers = made("wendland")
    C = centers[0, :4].numpy()
    B = representation.phi(design.vertices.numpy(), C)
    X = np.hstack([np.ones((len(design.vertices), 1)), design.vertices.numpy()])
    np.testing.assert_allclose(X @ np.linalg.lstsq(X, B, rcond=None)[0], B, atol=1e-12)
    assert np.linalg.matrix_rank(B) == 4


def test_its_spec_rebuilds_it():
    _, representation, centers = made("thin plate")
    again = representation_of({"name": "rbf", **representation.spec()})
    assert isinstance(again, LinearRBF)
    C = centers[0].numpy()
    np.testing.assert_array_equal(again.phi(C, C), representation.phi(C, C))


# --- whole runs ------------------------------------------------------------------------------------------------------

LINEAR = "representation.polynomial=linear"
QUICK = {
    "gradient": ["method.starts=16", "method.population=16", "method.generations=4", "method.front=6"],
    "nsga2": ["method.generations=3", "method.population=12"],
    "cmaes": ["method.generations=3"],
    "lloyd": [],
    "ols": ["method.per_axis=8"],
    "random": ["method.population=12"],
}


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"), subdivisions=2)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, template: Path) -> Path:
    """A run of each method on the egg, those of `gradient` symmetric and with held vertices, too."""
    directory = tmp_path_factory.mktemp("runs")
    mesh = ["scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    mesh += [LINEAR, "kernel.support=0.8", "manipulation=direct", "quiet=true", "figures=false", "centers=6"]
    symmetric = ["scenario.symmetry=y", "scenario.symmetry_at=0"]
    more = {
        "symmetric": ["method=gradient", *QUICK["gradient"], *symmetric],
        "held": ["method=gradient", *QUICK["gradient"], "scenario.hold=[-2,-2,-2,2,2,-0.5]"],
        "indirect": ["method=gradient", *QUICK["gradient"], "manipulation=indirect"],
        "bounded": ["method=ols", *QUICK["ols"], "criterion.norm=16"],
    }
    for name, words in {**{name: [f"method={name}", *quick] for name, quick in QUICK.items()}, **more}.items():
        assert main([*mesh, *words, f"hydra.run.dir={directory / name}"]) == 0
    return directory


def numpy_scores(record: Record, row: int) -> tuple[float, float]:
    """R and P of a row of a run on the egg, from its files by plain NumPy."""
    C = record.centers[row]
    direct = record.summary["manipulation"] == "direct"
    columns = saddle if direct else unsaddled
    kernel, X = Wendland(0.8), record.vertices
    blend = np.ones(len(X)) if record.blend is None else record.blend
    plane = record.summary["symmetry"]
    if plane is None:
        parts = [(columns(kernel, X, C), [0, 1, 2])]
    else:
        off = C[:, 1] != 0
        whole = columns(kernel, X, np.vstack([C, C[off] * (1, -1, 1)]))
        even, odd = whole[:, : len(C)].copy(), whole[:, : len(C)][:, off]
        even[:, off] += whole[:, len(C) :]
        parts = [(even, [0, 2]), (odd - whole[:, len(C) :], [1])]
    left, values = 0.0, []
    for U, components in parts:
        U, g = blend[:, None] * U, record.gradient[:, components]
        left += float(np.square(g - U @ np.linalg.lstsq(U, g, rcond=None)[0]).sum())
        values.append(np.linalg.svd(U, compute_uv=False))
    every = np.concatenate(values)
    return float(every.min() / every.max()), 1.0 - left


@pytest.mark.parametrize("name", [*QUICK, "symmetric", "held", "indirect", "bounded"])
def test_rows_of_a_run_are_scored_by_plain_numpy(name, runs):
    record = read(runs / name)
    assert "wendland kernel, support radius 0.8 with a linear polynomial" in record.title.lower()
    assert len(record.usable)
    for row in record.usable[:: max(1, len(record.usable) // 8)].tolist():
        regularity, potential = numpy_scores(record, row)
        assert record.regularity[row] == pytest.approx(regularity, rel=1e-6, abs=1e-12)
        assert record.improvement_potential[row] == pytest.approx(potential, abs=1e-8)
    assert not (runs / name / "sequence.csv").exists()  # its columns do not belong to one center each


def test_ols_places_centers_as_without_the_polynomial(runs, template, tmp_path):
    words = ["scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    words += ["kernel.support=0.8", "quiet=true", "figures=false", "centers=6", "method=ols", *QUICK["ols"]]
    assert main([*words, f"hydra.run.dir={tmp_path / 'plain'}"]) == 0
    np.testing.assert_array_equal(read(tmp_path / "plain").centers[-1], read(runs / "ols").centers[-1])


@pytest.mark.parametrize("name", ["gradient", "symmetric", "held", "indirect"])
def test_an_export_deforms_as_its_own_files_say(name, runs, tmp_path, capsys):
    out, record = tmp_path / "out", read(runs / name)
    assert export.main([str(runs / name), "--pick", "knee", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert not (out / "weights.csv").exists()
    reached = {}
    for what, file in (("displacements", "displacements.csv"), ("weights", "coefficients.csv")):
        words = [str(runs / name), "--pick", "knee", f"--{what}", str(out / file), "--quiet"]
        words += ["--mesh", str(out / "template.vtp"), "--out", str(out / f"{what}.vtp")]
        assert apply.main(words) == 0
        before: Any = pv.read(out / "template.vtp")
        after: Any = pv.read(out / f"{what}.vtp")
        reached[what] = np.asarray(after.points) - np.asarray(before.points)
        np.testing.assert_allclose(reached[what], before["reached"], atol=1e-7)
    places = table(out / "centers.csv")[1]
    moves = table(out / "displacements.csv")[1][:, 4:7]
    blend = np.ones((len(record.vertices), 1)) if record.blend is None else record.blend[:, None]
    moves = moves[places[:, 0].astype(int)] * np.where(places[:, 4:5] == 1, (1.0, -1.0, 1.0), 1.0)
    expected = blend * (saddle(Wendland(0.8), record.vertices, places[:, 1:4]) @ moves)
    np.testing.assert_allclose(reached["displacements"], expected, atol=1e-7)

    lines = [line.split(",") for line in (out / "morph.csv").read_text().split()]
    assert lines[0] == ["of", "wx", "wy", "wz"]
    assert [line[0] for line in lines[7:]] == ["1", "x", "y", "z"]
    values = np.array([line[1:] for line in lines[1:]], dtype=float)
    w = values[:6][places[:, 0].astype(int)] * np.where(places[:, 4:5] == 1, (1.0, -1.0, 1.0), 1.0) * places[:, 5:6]
    X = np.hstack([np.ones((len(record.vertices), 1)), record.vertices])
    expected = blend * (Wendland(0.8)(cdist(record.vertices, places[:, 1:4])) @ w + X @ values[6:])
    np.testing.assert_allclose(reached["weights"], expected, atol=1e-7)
    np.testing.assert_allclose(w.sum(0), 0, atol=1e-9)  # the weights have no linear part

    again, _ = read_export(out / "setup.npz")
    chosen = setup(again, 0)
    parameters = np.random.default_rng(0).normal(size=(6, 3)) * np.where(chosen.on_plane[:, None], (1, 0, 1), 1)
    np.testing.assert_allclose(
        chosen.displacement(record.vertices, parameters),
        setup(record, int(np.load(out / "setup.npz")["row"])).displacement(record.vertices, parameters),
        atol=1e-13,
    )
    if name == "held":
        assert "PyGeM has no held regions" in printed
        return
    assert "parameters.prm: PyGeM deforms as rbfevo.apply does" in printed
    kernel, radius, _, original, deformed = parse_pygem(out / "parameters.prm")
    assert (kernel, radius) == ("beckert_wendland_c2_basis", 0.8)
    pygem = saddle(Wendland(0.8), record.vertices, original) @ (deformed - original)
    np.testing.assert_allclose(reached["displacements"], pygem, atol=1e-7)


def test_plane_runs_and_the_page_have_it(tmp_path):
    words = ["scenario=plane", "scenario.resolution=[15,15]", "kernel=triharmonic", LINEAR, "centers=5", "quiet=true"]
    run = tmp_path / "run"
    assert main([*words, "method=gradient", *QUICK["gradient"], f"hydra.run.dir={run}"]) == 0
    record = read(run)
    for row in record.usable.tolist():
        U = unsaddled(ThinPlate(), record.vertices, record.centers[row])
        sigma = np.linalg.svd(U, compute_uv=False)
        assert record.regularity[row] == pytest.approx(sigma[-1] / sigma[0], rel=1e-6)
    page = (run / "report.html").read_text()
    assert "with a linear polynomial" in page
    assert '"formula": null' in page.replace('":null', '": null')
    assert (run / "front.png").exists()


# --- bad input -------------------------------------------------------------------------------------------------------


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(words) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def test_what_is_refused_is_one_line(template, tmp_path, capsys, runs):
    mesh = ["scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    mesh += ["quiet=true", "figures=false", f"hydra.run.dir={tmp_path / 'run'}"]
    line = refused([*mesh, "representation.polynomial=cubic"], capsys)
    assert "representation.polynomial=cubic" in line
    assert "choose one of linear" in line
    assert "centers=3: representation.polynomial=linear needs at least 4 centers" in refused(
        [*mesh, LINEAR, "centers=3"], capsys
    )
    symmetric = ["scenario.symmetry=y", "scenario.symmetry_at=0", "centers=2"]
    assert "needs at least 3 centers" in refused([*mesh, LINEAR, *symmetric], capsys)
    given = tmp_path / "flat.csv"
    given.write_text("x,y,z\n0,0,0.1\n1,0,0.1\n0,1,0.1\n1,1,0.1\n0.3,0.4,0.1\n")
    line = refused([*mesh, LINEAR, "method=given", f"method.centers={given}", "kernel.support=1"], capsys)
    assert f"{given}: this setup cannot be scored: its centers lie in a plane" in line
    assert not (tmp_path / "run" / "setups.npz").exists()
    sheet: Any = pv.Plane(i_resolution=8, j_resolution=8)
    sheet.point_data["s"] = np.tile([0.0, 0.1, 1.0], (sheet.n_points, 1)) * np.asarray(sheet.points)[:, :1]
    sheet.save(tmp_path / "sheet.vtp")
    words = ["scenario=mesh", f"scenario.template={tmp_path / 'sheet.vtp'}", "scenario.sensitivity=s", *mesh[3:]]
    assert "the design is flat along z" in refused([*words, LINEAR, "kernel.support=1"], capsys)
    assert advise.main([*mesh[:3], LINEAR]) == 2
    assert "without a polynomial" in capsys.readouterr().err
