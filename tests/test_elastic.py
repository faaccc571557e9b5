"""The elastic bracket: its solver against scikit-fem and finite differences, and the chain from mesh to optimum."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
from called import Called, command

from rbfevo import meshes
from rbfevo.geometry.topology import vertex_areas
from rbfevo.recorded.record import read

skfem: Any = pytest.importorskip("skfem", reason="scikit-fem is not installed (extra elastic)")
pytest.importorskip("openmdao.api", reason="OpenMDAO is not installed (extra openmdao)")

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "elastic"
CELLS = (12, 3, 2)
SHORT = ("method.starts=16", "method.population=16", "method.generations=5", "method.polish=3", "method.front=8",
         "figures=false", "evaluator=eager")  # fmt: skip


def module(name: str) -> Any:
    """A module of the example."""
    sys.path.insert(0, str(EXAMPLE))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(EXAMPLE))


@pytest.fixture(scope="module")
def case() -> Any:
    return module("bracket").bracket((4, 2, 1))


def bent(case: Any) -> Any:
    """The nodes of a shape without symmetries: all of them moved, those of the ends too."""
    return case.points + 1.5 * np.random.default_rng(4).uniform(-1, 1, case.points.shape)


def test_the_solution_is_that_of_a_form_assembled_by_scikit_fem(case: Any) -> None:
    points = bent(case)
    solution, (first, second) = case.body.solve(points), case.body.moduli
    mesh = skfem.MeshHex(points.T.copy(), case.body.corners.T.copy())
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHexS2()), intorder=4)
    facets = [i for i in mesh.boundary_facets() if case.body.loaded[mesh.facets[:, i]].all()]
    face = skfem.FacetBasis(mesh, skfem.ElementVector(skfem.ElementHexS2()), facets=np.array(facets), intorder=4)

    @skfem.LinearForm
    def load(v: Any, w: Any) -> Any:
        return sum(t * part for t, part in zip(case.body.traction, v, strict=True))

    from skfem.helpers import ddot, eye, sym_grad, trace
    from skfem.models.elasticity import linear_elasticity

    stiffness, force = linear_elasticity(first, second).assemble(basis), load.assemble(face)
    x, y, z = case.points.T
    clamped = np.isclose(x, 0.0)
    middle = np.isclose(z, 0.0)
    still = [basis.nodal_dofs[:, clamped].ravel(), basis.nodal_dofs[2, middle]]
    ends = mesh.edges
    still += [basis.edge_dofs[:, clamped[ends].all(axis=0)].ravel(), basis.edge_dofs[2, middle[ends].all(axis=0)]]
    u = skfem.solve(*skfem.condense(stiffness, force, D=np.unique(np.concatenate(still))))
    assert solution.compliance == pytest.approx(float(force @ u), rel=1e-10)
    np.testing.assert_allclose(solution.displacement, u[basis.nodal_dofs].T, atol=1e-10 * np.abs(u).max())
    assert (y[case.body.loaded] == 0).all()

    @skfem.Functional
    def stress(w: Any) -> Any:
        strain = sym_grad(w["u"])
        s = first * eye(trace(strain), 3) + 2 * second * strain
        s = s - eye(trace(s), 3) / 3
        return np.sqrt(1.5 * ddot(s, s))

    volumes = skfem.Functional(lambda w: 1.0 + 0.0 * w.x[0]).elemental(basis)
    np.testing.assert_allclose(solution.stress, stress.elemental(basis, u=basis.interpolate(u)) / volumes, rtol=1e-9)
    assert solution.volume == pytest.approx(volumes.sum(), rel=1e-12)


def test_derivatives_by_all_kinds_of_nodes_are_those_of_finite_differences(case: Any) -> None:
    points, body = bent(case), case.body
    solution, rng = body.solve(points), np.random.default_rng(0)
    corner = int(np.flatnonzero(body.loaded & case.design)[0])
    inside = int(np.flatnonzero(~case.design & ~body.loaded & ~body.supports.any(axis=1)).tolist()[0]) if (
        ~case.design & ~body.loaded & ~body.supports.any(axis=1)).any() else corner  # fmt: skip
    chosen = {
        corner,
        inside,
        int(np.flatnonzero(body.supports[:, 0])[1]),
        int(np.flatnonzero(case.design & ~case.held)[3]),
    }
    for step in (*[(node, None) for node in chosen], (None, rng.normal(size=points.shape))):
        node, along = step
        if along is None:
            along = np.zeros(points.shape)
            along[node] = rng.normal(size=3)
        h = 1e-3
        up, down = (body.solve(points + sign * h * along) for sign in (1, -1))
        for name in ("compliance", "volume"):
            found = float((getattr(solution, f"{name}_gradient") * along).sum())
            difference = (getattr(up, name) - getattr(down, name)) / (2 * h)
            scale = float(np.abs(getattr(solution, f"{name}_gradient") * along).sum())
            assert abs(found - difference) < 1e-6 * scale, (node, name)


def test_a_straight_bar_is_as_stiff_as_beam_theory_says() -> None:
    """J = F delta, delta = F L^3 / 3 E I + 6 F L / 5 G A of a slender bar under a shear force."""
    bracket, elasticity = module("bracket"), module("elasticity")
    mesh = skfem.MeshHex.init_tensor(np.linspace(0, 200, 21), np.linspace(0, 10, 3), np.linspace(0, 10, 3))
    x, E, area = mesh.p[0], bracket.YOUNG, 100.0
    supports = np.repeat((x == 0)[:, None], 3, axis=1)
    body = elasticity.Body(mesh.t.T, E, 0.0, np.array([0.0, -1.0, 0.0]), supports, x == 200)
    force = area
    deflection = force * 200**3 / (3 * E * 10**4 / 12) + 6 / 5 * force * 200 / (E / 2 * area)
    assert body.solve(mesh.p.T).compliance == pytest.approx(force * deflection, rel=2e-3)


def test_cells_inside_out_are_refused(case: Any) -> None:
    points = case.points.copy()
    points[case.design & ~case.held] = case.points[case.design & ~case.held][::-1]
    with pytest.raises(module("elasticity").ShapeError, match=r"\d+ of 8 cells are turned inside out"):
        case.body.solve(points)


def test_the_sensitivity_changes_no_volume_where_it_is_uniform(case: Any) -> None:
    """dJ - c dV with c the mean of dJ/dV by areas: growing by the same thickness everywhere changes it by nothing."""
    solution = case.body.solve(case.points)
    found, factor = module("bracket").sensitivity(case, solution)
    free = case.design & ~case.held
    normal = solution.volume_gradient[free] / np.linalg.norm(solution.volume_gradient[free], axis=1)[:, None]
    assert abs((found[free] * normal).sum()) < 1e-12 * np.abs(found[free]).sum()
    np.testing.assert_allclose(found, solution.compliance_gradient - factor * solution.volume_gradient)
    assert factor < 0  # more material is stiffer


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The example on a coarse mesh, with a short search, in this process and so the commands of rbfevo that it runs."""
    out, optimize = tmp_path_factory.mktemp("elastic") / "out", module("optimize")

    def here(words: list[str], check: bool) -> Called:
        assert words[:2] == [sys.executable, "-m"]
        found = command(*words[2:])
        print(found.stdout)
        assert found.returncode == 0, found.stderr
        return found

    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(optimize.subprocess, "run", here)
        patch.syspath_prepend(str(EXAMPLE))
        assert optimize.main([str(out), *SHORT, "--cells", *map(str, CELLS)]) == 0
    return out, printed.getvalue()


