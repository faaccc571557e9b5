"""`rbfevo.openmdao`: what apply writes, with derivatives that OpenMDAO checks, and optima that are known otherwise."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from grids import write_su2
from test_columns import MIRRORS, field
from test_export import CASES, a_run, spatial
from test_volume import bump_run, half_box, points_of

from rbfevo import apply, export, meshes
from rbfevo.errors import UserError
from rbfevo.meshes.mesh import Mesh
from rbfevo.recorded.record import read

om: Any = pytest.importorskip("openmdao.api", reason="OpenMDAO is not installed (extra openmdao)")
from openmdao.utils.assert_utils import assert_check_partials, assert_check_totals  # noqa: E402

from rbfevo import openmdao  # noqa: E402
from rbfevo.openmdao import Deformation  # noqa: E402

ROOT = Path(__file__).parents[1]
ROUND = {"planar": {"axis": "z", "at": 0.0}}
RUNS = CASES | {
    "held": {
        "d": 3,
        "kernel": "wendland",
        "manipulation": "direct",
        "symmetry": MIRRORS[1],
        "on": 2,
        "hold_width": 0.4,
    },
    "planar": {"d": 3, "kernel": "wendland", "manipulation": "direct", "symmetry": MIRRORS[1], "on": 1, **ROUND},
}
FREE = {"plane": 6, "plane, log": 6, "mirrored plane": 6, "space": 18, "cubic": 18, "mirrored": 16,
        "mirrored, cubic": 18, "held": 16, "planar": 11}  # fmt: skip


def made(run: Path, name: str) -> Path:
    """One of `RUNS`."""
    a_run(run, **RUNS[name])
    if name == "held":
        with np.load(run / "scenario.npz") as archive:
            arrays = dict(archive)
        top = arrays["vertices"][:, 2] > 0.9
        np.savez(run / "scenario.npz", **arrays, held=arrays["vertices"][top], blend=1.0 - top)
    if name == "planar":
        with np.load(run / "setups.npz") as archive:
            arrays = dict(archive)
        arrays["centers"][..., 2] = 0.0
        np.savez(run / "setups.npz", **arrays)
    return run


def problem(run: Path, *, pick: str | None = "index:0", size: float = 0.1, **options: Any) -> Any:
    """A problem of the component alone, named g, at random parameters."""
    made: Any = om.Problem(reports=False)
    made.model.add_subsystem("g", Deformation(run=run, pick=pick, **options), promotes=["*"])
    made.setup(force_alloc_complex=True)
    parameters = made.get_val("parameters")
    made.set_val("parameters", size * np.random.default_rng(1).normal(size=parameters.shape))
    made.run_model()
    return made


def applied(run: Path, mesh: Path, out: Path, rows: Any, *more: str) -> Any:
    """The points of what apply writes."""
    what = "weights" if read(run).summary["manipulation"] == "indirect" else "displacements"
    np.save(out.parent / "rows.npy", rows)
    arguments = [f"--{what}", str(out.parent / "rows.npy"), "--mesh", str(mesh), "--out", str(out), *more]
    assert apply.main([str(run), "--pick", "index:0", *arguments, "--quiet", "--overwrite"]) == 0
    with meshes.opened(out) as written:
        return written.points


@pytest.mark.parametrize("name", RUNS)
def test_the_coordinates_are_those_that_apply_writes(name: str, tmp_path: Path) -> None:
    run, points = made(tmp_path / "run", name), np.random.default_rng(7).uniform(-1, 1, (300, 3))
    np.save(tmp_path / "a.npy", points)
    model = problem(run, mesh=str(tmp_path / "a.npy"))
    parameters = model.get_val("parameters")
    assert len(parameters) == FREE[name]
    rows = model.model.g.rows(parameters)
    expected = applied(run, tmp_path / "a.npy", tmp_path / "b.npy", rows)
    found = model.get_val("x_aero0")
    assert found.shape == (900,)
    np.testing.assert_allclose(found.reshape(-1, 3), expected, rtol=1e-14, atol=1e-14)
    if read(run).vertices.shape[1] == 3:  # to the bit: of heights, apply multiplies matrices with two more columns
        np.testing.assert_array_equal(found.reshape(-1, 3), expected)
    assert np.abs(expected - points).max() > 0.01
    np.testing.assert_allclose(model.model.g.flat(rows), parameters, rtol=0, atol=1e-15)
    for given in (points, points.ravel(), points.tolist()):
        np.testing.assert_array_equal(problem(run, points=given).get_val("x_aero0"), found)
    if name in ("plane", "cubic"):  # whose weights are the parameters: the sum over centers, written out
        record, d = read(run), points.shape[1] if name == "cubic" else 2
        k = record.gradient.shape[1]
        moved = field(record, 0, points[:, :d], parameters.reshape(-1, k))
        np.testing.assert_allclose(found.reshape(-1, 3) - points, spatial(moved), rtol=0, atol=1e-13)


@pytest.mark.parametrize("matrix_free", [False, True])
@pytest.mark.parametrize("orthogonalized", [False, True])
@pytest.mark.parametrize("name", [name for name in RUNS if name != "mirrored"])
def test_openmdao_finds_the_derivatives_exact(
    name: str, orthogonalized: bool, matrix_free: bool, tmp_path: Path
) -> None:
    run = made(tmp_path / "run", name)
    if orthogonalized and name in ("held", "planar", "space"):
        spread(run)
    options = {"matrix_free": matrix_free, "orthogonalized": orthogonalized, "input_name": "x_in"}
    model = problem(run, points=np.random.default_rng(7).uniform(-1, 1, (12, 3)), **options)
    checked = model.check_partials(method="cs", out_stream=None)
    (found,) = checked.values()
    assert set(found) == {("x_aero0", "parameters"), ("x_aero0", "x_in")}
    assert all(("J_rev" in entry) == matrix_free for entry in found.values())
    assert_check_partials(checked, atol=1e-10, rtol=1e-10)
    assert model.model.g.matrix_free == matrix_free


def spread(run: Path) -> None:
    """Centers on the vertices, so that the columns of U are independent; those on a plane stay there."""
    with np.load(run / "setups.npz") as archive, np.load(run / "scenario.npz") as scenario:
        arrays, vertices = dict(archive), scenario["vertices"]
    low = vertices[(vertices[:, 2] < 0.3) & (vertices[:, 1] > 0.2)]
    C = arrays["centers"][0]
    fixed = C == 0.0
    C[:] = np.where(fixed, 0.0, low[:: len(low) // len(C)][: len(C)])
    np.savez(run / "setups.npz", **arrays)


@pytest.mark.parametrize("name", ["plane, log", "space", "mirrored, cubic", "held"])
def test_orthogonalized_parameters_are_those_of_the_exported_columns(name: str, tmp_path: Path) -> None:
    run = made(tmp_path / "run", name)
    spread(run) if name != "plane, log" else None
    assert export.main([str(run), "--pick", "index:0", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    exported = tmp_path / "out" / "setup.npz"
    with np.load(exported) as archive:
        arrays = dict(archive)
    model = problem(run, orthogonalized=True)
    q, X = model.get_val("parameters"), spatial(arrays["vertices"])
    moved = model.get_val("x_aero0").reshape(-1, 3) - X
    expected = np.zeros_like(X)
    if name == "plane, log":
        expected[:, 2] = arrays["Q"] @ q
    elif name == "space":
        expected = arrays["Q"] @ q.reshape(-1, 3)
    else:  # the centers on the plane have no parameter across it, y
        rows, off = np.full((6, 3), np.nan), arrays["across"]
        free = np.ones((6, 3), bool)
        free[np.setdiff1d(np.arange(6), off), 1] = False
        rows[free] = q
        expected[:, [0, 2]] = arrays["Q"] @ rows[:, [0, 2]]
        expected[:, 1] = arrays["Q_across"] @ rows[off, 1]
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-12)
    # The same of the export alone, and in both kinds of parameters.
    for orthogonalized in (False, True):
        one, other = (
            problem(path, pick=pick, orthogonalized=orthogonalized).get_val("x_aero0")
            for path, pick in ((run, "index:0"), (exported, None))
        )
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-13)


def bump(tmp_path: Path, **more: Any) -> tuple[Path, Mesh, Path]:
    """A run on the bump of half a box, and the box as an SU2 file."""
    mesh = half_box()
    run = bump_run(tmp_path / "run", mesh.points[points_of(mesh, "bump")], **more)
    write_su2(tmp_path / "a.su2", mesh)
    return run, mesh, tmp_path / "a.su2"


@pytest.mark.filterwarnings("ignore:.*points at the rim of the design surface")
@pytest.mark.parametrize("matrix_free", [False, True])
def test_the_inside_is_carried_as_by_apply_with_exact_derivatives(matrix_free: bool, tmp_path: Path) -> None:
    run, mesh, path = bump(tmp_path)
    model = problem(run, mesh=path, volume="laplace", matrix_free=matrix_free, size=0.03)
    rows = model.model.g.rows(model.get_val("parameters"))
    expected = applied(run, path, tmp_path / "b.su2", rows, "--volume", "laplace")
    found = model.get_val("x_aero0").reshape(-1, 3)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    held = points_of(mesh, "xmin", "xmax", "ymax", "zmax") & ~points_of(mesh, "bump")
    np.testing.assert_array_equal(found[held], mesh.points[held])
    inside = ~points_of(mesh, *mesh.patches)
    assert np.abs(found - mesh.points)[inside].max() > 1e-3
    assert_check_partials(model.check_partials(method="cs", out_stream=None), atol=1e-10, rtol=1e-10)


def test_patches_can_be_named(tmp_path: Path) -> None:
    run, mesh, path = bump(tmp_path)
    whole = ["bump", "zmin"]
    with pytest.warns(om.OpenMDAOWarning, match="points at the rim of the design surface move by up to"):
        model = problem(run, mesh=path, volume="laplace", design=whole, slip=["xmin"], size=0.01)
    moved = np.abs(model.get_val("x_aero0").reshape(-1, 3) - mesh.points)
    assert moved[points_of(mesh, "zmin") & ~points_of(mesh, "bump")].max() > 1e-4
    slides = points_of(mesh, "xmin") & ~points_of(mesh, "zmin", "zmax", "ymax")
    assert moved[slides, 1:].max() > 1e-4
    assert (moved[slides, 0] == 0.0).all()


def slsqp(model: Any, **options: Any) -> Any:
    """Minimize with SciPy's SLSQP; return the driver's result."""
    model.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", tol=1e-12, maxiter=200, disp=False, **options)
    model.setup(mode="rev")
    model.set_val("parameters", 0.1)
    model.run_driver()
    return model.driver.result


def test_slsqp_leaves_of_a_target_what_potential_says(tmp_path: Path) -> None:
    """min over P of |M^1/2 (U P - g)|^2 is (1 - P) |g|^2, of g at the vertices and any setup."""
    run = made(tmp_path / "run", "cubic")
    record = read(run)
    root = np.sqrt(record.weights)[:, None]
    phi = np.linalg.norm(record.vertices[:, None] - record.centers[0], axis=2) ** 3
    Q = np.linalg.qr(root * phi)[0]
    left = float(((root * record.gradient - Q @ (Q.T @ (root * record.gradient))) ** 2).sum())
    target = record.vertices + record.gradient
    model: Any = om.Problem(reports=False)
    model.model.add_subsystem("g", Deformation(run=run, pick="index:0", orthogonalized=True), promotes=["*"])
    n, weights = target.size, np.repeat(record.weights, 3)
    distance: Any = om.ExecComp("J = sum(w * (x - t)**2)", x=np.zeros(n), w={"val": weights}, t={"val": target.ravel()})
    model.model.add_subsystem("j", distance, promotes_inputs=[("x", "x_aero0")], promotes_outputs=["J"])
    model.model.add_design_var("parameters")
    model.model.add_objective("J")
    assert slsqp(model).success
    assert float(model.get_val("J")[0]) == pytest.approx(left, rel=1e-9)
    assert 0.05 < left < 0.95


def test_slsqp_finds_the_steepest_step_within_a_ball(tmp_path: Path) -> None:
    """min s.X' with |q|^2 <= r^2 is s.X - r |Q^T s|, for orthonormal columns Q; by both kinds of derivatives alike."""
    run = made(tmp_path / "run", "space")
    spread(run)
    record = read(run)
    s, r = np.random.default_rng(3).normal(size=record.vertices.shape), 0.7
    optima = []
    for matrix_free in (False, True):
        model: Any = om.Problem(reports=False)
        options = {"orthogonalized": True, "matrix_free": matrix_free}
        model.model.add_subsystem("g", Deformation(run=run, pick="index:0", **options), promotes=["*"])
        line: Any = om.ExecComp("J = sum(s * x)", x=np.zeros(s.size), s={"val": s.ravel()})
        ball: Any = om.ExecComp("c = sum(q**2)", q=np.zeros(18))
        model.model.add_subsystem("j", line, promotes_inputs=[("x", "x_aero0")], promotes_outputs=["J"])
        model.model.add_subsystem("b", ball, promotes_inputs=[("q", "parameters")], promotes_outputs=["c"])
        model.model.add_design_var("parameters")
        model.model.add_objective("J")
        model.model.add_constraint("c", upper=r**2)
        assert slsqp(model).success
        optima.append(float(model.get_val("J")[0]))
        totals = model.check_totals(method="fd", form="central", step=1e-3, out_stream=None)
        assert_check_totals(totals, atol=1e-6, rtol=1e-7)
    assert export.main([str(run), "--pick", "index:0", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    with np.load(tmp_path / "out" / "setup.npz") as archive:
        pulled = archive["Q"].T @ s
    assert optima == pytest.approx(2 * [float((s * record.vertices).sum() - r * np.linalg.norm(pulled))], rel=1e-8)


def test_displacements_are_added_to_coordinates_of_an_input(tmp_path: Path) -> None:
    run = made(tmp_path / "run", "space")
    made_model: Any = om.Problem(reports=False)
    names = {"input_name": "x_aero0_geometry_input", "output_name": "x_aero0_geometry_output", "parameters_name": "dv"}
    made_model.model.add_subsystem("g", Deformation(run=run, pick="index:0", **names), promotes=["*"])
    made_model.setup()
    made_model.set_val("dv", 0.1)
    made_model.run_model()
    at_rest = made_model.get_val("x_aero0_geometry_output").copy()
    made_model.set_val("x_aero0_geometry_input", made_model.get_val("x_aero0_geometry_input") + 5.0)
    made_model.run_model()
    np.testing.assert_allclose(made_model.get_val("x_aero0_geometry_output"), at_rest + 5.0, rtol=0, atol=1e-14)


def test_a_large_jacobian_is_never_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = made(tmp_path / "run", "space")
    assert not problem(run).model.g.matrix_free
    monkeypatch.setattr(openmdao, "ENTRIES", 162 * 18 - 1)
    monkeypatch.setattr(openmdao.Displacement, "columns", None)
    assert problem(run).model.g.matrix_free


class TwoProcesses:
    """What a component sees of MPI in one of two processes; the other one has pulled the parameters by `other`."""

    size, rank = 2, 0

    def __init__(self, other: Any) -> None:
        self.other = other

    def allreduce(self, values: Any) -> Any:
        return values + self.other


@pytest.mark.filterwarnings("ignore:.*there is no distributed vector implementation")
def test_each_process_has_its_own_points_and_derivatives_add_up(tmp_path: Path) -> None:
    run, points = made(tmp_path / "run", "space"), np.random.default_rng(7).uniform(-1, 1, (40, 3))
    whole = problem(run, points=points, matrix_free=True).model.g
    parts = [problem(run, points=part, distributed=True).model.g for part in (points[:15], points[15:])]
    assert all(part.matrix_free for part in parts)
    force = np.random.default_rng(2).normal(size=120)
    pulled = []
    for g, own in ((whole, force), (parts[1], force[45:]), (parts[0], force[:45])):
        if g is parts[0]:
            g.comm = TwoProcesses(pulled[1])
        back = {"parameters": np.zeros(18)}
        g.compute_jacvec_product({}, back, {"x_aero0": own}, "rev")
        pulled.append(back["parameters"])
    np.testing.assert_allclose(pulled[2], pulled[0], rtol=0, atol=1e-13)
    parts[0].options["points"] = None
    with pytest.raises(UserError, match="distributed: give the points of each process as points"):
        parts[0].setup()


@pytest.mark.filterwarnings("ignore:.*cannot be impacted")
def test_cells_turned_inside_out_are_an_analysis_error(tmp_path: Path) -> None:
    run, mesh, path = bump(tmp_path)
    with pytest.raises(om.AnalysisError, match=r"inside out or flat.*multiply the displacements by less than 0\.\d+"):
        problem(run, mesh=path, size=3.0)
    problem(run, mesh=path, size=3.0, check_cells=False)
    np.save(tmp_path / "far.npy", mesh.points + 50.0)
    with pytest.warns(om.OpenMDAOWarning, match="within the support radius"):
        problem(run, mesh=tmp_path / "far.npy")


def test_a_design_that_leaves_a_symmetry_plane_is_refused(tmp_path: Path) -> None:
    run, _, path = bump(tmp_path, symmetry=None)
    with pytest.raises(
        UserError, match=r"a\.su2: with parameters of 1, 5 points of the design surface leave a symmetry plane"
    ):
        problem(run, mesh=path, volume="laplace", slip=["ymin"])


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    run, cloud = made(tmp_path / "run", "space"), tmp_path / "a.npy"
    np.save(cloud, np.zeros((4, 3)))
    np.savez(tmp_path / "other.npz", U=np.ones((3, 2)))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 not an archive")
    assert export.main([str(run), "--pick", "index:0", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    exported = tmp_path / "out" / "setup.npz"
    with np.load(exported) as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "ffd.npz", **{**arrays, "kernel": np.array("ffd")})
    np.savez(tmp_path / "matrix.npz", **{**arrays, "genotype": np.zeros(3)})
    cases: list[tuple[dict[str, Any], str]] = [
        ({"run": tmp_path / "nowhere"}, "nowhere: there is no such run directory"),
        ({"run": tmp_path / "nowhere.npz", "pick": None}, r"nowhere\.npz: no such file"),
        ({"pick": None}, "run: choose a setup by pick: knee, best-regularity"),
        ({"pick": "nee"}, "pick=nee: there is no such pick"),
        ({"run": exported}, r"setup\.npz holds one setup; leave pick=index:0 out"),
        (
            {"run": tmp_path / "other.npz", "pick": None},
            r"other\.npz is no setup\.npz of rbfevo\.export: it lacks cent",
        ),
        ({"run": cloud, "pick": None}, r"a\.npy is no setup\.npz of rbfevo\.export: it lacks centers, "),
        ({"run": tmp_path / "broken.npz", "pick": None}, r"broken\.npz cannot be read: damaged\?"),
        ({"run": tmp_path / "ffd.npz", "pick": None}, r"ffd\.npz: its representation, ffd, cannot be rebuilt"),
        ({"run": tmp_path / "matrix.npz", "pick": None}, "its representation, wendland, cannot be rebuilt"),
        ({"mesh": tmp_path / "no.vtp"}, r"no\.vtp: no such file"),
        ({"mesh": cloud, "points": np.zeros((4, 3))}, "mesh and points are both given: choose one"),
        ({"points": np.zeros((4, 2))}, r"points: their shape is \[4, 2\], not \[n, 3\] or \[3 n\]"),
        ({"points": np.zeros(7)}, r"points: their shape is \[7\], not \[n, 3\] or \[3 n\]"),
        ({"points": np.full((4, 3), np.nan)}, "points: 4 of 4 points have coordinates that are not finite"),
        ({"volume": "laplace"}, "volume=laplace: give the file of the volume mesh as mesh"),
        ({"volume": "laplace", "mesh": cloud}, r"a\.npy: --volume laplace needs cells that fill a volume"),
        ({"design": ["wing"]}, "design=wing is for volume=laplace"),
        ({"slip": ["wing"]}, "slip=wing is for volume=laplace"),
    ]
    for options, message in cases:
        with pytest.raises(UserError, match=message) as caught:
            problem(**{"run": run, **options})
        assert "\n" not in str(caught.value)


def test_setups_without_such_parameters_are_refused(tmp_path: Path) -> None:
    singular = a_run(tmp_path / "singular", d=3, manipulation="direct")
    with np.load(singular / "setups.npz") as archive:
        arrays = dict(archive)
    arrays["centers"][0, 1] = arrays["centers"][0, 0]
    np.savez(singular / "setups.npz", **arrays)
    with pytest.raises(UserError, match="Psi is numerically singular; choose another pick, or a run with manipulation"):
        problem(singular)
    (tmp_path / "indirect").mkdir()
    twice = a_run(tmp_path / "indirect" / "run", d=3)
    np.savez(twice / "setups.npz", **arrays)
    problem(twice)
    with pytest.raises(
        UserError, match="the columns of U depend on each other, so there are no orthonormal parameters"
    ):
        problem(twice, orthogonalized=True)
    with pytest.raises(UserError, match="center 0 lies on the symmetry plane y = 0 and cannot leave it"):
        problem(made(tmp_path / "mirrored", "mirrored")).model.g.flat(np.ones((6, 3)))


def test_without_openmdao_the_extra_is_named() -> None:
    code = "import sys; sys.modules['openmdao'] = None; import rbfevo.openmdao"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith("pip install 'rbfevo[openmdao]'")
