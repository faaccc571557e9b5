"""The engineer's mesh: what g is for targets and sensitivities, fixed vertices, symmetry, the box, and bad settings."""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
import torch
import trimesh

from rbfevo.errors import UserError
from rbfevo.methods.lloyd import lloyd
from rbfevo.scenarios import mesh
from rbfevo.scenarios.sampling import surface_sampler
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scenarios.templates import read_template

BALL = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
OFFSET = np.array([10.0, -4.0, 3.0])
X = np.asarray(BALL.vertices, np.float64) + OFFSET


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """ball.vtp with arrays; bigger.ply, a target."""
    directory = tmp_path_factory.mktemp("meshes")
    surface = pv.PolyData.from_regular_faces(X, np.asarray(BALL.faces))
    surface["scalar"] = X[:, 0] - 10.0 + 0.5
    surface["vector"] = np.stack([X[:, 1], 0 * X[:, 0], X[:, 2]], axis=1)
    surface["zero"] = np.zeros(len(X))
    surface["front"] = (X[:, 0] < 8.5).astype(np.float64)
    surface["even"] = np.stack([X[:, 0] - 10.0, X[:, 1] + 4.0, np.ones(len(X))], axis=1)
    surface["odd"] = np.stack([np.ones(len(X)), X[:, 0] - 10.0, 0 * X[:, 0]], axis=1)
    surface.save(directory / "ball.vtp")
    BALL.copy().apply_scale(1.5).apply_translation(OFFSET).export(directory / "bigger.ply")
    return directory


READ_ONCE = functools.cache(read_template)