def ended(*arguments: str, code: int = 0) -> str:
    command = [sys.executable, "examples/elastic/optimize.py", *arguments]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": path}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == code, f"{done.stdout}\n{done.stderr}"
    return done.stdout if code == 0 else done.stderr


def test_the_chain_from_mesh_to_optimum(done: tuple[Path, str]) -> None:
    out, printed = done
    bracket = module("bracket")
    case = bracket.bracket(CELLS)
    with meshes.opened(out / "bracket.vtu") as first, meshes.opened(out / "optimized.vtu") as last:
        np.testing.assert_array_equal(first.points, case.points)
        before, after = case.body.solve(first.points), case.body.solve(last.points)
        moved = last.points - first.points
    assert after.compliance < 0.75 * before.compliance
    assert after.volume < before.volume * (1 + 1e-4)
    assert after.stress.max() < before.stress.max()
    rows = [[float(number) for number in re.findall(r"[\d.]+", line)] for line in printed.splitlines() if "| " in line]
    (one, two) = [row for row in rows if len(row) == 3][:2]
    assert one == pytest.approx([before.compliance, before.volume, before.stress.max()], rel=1e-2)
    assert two == pytest.approx([after.compliance, after.volume, after.stress.max()], rel=1e-2)
    assert two[0] == pytest.approx(after.compliance, abs=0.006)
    # The clamped and the loaded faces stay to the bit, and the plane of symmetry stays one.
    ends = case.body.supports[:, 0] | case.body.loaded
    assert (moved[ends] == 0.0).all()
    assert (moved[case.points[:, 2] == 0.0, 2] == 0.0).all()
    assert np.abs(moved[case.design & ~case.held]).max() > 3.0
    # It is an optimum within reach: what is left of the gradient is that of the volume, or points out of the bounds.
    count = int(re.findall(r"(\d+) solutions with their gradients", printed)[0])
    assert 5 < count < 40
    assert printed.count("solution ") >= count
    assert "SLSQP: Optimization terminated successfully" in printed


def test_the_parameters_are_those_of_an_optimum(done: tuple[Path, str]) -> None:
    """Karush-Kuhn-Tucker: dJ/dp = mu dV/dp - (at bounds: pointing outwards), by the U of an export of its own."""
    out, _ = done
    from rbfevo.openmdao import Deformation

    bracket = module("bracket")
    import openmdao.api as om

    case = bracket.bracket(CELLS)
    problem: Any = om.Problem(reports=False)
    geometry = Deformation(run=out / "run", pick="potential:0.95", mesh=out / "bracket.vtu", volume="laplace")
    problem.model.add_subsystem("g", geometry, promotes=["*"])
    problem.setup()
    parameters = geometry.flat(np.load(out / "displacements.npy"))
    problem.set_val("parameters", parameters)
    problem.run_model()
    points = problem.get_val("x_aero0").reshape(-1, 3)
    with meshes.opened(out / "optimized.vtu") as last:
        np.testing.assert_allclose(points, last.points, rtol=0, atol=1e-10)
    solution = case.body.solve(points)
    dJ, dV = (
        geometry.displacement.transposed(part) for part in (solution.compliance_gradient, solution.volume_gradient)
    )
    bound = module("optimize").BOUND
    inside = np.abs(parameters) < bound * (1 - 1e-6)
    assert inside.sum() >= 3
    factor = float(dJ[inside] @ dV[inside] / (dV[inside] @ dV[inside]))
    left = dJ - factor * dV
    assert factor < 0
    assert bound * np.abs(left[inside]).max() < 0.03 * solution.compliance
    assert (left[~inside] * np.sign(parameters[~inside]) < 0.01 * solution.compliance / bound).all()


def test_the_run_saw_the_design_surface_and_its_sensitivity(done: tuple[Path, str]) -> None:
    out, _ = done
    record, case = read(out / "run"), module("bracket").bracket(CELLS)
    assert len(record.vertices) == case.design.sum()
    assert record.held is not None
    assert len(record.held) == case.held.sum()
    solution = case.body.solve(case.points)
    wanted = -module("bracket").sensitivity(case, solution)[0]
    order = {tuple(point): row for row, point in enumerate(case.points.tolist())}
    rows = [order[tuple(point)] for point in record.vertices.tolist()]
    raw = record.gradient if record.gradient_raw is None else record.gradient_raw
    free = ~case.held[rows]
    expected = wanted[rows][free]
    # The run makes displacements of forces by dividing by areas where it smooths, so directions agree.
    along = (raw[free] * expected).sum(axis=1)
    norms = np.linalg.norm(raw[free], axis=1) * np.linalg.norm(expected, axis=1)
    np.testing.assert_allclose(along[norms > 0], norms[norms > 0], rtol=1e-9)
    surface = pyvista.read(out / "design.vtp")
    triangles = np.asarray(surface.triangulate().regular_faces)  # pyright: ignore[reportAttributeAccessIssue]
    area = vertex_areas(np.asarray(surface.points), triangles).sum()
    assert area == pytest.approx(np.pi / 2 * (60 + 100) * 20 + np.pi / 4 * (100**2 - 60**2), rel=0.01)


def test_mistakes_end_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("mine")
    line = ended(str(tmp_path), code=2)
    assert line.startswith("optimize.py: ")
    assert "exists already" in line
    assert len(line.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]


@pytest.mark.parametrize(("missing", "named"), [("skfem", "scikit-fem"), ("openmdao", "openmdao")])
def test_without_its_libraries_the_extra_is_named(missing: str, named: str, tmp_path: Path) -> None:
    code = f"import sys, runpy; sys.modules['{missing}'] = None; sys.argv = ['optimize.py', '{tmp_path / 'out'}']; "
    code += f"sys.path.insert(0, '{EXAMPLE}'); runpy.run_path('{EXAMPLE / 'optimize.py'}', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"optimize.py: {named} is not installed: pip install 'rbfevo[elastic]'\n"
    assert list(tmp_path.iterdir()) == []