@pytest.fixture(autouse=True)
def read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readers have tests of their own, and a VTK file costs a process each time."""
    monkeypatch.setattr(sys.modules["rbfevo.scenarios.mesh"], "read_template", READ_ONCE)


def build(folder: Path, **settings: Any) -> Scenario:
    return mesh(template=str(folder / "ball.vtp"), **settings)


def areas() -> np.ndarray:
    found = np.zeros(len(X))
    np.add.at(found, BALL.faces.reshape(-1), np.repeat(BALL.area_faces / 3.0, 3))
    return found


NORMALS = np.asarray(BALL.vertices) / 2.0


def expected(wanted: np.ndarray, weights: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(wanted / np.sqrt((weights[:, None] * wanted**2).sum()))


def test_a_target_gives_the_displacement_to_its_closest_points(folder: Path) -> None:
    scenario = build(folder, target=str(folder / "bigger.ply"))
    wanted = (scenario.gradient * scenario.gradient_norm).numpy()
    length = np.linalg.norm(wanted, axis=1)
    assert length.max() < 1.001
    assert length.min() > 0.95
    assert ((wanted / length[:, None] * NORMALS).sum(axis=1) > 0.99).all()  # facets
    assert not scenario.direction_only
    assert scenario.closest is not None
    np.testing.assert_allclose(scenario.closest(X[:5]) - X[:5], wanted[:5], atol=1e-9)
    torch.testing.assert_close(scenario.vertices, torch.from_numpy(X), rtol=0, atol=0)


@pytest.mark.parametrize("weights", ["uniform", "area"])
@pytest.mark.parametrize("kind", ["nodal", "density"])
@pytest.mark.parametrize("objective", ["minimize", "maximize"])
@pytest.mark.parametrize("array", ["scalar", "vector"])
def test_sensitivities_become_steepest_descent_in_the_inner_product(
    folder: Path, weights: str, kind: str, objective: str, array: str
) -> None:
    scenario = build(folder, sensitivity=array, sensitivity_kind=kind, objective=objective, weights=weights)
    mass = areas() / areas().mean() if weights == "area" else np.ones(len(X))
    values = (X[:, 0] - 9.5)[:, None] * NORMALS if array == "scalar" else np.stack([X[:, 1], 0 * X[:, 0], X[:, 2]], 1)
    nodal = values * (areas()[:, None] if kind == "density" else 1.0)
    sign = 1.0 if objective == "maximize" else -1.0
    torch.testing.assert_close(
        scenario.gradient,
        expected(sign * nodal / mass[:, None], mass),
        rtol=0,
        atol=2e-3 if array == "scalar" else 1e-12,
    )
    torch.testing.assert_close(scenario.weights, torch.from_numpy(mass), rtol=1e-9, atol=0)
    assert scenario.direction_only
    assert float((scenario.weights[:, None] * scenario.gradient.square()).sum()) == pytest.approx(1.0)
    # The inner product with any displacement is the change of the objective that the solver's values predict.
    move = np.random.default_rng(0).normal(size=X.shape)
    predicted = sign * (nodal * move).sum()
    inner = scenario.gradient_norm * float(
        (scenario.weights[:, None] * scenario.gradient * torch.from_numpy(move)).sum()
    )
    assert inner == pytest.approx(predicted, rel=2e-2 if array == "scalar" else 1e-9)


@pytest.mark.parametrize("exponent", [-1060, -600, 600, 1020])
def test_sensitivities_of_any_size_ask_for_the_same(exponent: int, folder: Path, tmp_path: Path) -> None:
    ordinary = build(folder, sensitivity="vector")
    values = np.ldexp(np.stack([X[:, 1], 0 * X[:, 0], X[:, 2]], 1), exponent)
    np.save(tmp_path / "s.npy", values)
    scenario = build(folder, sensitivity=str(tmp_path / "s.npy"))
    digits = 1e-3 if exponent == -1060 else 1e-15  # of the smallest numbers few digits are left
    torch.testing.assert_close(scenario.gradient, ordinary.gradient, rtol=0, atol=digits)
    if exponent in (-600, 600):
        assert scenario.gradient_norm == pytest.approx(np.ldexp(ordinary.gradient_norm, exponent), rel=1e-12)


def test_the_same_values_from_a_file(folder: Path, tmp_path: Path) -> None:
    values = X[:, 0] - 9.5
    np.save(tmp_path / "s.npy", values)
    np.savetxt(tmp_path / "s.csv", values)
    named = build(folder, sensitivity="scalar").gradient
    for name in ("s.npy", "s.csv"):
        torch.testing.assert_close(build(folder, sensitivity=str(tmp_path / name)).gradient, named, rtol=0, atol=1e-12)


def test_the_box_and_the_support_radius_follow_the_template(folder: Path) -> None:
    scenario = build(folder, sensitivity="scalar", margin=0.1, support="25%")
    diagonal = float(np.linalg.norm(np.ptp(X, axis=0)))
    np.testing.assert_allclose(scenario.lower.numpy(), X.min(axis=0) - 0.1 * diagonal)
    np.testing.assert_allclose(scenario.upper.numpy(), X.max(axis=0) + 0.1 * diagonal)
    assert scenario.support == pytest.approx(0.25 * float((scenario.upper - scenario.lower).norm()))
    assert build(folder, sensitivity="scalar", support=0.7).support == 0.7


def test_centers_are_drawn_on_the_surface(folder: Path) -> None:
    scenario = build(folder, sensitivity="scalar")
    drawn = scenario.sample(40, 30, torch.Generator().manual_seed(0)).numpy()
    radius = np.linalg.norm(drawn - OFFSET, axis=-1)
    assert radius.max() <= 2.0 + 1e-9
    assert radius.min() > 1.97
    assert np.abs((drawn - OFFSET).mean(axis=(0, 1))).max() < 0.1
    again = scenario.sample(40, 30, torch.Generator().manual_seed(0)).numpy()
    np.testing.assert_array_equal(drawn, again)


@pytest.mark.parametrize("fixed", [[None, None, None, 8.5, None, None], [[-99, -99, -99], [8.5, 99, 99]], "front"])
def test_fixed_vertices_have_no_wish(folder: Path, fixed: object) -> None:
    scenario = build(folder, sensitivity="vector", fixed=fixed)
    held = X[:, 0] <= 8.5
    assert bool((scenario.gradient[torch.from_numpy(held)] == 0).all())
    assert float(scenario.gradient.square().sum()) == pytest.approx(1.0)
    assert scenario.stays is not None
    assert scenario.stays.numpy().tolist() == held.tolist()
    assert scenario.keep_out is None
    kept = build(folder, sensitivity="vector", fixed=fixed, keep_out=True)
    centers = kept.parameterization(kept.sample(20, 10, torch.Generator().manual_seed(1)))
    if fixed == "front":
        nearest = ((centers[..., None, :] - kept.vertices) ** 2).sum(-1).argmin(-1)
        assert not held[nearest.numpy()].any()
    else:
        assert float(centers[..., 0].min()) >= 8.5


def test_symmetry_knows_what_is_out_of_reach(folder: Path) -> None:
    scenario = build(folder, sensitivity="even", symmetry="x")
    assert scenario.mirror is not None
    assert scenario.mirror.at == pytest.approx(10.0)
    assert "0.0% of |g|^2 is not symmetric" in scenario.notes["symmetry"]
    lopsided = build(folder, sensitivity="vector", symmetry="z", symmetry_at=3.0)
    assert float(lopsided.notes["symmetry"].split("; ")[1].split("%")[0]) > 30.0
    assert not scenario.warnings
    away = build(folder, sensitivity="even", symmetry="x", symmetry_at=11.0)
    assert "not symmetric" in away.warnings[0]
    half = scenario.half()
    assert bool((half.vertices[:, 0] >= 10.0 - 1e-9).all())
    assert float(scenario.search_box[0][0]) == pytest.approx(10.0)
    assert float(scenario.lower[0]) < 8.0


@pytest.mark.parametrize("at", [None, 0.0])
def test_half_a_model_is_understood(tmp_path: Path, at: float | None) -> None:
    half = pv.wrap(BALL).clip("y", origin=(0.0, 0.0, 0.0))
    half.save(tmp_path / "half.vtp")
    np.save(tmp_path / "s.npy", np.ones(half.n_points))
    scenario = mesh(
        template=str(tmp_path / "half.vtp"), sensitivity=str(tmp_path / "s.npy"), symmetry="y", symmetry_at=at
    )
    assert "one half" in scenario.notes["symmetry"]
    assert scenario.side == -1.0
    assert len(scenario.half().vertices) == half.n_points


@pytest.mark.parametrize("method", ["sample", "lloyd"])
def test_centers_kept_out_of_an_array_do_not_meet(folder: Path, method: str) -> None:
    scenario = build(folder, sensitivity="vector", fixed="front", keep_out=True)
    if method == "sample":
        centers = scenario.parameterization(scenario.sample(50, 20, torch.Generator().manual_seed(2)))
    else:
        design = scenario.half(open_only=True)
        assert bool((design.vertices[:, 0] >= 8.5).all())
        centers = scenario.parameterization(lloyd(design.vertices, 20, generator=torch.Generator().manual_seed(2)))[
            None
        ]
    apart = torch.cdist(centers, centers) + 9.0 * torch.eye(20, dtype=torch.float64)
    assert float(apart.min()) > 1e-3


def test_normals_of_an_open_surface_that_point_inwards_are_warned_about(tmp_path: Path) -> None:
    cap: Any = pv.wrap(BALL).clip("z", origin=(0.0, 0.0, 1.0)).triangulate()
    triangles = np.asarray(cap.regular_faces)
    for name, faces in (("out", triangles), ("in", triangles[:, ::-1])):
        surface = pv.PolyData.from_regular_faces(np.asarray(cap.points), faces)
        surface["s"] = np.ones(surface.n_points)
        surface.save(tmp_path / f"{name}.vtp")
        warnings = mesh(template=str(tmp_path / f"{name}.vtp"), sensitivity="s").warnings
        assert ["point inwards" in warning for warning in warnings] == ([True] if name == "in" else [])


def test_rows_for_an_stl_file_are_doubted(folder: Path, tmp_path: Path) -> None:
    BALL.export(tmp_path / "ball.stl")
    np.save(tmp_path / "s.npy", np.arange(len(X)) + 1.0)
    scenario = mesh(template=str(tmp_path / "ball.stl"), sensitivity=str(tmp_path / "s.npy"))
    assert "no order of vertices" in scenario.warnings[0]


MISTAKES: list[tuple[dict[str, Any], str]] = [
    (
        {},
        "either scenario.target=FILE or scenario.sensitivity=NAME_OR_FILE (point arrays in the template: even, front,",
    ),
    ({"target": "bigger.ply", "sensitivity": "scalar"}, "are both set"),
    ({"sensitivity": "zero"}, "zero at every vertex"),
    ({"sensitivity": "scaler"}, "scalar"),
    ({"sensitivity": "scalar", "sensitivity_kind": "cell"}, "nodal, density"),
    ({"sensitivity": "scalar", "objective": "both"}, "minimize, maximize"),
    ({"sensitivity": "scalar", "weights": "mass"}, "uniform, area"),
    ({"sensitivity": "scalar", "margin": -0.1}, "scenario.margin=-0.1"),
    ({"sensitivity": "scalar", "margin": float("nan")}, "scenario.margin=nan"),
    ({"sensitivity": "scalar", "reject": "some"}, "boundary, none"),
    ({"sensitivity": "scalar", "support": "0%"}, "scenario.support=0%"),
    ({"sensitivity": "scalar", "up": "w"}, "scenario.up=w"),
    ({"sensitivity": "scalar", "search_vertices": 3}, "at least 100"),
    ({"sensitivity": "scalar", "symmetry": "w"}, "choose x, y or z"),
    ({"sensitivity": "scalar", "symmetry": "x", "symmetry_at": 99.0}, "does not cross the box"),
    ({"sensitivity": "scalar", "symmetry_at": 1.0}, "needs scenario.symmetry"),
    ({"sensitivity": "scalar", "keep_out": True}, "needs scenario.fixed"),
    ({"sensitivity": "scalar", "fixed": "nope"}, "scenario.fixed=nope"),
    ({"sensitivity": "scalar", "fixed": "zero"}, "fixes no vertex"),
    ({"sensitivity": "scalar", "fixed": [0, 0, 0]}, "a box is six numbers"),
    ({"sensitivity": "scalar", "fixed": [1, 0, 0, 0, 1, 1]}, "lies above"),
    ({"sensitivity": "scalar", "fixed": [0, 0, 0, 1, 1, 1]}, "fixes no vertex (the template spans 8 to 12"),
    ({"sensitivity": "scalar", "fixed": [None] * 6}, "fixes every vertex"),
    ({"target": "bigger.ply", "target_scale": -1.0}, "scenario.target_scale=-1.0"),
    ({"target": "bigger.ply", "objective": "maximize"}, "belong to a sensitivity"),
    ({"sensitivity": "odd", "symmetry": "x"}, "antisymmetric"),
    ({"target": "ball.vtp", "reject": "none"}, "no vertex is left that should move"),
]


@pytest.mark.parametrize(("settings", "said"), MISTAKES, ids=[said for _, said in MISTAKES])
def test_mistakes_are_said_in_one_line(
    folder: Path, settings: dict[str, Any], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(UserError) as caught:
        mesh(template=str(folder / "ball.vtp"), **settings)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_mixed_units_are_asked_about(folder: Path, tmp_path: Path) -> None:
    BALL.copy().apply_scale(1.5).apply_translation(OFFSET).apply_scale(1000.0).export(tmp_path / "mm.stl")
    with pytest.raises(UserError, match=r"are their units different.*scenario\.target_scale=0\.001"):
        build(folder, target=str(tmp_path / "mm.stl"))
    scaled = build(folder, target=str(tmp_path / "mm.stl"), target_scale=0.001)
    plain = build(folder, target=str(folder / "bigger.ply"))
    torch.testing.assert_close(scaled.gradient, plain.gradient, rtol=0, atol=1e-2)  # STL is float32


def test_no_template() -> None:
    with pytest.raises(UserError, match=r"needs scenario\.template=FILE"):
        mesh(sensitivity="a")


def test_centers_on_one_triangle_are_uniform_in_it() -> None:
    corners = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 3.0, 1.0]], dtype=torch.float64)
    drawn = surface_sampler(corners, torch.tensor([[0, 1, 2]]))(40, 500, torch.Generator().manual_seed(0)).reshape(
        -1, 3
    )
    # Shares of the corners: each is 1/3 in the mean, with mean square 1/6, and mean product 1/12.
    shares = torch.linalg.lstsq(torch.cat((corners[1:] - corners[0],)).T, (drawn - corners[0]).T).solution.T
    shares = torch.cat((1.0 - shares.sum(1, keepdim=True), shares), dim=1)
    assert float(shares.min()) > -1e-12
    torch.testing.assert_close(shares.mean(0), torch.full((3,), 1 / 3, dtype=torch.float64), rtol=0, atol=0.01)
    products = shares.T @ shares / len(shares)
    wanted = torch.full((3, 3), 1 / 12, dtype=torch.float64) + torch.eye(3, dtype=torch.float64) / 12
    torch.testing.assert_close(products, wanted, rtol=0, atol=0.01)


def test_triangles_are_drawn_by_their_area() -> None:
    corners = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [8, 0, 0], [5, 1, 0]], dtype=torch.float64)
    drawn = surface_sampler(corners, torch.tensor([[0, 1, 2], [3, 4, 5]]))(1, 20_000, torch.Generator().manual_seed(0))
    assert float((drawn[0, :, 0] > 3).double().mean()) == pytest.approx(0.75, abs=0.01)


@pytest.mark.parametrize("mark", [1.0, -1.0, 1e-300])
def test_any_value_but_zero_marks_a_vertex_as_fixed(mark: float, folder: Path, tmp_path: Path) -> None:
    front = X[:, 0] < 8.5
    np.save(tmp_path / "marks.npy", np.where(front, mark, 0.0))
    scenario = build(folder, sensitivity="vector", fixed=str(tmp_path / "marks.npy"))
    assert bool((scenario.gradient[torch.from_numpy(front)] == 0).all())
    assert int((scenario.gradient != 0).any(1).sum()) > 0.9 * int((~front).sum())


def test_a_flat_template_is_told_what_values_can_do(tmp_path: Path) -> None:
    sheet = pv.Plane(i_size=2.0, j_size=1.0, i_resolution=8, j_resolution=6).rotate_x(30.0).translate((3.0, 0, 5))
    sheet.point_data["lift"] = np.arange(float(sheet.n_points))
    sheet.points = sheet.points.astype(np.float64)
    sheet.save(tmp_path / "flat.vtp")
    made = mesh(template=str(tmp_path / "flat.vtp"), sensitivity="lift")
    assert made.notes["flat"].startswith("all vertices lie in one plane")
    sheet.points[0] += [0.0, 0.0, 1e-3]
    sheet.save(tmp_path / "bent.vtp")
    assert "flat" not in mesh(template=str(tmp_path / "bent.vtp"), sensitivity="lift").notes


def test_values_of_another_mesh_must_be_per_area(folder: Path, tmp_path: Path) -> None:
    """And patches and cell arrays reach the scenario by its settings."""
    sheet = pv.Plane(i_resolution=4, j_resolution=4)
    sheet.cell_data["force"] = np.ones(sheet.n_cells)
    sheet.save(tmp_path / "a.vtp")
    places = pv.Plane(i_resolution=9, j_resolution=9).points
    rows = np.column_stack([places, 1.0 + places[:, 0]])
    np.savetxt(tmp_path / "fine.csv", rows, delimiter=",", header="x,y,z,sens", comments="")
    settings: dict[str, Any] = {"template": str(tmp_path / "a.vtp"), "sensitivity": str(tmp_path / "fine.csv")}
    with pytest.raises(UserError, match="sensitivity_match=nearest or interpolate"):
        mesh(**settings)
    with pytest.raises(UserError, match="integrated values depend on the cells of their own mesh"):
        mesh(**settings, sensitivity_match="interpolate")
    made = mesh(**settings, sensitivity_match="interpolate", sensitivity_kind="density", weights="area")
    assert "interpolated between 8 nearest rows: largest distance" in made.notes["sensitivity rows"]
    vertices = made.vertices[:, 0]
    ratio = made.gradient[:, 2] / (1.0 + vertices)
    assert torch.allclose(ratio, ratio[:1].expand_as(ratio), rtol=2e-2)
    by_cell = mesh(template=str(tmp_path / "a.vtp"), sensitivity="force")
    corner, middle = float(by_cell.gradient[0].norm()), float(by_cell.gradient[12].norm())
    assert middle == pytest.approx(4.0 * corner, rel=0.5)
    assert by_cell.notes["sensitivity rows"].startswith("cell array force, integrated over each cell")
    with pytest.raises(UserError, match="choose one of exact, nearest, interpolate"):
        mesh(**settings, sensitivity_match="near")
    with pytest.raises(UserError, match="the file names no patches"):
        mesh(template=str(tmp_path / "a.vtp"), sensitivity="force", patches="wing")
