"""Held regions: the blend, scores and gradients under it, and runs, exports and deformed meshes that keep it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
import torch
import trimesh
from designs import DESIGNS, KERNELS, PAIRS, numpy_phi
from scipy.spatial.distance import cdist
from test_mesh_runs import METHODS

from rbfevo import apply, export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.fit.manipulations import deformation
from rbfevo.geometry.holding import Hold
from rbfevo.geometry.mirror import Mirror
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup
from rbfevo.scenarios import mesh
from rbfevo.scenarios.coarse import coarsened
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.gradients import differentiable_scores
from rbfevo.scoring.kernels import Wendland
from rbfevo.scoring.symmetric import MirroredEvaluator, evaluator_of

SUPPORT = 1.5
BUSY = ("scenario.hold=[-1.2,null,null,0.3,null,null]", "scenario.hold_width=1.0")  # where most wants to move


def smooth_step(distance: np.ndarray, width: float) -> np.ndarray:
    """The quintic step, written anew."""
    t = np.clip(distance / width, 0.0, 1.0)
    return 10 * t**3 - 15 * t**4 + 6 * t**5


# --- the blend -------------------------------------------------------------------------------------------------------


def test_the_blend_is_a_smooth_step_of_the_distance_to_the_nearest_held_point() -> None:
    rng = np.random.default_rng(0)
    held, points = rng.normal(size=(30, 3)), rng.normal(size=(200, 3))
    blend = Hold(held, 0.8)(points)
    np.testing.assert_allclose(blend, smooth_step(cdist(points, held).min(axis=1), 0.8), rtol=1e-12)
    assert (Hold(held, 0.8)(held) == 0.0).all()
    along = np.array([[0.0, 0.0, 0.0]])
    line = np.linspace(0.0, 1.5, 7)[:, None] * [1.0, 0.0, 0.0]
    np.testing.assert_allclose(Hold(along, 1.0)(line), smooth_step(line[:, 0], 1.0), rtol=1e-13)
    assert (Hold(along, 1.0)(line)[4:] == 1.0).all()
    h = 1e-4
    ends = np.array([[h, 0, 0], [1 - h, 0, 0], [0.5, 0, 0]])
    np.testing.assert_allclose(Hold(along, 1.0)(ends), [10 * h**3, 1 - 10 * h**3, 0.5], rtol=1e-3)


def test_with_a_mirror_the_images_of_held_points_are_held_too() -> None:
    held, points = np.array([[0.3, 0.5, 0.0]]), np.array([[0.3, -0.5, 0.0], [0.3, -0.2, 0.1]])
    mirrored = Hold(held, 1.0, Mirror(1, 0.0))
    assert mirrored(points)[0] == 0.0
    np.testing.assert_allclose(mirrored(points), mirrored(points * [1, -1, 1]), rtol=1e-14)
    assert Hold(held, 1.0)(points)[0] == 1.0


# --- scores and gradients --------------------------------------------------------------------------------------------


def held_design(name: str) -> tuple[Any, torch.Tensor]:
    """A small design, weighted, with a blend that is 0 at a tenth of the vertices, where g is 0 too."""
    design = DESIGNS[name](12, 9, weighted=True) if name == "plane" else DESIGNS[name](2, weighted=True)
    X = design.vertices.numpy()
    blend = Hold(X[X[:, 0] < np.quantile(X[:, 0], 0.1)], 0.5)(X)
    g = design.gradient * torch.from_numpy(blend > 0)[:, None]
    g = g / (design.weights[:, None] * g.square()).sum().sqrt()
    return type(design)(design.vertices, g, design.weights), torch.from_numpy(blend)


@pytest.mark.parametrize("backend", ["fused", "eager"])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_scores_are_numpys_with_rows_of_u_times_the_blend(
    design: str, kernel: str, manipulation: str, backend: str
) -> None:
    held, blend = held_design(design)
    phi = KERNELS[design][kernel]
    evaluate = Evaluator(held.vertices, held.gradient, phi, manipulation, held.weights, backend, 40, blend)
    centers = held.centers(3, 5)
    centers = torch.cat((centers, centers[:1]))
    centers[-1, 1] = centers[-1, 0] + 1e-6  # needs the second pass
    scores, exact = evaluate(centers), evaluate.definition(centers)
    assert evaluate.further_passes > 0
    roots = np.sqrt(held.weights.numpy())[:, None]
    for i, C in enumerate(centers.numpy()):
        U = blend.numpy()[:, None] * numpy_phi(phi, cdist(held.vertices.numpy(), C))
        reached, _, _ = np.linalg.svd(roots * U, full_matrices=False)
        wanted = roots * held.gradient.numpy()
        P = 1 - np.square(wanted - reached @ (reached.T @ wanted)).sum()
        if manipulation == "direct":
            U = np.linalg.solve(numpy_phi(phi, cdist(C, C)).T, U.T).T
        sigma = np.linalg.svd(roots * U, compute_uv=False)
        R = sigma[-1] / sigma[0]
        for found in (scores, exact):
            assert float(found.regularity[i]) == pytest.approx(R, rel=1e-5 if i == 3 else 1e-8)
            assert float(found.improvement_potential[i]) == pytest.approx(P, abs=1e-8)


@pytest.mark.parametrize("backend", ["fused", "eager"])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("design", "kernel"), PAIRS)
def test_gradients_under_a_blend_pass_gradcheck(design: str, kernel: str, manipulation: str, backend: str) -> None:
    held, blend = held_design(design)
    evaluate = Evaluator(
        held.vertices, held.gradient, KERNELS[design][kernel], manipulation, held.weights, backend, 40, blend
    )
    generator = torch.Generator().manual_seed(3)
    picked = torch.randperm(len(blend), generator=generator)[:10]
    noise = torch.randn(2, 5, held.vertices.shape[1], generator=generator, dtype=torch.float64)
    centers = (held.vertices[picked].reshape(2, 5, -1) + 0.03 * noise).requires_grad_()
    assert torch.autograd.gradcheck(lambda c: differentiable_scores(evaluate, c), centers, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_symmetric_scores_and_gradients_know_the_blend(manipulation: str) -> None:
    held, _ = held_design("sphere")
    X = held.vertices.numpy()
    mirror = Mirror.of_box(1, 0.0, np.full(3, -1.0), np.ones(3))
    blend = torch.from_numpy(Hold(X[X[:, 0] > 0.9], 0.6, mirror)(X))
    design = (held.vertices, held.gradient, KERNELS["sphere"]["wendland 1"], manipulation, held.weights)
    fast = MirroredEvaluator(*design, "fused", 40, blend, mirror=mirror)
    eager = MirroredEvaluator(*design, "eager", 40, blend, mirror=mirror)
    free = MirroredEvaluator(*design, "eager", 40, mirror=mirror)
    centers = held.centers(3, 4).abs()
    scores = fast.definition(centers)
    assert not torch.allclose(free(centers).regularity, scores.regularity, rtol=1e-3)
    for evaluate in (fast, eager):
        found = evaluate(centers)
        torch.testing.assert_close(found.regularity, scores.regularity, rtol=1e-7, atol=0)
        torch.testing.assert_close(found.improvement_potential, scores.improvement_potential, rtol=0, atol=1e-9)
        leaf = centers[:1].clone().requires_grad_()
        assert torch.autograd.gradcheck(lambda c, e=evaluate: differentiable_scores(e, c), leaf, eps=1e-6, atol=1e-6)


# --- scenarios -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def egg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An egg with a sensitivity of three values a vertex, and an array that marks its blunt end."""
    folder = tmp_path_factory.mktemp("egg")
    ball = trimesh.creation.icosphere(subdivisions=3)
    x = np.asarray(ball.vertices) * [2.0, 1.0, 0.8]
    x[np.abs(x) < 1e-12] = 0.0
    surface = pyvista.PolyData.from_regular_faces(x, ball.faces)
    surface.point_data["sensitivity"] = np.stack([np.exp(-((x[:, 0] + 1.0) ** 2)), x[:, 1], x[:, 2] ** 2], axis=1)
    surface.point_data["end"] = (x[:, 0] < -1.6).astype(np.int64)
    surface.save(folder / "egg.vtp")
    return folder / "egg.vtp"


def held_scenario(egg: Path, **settings: Any) -> Any:
    return mesh(template=str(egg), sensitivity="sensitivity", **settings)


def test_held_vertices_are_left_out_of_g_and_kept_free_of_centers(egg: Path) -> None:
    scenario = held_scenario(egg, hold="end", hold_width=0.7)
    X = scenario.vertices.numpy()
    held = X[:, 0] < -1.6
    expected = smooth_step(cdist(X, X[held]).min(axis=1), 0.7)
    np.testing.assert_allclose(scenario.blend.numpy(), expected, atol=1e-15)
    assert (scenario.blend.numpy() == 0)[held].all()
    assert (scenario.gradient.numpy()[held] == 0).all()
    assert scenario.gradient.square().sum() == pytest.approx(1.0)
    free = held_scenario(egg)
    between = ~held & (expected < 1)
    ratio = scenario.gradient[between] / free.gradient[between]  # g keeps its size beside what is held
    np.testing.assert_allclose(ratio.numpy()[np.isfinite(ratio.numpy())], float(ratio[0, 0]), rtol=1e-9)
    assert scenario.stays.numpy().tolist() == held.tolist()
    assert scenario.notes["hold"].startswith(f"{held.sum()} of {len(X)} vertices cannot move, {between.sum()} within")
    assert scenario.keep_out is not None
    assert scenario.keep_out.contains(torch.tensor([[-1.9, 0.0, 0.0], [0.0, 0.0, 0.0]])).tolist() == [True, False]
    assert held_scenario(egg, hold="end", keep_out=False).keep_out is None
    diagonal = float((scenario.upper - scenario.lower).norm())
    assert held_scenario(egg, hold="end", hold_width="10%").hold.width == pytest.approx(0.1 * diagonal)
    assert held_scenario(egg, hold="end").hold.width == pytest.approx(0.05 * diagonal)


def test_fixed_stays_soft_and_needs_keep_out_to_keep_centers_away(egg: Path) -> None:
    scenario = held_scenario(egg, fixed="end")
    assert scenario.blend is None
    assert scenario.keep_out is None
    both = held_scenario(egg, fixed="end", hold=[1.5, None, None, None, None, None])
    assert both.keep_out.contains(torch.tensor([[-1.9, 0, 0], [1.9, 0, 0]], dtype=torch.float64)).tolist() == [
        False,
        True,
    ]
    out = held_scenario(egg, fixed="end", hold=[1.5, None, None, None, None, None], keep_out=True)
    assert out.keep_out.contains(torch.tensor([[-1.9, 0, 0], [1.9, 0, 0]], dtype=torch.float64)).tolist() == [
        True,
        True,
    ]
    assert both.stays.sum() == out.stays.sum() > held_scenario(egg, fixed="end").stays.sum()


def test_patches_are_held_whether_they_belong_to_the_template_or_not(tmp_path: Path) -> None:
    text = "NDIME= 3\nNELEM= 0\nNPOIN= 8\n"
    points = [(x, y, 0.0) for x in (0, 1, 2, 3) for y in (0, 1)]
    text += "".join(f"{x} {y} {z}\n" for x, y, z in points)
    text += "NMARK= 3\n"
    quads = {"bend": (2, 4, 5, 3), "inlet": (0, 2, 3, 1), "outlet": (4, 6, 7, 5)}
    for name, corners in quads.items():
        text += f"MARKER_TAG= {name}\nMARKER_ELEMS= 1\n9 {' '.join(map(str, corners))}\n"
    (tmp_path / "duct.su2").write_text(text)
    np.save(tmp_path / "s.npy", np.arange(24.0).reshape(8, 3))
    common: dict[str, Any] = {"template": str(tmp_path / "duct.su2"), "sensitivity": str(tmp_path / "s.npy")}
    scenario = mesh(**common, patches=["bend", "outlet"], hold=["inlet"], hold_width=1.5)
    assert scenario.hold is not None
    assert scenario.hold.points.tolist() == [[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]]
    assert scenario.blend is not None
    np.testing.assert_allclose(scenario.blend.numpy(), smooth_step(scenario.vertices.numpy()[:, 0] - 1, 1.5))
    apart = mesh(**common, patches="outlet", hold="inlet", hold_width=1.5)
    assert apart.stays is not None
    assert not apart.stays.any()  # the nearest vertices are 1 away
    assert apart.blend is not None
    np.testing.assert_allclose(apart.blend.numpy(), smooth_step(apart.vertices.numpy()[:, 0] - 1, 1.5))
    with pytest.raises(UserError, match=r"scenario\.hold=walls: there is no such patch.*bend, inlet, outlet"):
        mesh(**common, patches=["bend"], hold=["walls"])
    with pytest.raises(UserError, match=r"no such array.*; its patches are bend, inlet, outlet"):
        mesh(**common, patches=["bend"], hold="walls")
    with pytest.raises(UserError, match=r"every vertex is farther than scenario\.hold_width=0\.5 from it"):
        mesh(**common, patches=["outlet"], hold=["inlet"], hold_width=0.5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hold": [9, 9, 9, 10, 10, 10]}, "scenario.hold=.*this holds no vertex"),
        ({"hold": [None] * 6}, "scenario.hold=.*this holds every vertex"),
        ({"hold": [1, 2, 3]}, "scenario.hold=.*a box is six numbers.*or a patch"),
        ({"hold": "nowhere"}, "scenario.hold=nowhere"),
        ({"hold": "end", "hold_width": 0}, "scenario.hold_width=0: "),
        ({"hold": "end", "hold_width": "wide"}, "scenario.hold_width=wide: "),
        ({"hold": "end", "fixed": [-1.6, None, None, None, None, None]}, "every vertex, so nothing can move"),
        ({"keep_out": True}, "needs scenario.fixed or scenario.hold"),
    ],
)
def test_mistakes_are_one_line(egg: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        held_scenario(egg, **settings)


def test_a_coarse_design_keeps_the_sums_of_columns_that_hardly_change_over_a_cell(egg: Path) -> None:
    scenario = held_scenario(egg, hold="end", hold_width=1.0, weights="area")
    fewer = coarsened(scenario, 60)
    assert len(fewer.vertices) <= 60
    assert fewer.blend is not None
    for s in (scenario, fewer):
        assert s.blend is not None
    w, b, g = scenario.weights, scenario.blend, scenario.gradient
    W, B, G = fewer.weights, fewer.blend, fewer.gradient
    assert float((W * B.square()).sum()) == pytest.approx(float((w * b.square()).sum()), rel=1e-12)
    torch.testing.assert_close((W * B) @ G, (w * b) @ g, rtol=1e-12, atol=1e-12)
    assert ((B >= 0) & (B <= 1)).all()


# --- runs ------------------------------------------------------------------------------------------------------------


def a_run(egg: Path, out: Path, *overrides: str) -> Path:
    settings = ["scenario=mesh", f"scenario.template={egg}", "scenario.sensitivity=sensitivity", "scenario.hold=end"]
    settings += [f"kernel.support={SUPPORT}", "scenario.hold_width=0.8", "centers=5", "figures=false", "quiet=true"]
    assert main([f"hydra.run.dir={out}", *settings, *overrides]) == 0
    return out


def plain_scores(run: Path, row: int) -> tuple[float, float]:
    """R and P of a setup from the run's own files, with plain NumPy."""
    summary = json.loads((run / "summary.json").read_text())
    with np.load(run / "setups.npz") as setups, np.load(run / "scenario.npz") as files:
        C, X, g, roots = (
            setups["centers"][row],
            files["vertices"],
            files["gradient"],
            np.sqrt(files["weights"])[:, None],
        )
        blend = files["blend"][:, None]
    groups = [(0, list(range(3)), C)]
    if summary["symmetry"]:
        groups = [(1, [0, 2], C), (-1, [1], C[C[:, 1] != 0])]

    def phi(a: np.ndarray, b: np.ndarray, sign: int) -> np.ndarray:
        def kernel(r: np.ndarray) -> np.ndarray:
            return np.where(r < SUPPORT, (1 - r / SUPPORT) ** 4 * (4 * r / SUPPORT + 1), 0.0)

        return kernel(cdist(a, b)) + sign * kernel(cdist(a, b * [1, -1, 1]))

    residual, sigmas = 0.0, []
    for sign, components, some in groups:
        U = roots * blend * phi(X, some, sign)
        left, sigma, _ = np.linalg.svd(U, full_matrices=False)
        left = left[:, sigma > len(X) * np.finfo(float).eps * sigma[0]]
        wanted = roots * g[:, components]
        residual += float(np.square(wanted - left @ (left.T @ wanted)).sum())
        if summary["manipulation"] == "direct":
            U = np.linalg.solve(phi(some, some, sign).T, U.T).T
        sigmas.append(np.linalg.svd(U, compute_uv=False))
    every = np.concatenate(sigmas)
    return every.min() / every.max(), 1 - residual


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_scores_and_places_under_a_hold(method: str, symmetric: bool, egg: Path, tmp_path: Path) -> None:
    manipulation = "direct" if (method in ("gradient", "nsga2")) != symmetric else "indirect"
    overrides = [f"method={method}", *METHODS[method], f"manipulation={manipulation}", "scenario.weights=area"]
    overrides += ["scenario.symmetry=y", "scenario.symmetry_at=0"] if symmetric else []
    run = a_run(egg, tmp_path / "run", *overrides)
    record = read(run)
    for row in range(len(record.regularity)):
        R, P = plain_scores(run, row)
        assert record.regularity[row] == pytest.approx(R, rel=1e-6, abs=1e-12)
        assert record.improvement_potential[row] == pytest.approx(P, abs=1e-8)
    assert record.held is not None
    free = record.vertices[~(record.vertices[:, 0] < -1.6)]
    nearest_free, nearest_held = (
        cdist(record.centers.reshape(-1, 3), part).min(axis=1) for part in (free, record.held)
    )
    assert (nearest_free <= nearest_held + 1e-9).all()
    assert record.summary["hold_width"] == 0.8


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_held_vertices_stay_to_the_bit_in_exports_and_deformed_meshes(
    manipulation: str, symmetric: bool, egg: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    overrides = ["method=random", "method.population=4", f"manipulation={manipulation}"]
    overrides += ["scenario.symmetry=y", "scenario.symmetry_at=0"] if symmetric else []
    run, out = a_run(egg, tmp_path / "run", *overrides), tmp_path / "out"
    assert export.main([str(run), "--pick", "index:0", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "left out: parameters.prm: PyGeM has no held regions" in printed
    record = read(run)
    assert f"{int((read(run).vertices[:, 0] < -1.6).sum())} vertices are held and do not move" in printed
    assert "should not move" not in printed
    chosen = setup(record, 0)
    assert record.blend is not None
    held = record.blend == 0
    assert held.any()
    with np.load(out / "setup.npz") as arrays:
        U = arrays["U"]
        assert (U[held] == 0).all()
        np.testing.assert_array_equal(arrays["blend"], record.blend)
        root = np.sqrt(record.weights)[:, None]
        for end in ("", "_across")[: 2 if symmetric else 1]:
            Q, T = arrays[f"Q{end}"], arrays[f"T{end}"]
            np.testing.assert_allclose(Q @ T, arrays[f"U{end}"], atol=1e-12)
            np.testing.assert_allclose((root * Q).T @ (root * Q), np.eye(Q.shape[1]), atol=1e-12)
            np.testing.assert_array_equal(np.tril(T, -1), 0.0)
    table = np.genfromtxt(out / "displacements.csv", delimiter=",", names=True)
    rows = np.stack([table[name] for name in ("dx", "dy", "dz")], axis=1)
    moved = np.stack([table[name] for name in ("moved_x", "moved_y", "moved_z")], axis=1)
    np.testing.assert_allclose(moved, chosen.blend(chosen.centers) * rows, rtol=1e-12)
    if manipulation == "direct" and not symmetric:
        np.testing.assert_allclose(U @ rows, record.blend[:, None] * chosen.free_displacement(
            record.vertices, chosen.weights(rows)), atol=1e-10)  # fmt: skip
    finer = trimesh.creation.icosphere(subdivisions=4)
    trimesh.Trimesh(finer.vertices * [2.0, 1.0, 0.8], finer.faces, process=False).export(tmp_path / "finer.ply")
    for what in ("displacements", "weights"):
        moves = ["--" + what, str(out / f"{what}.csv"), "--overwrite"]
        common = [str(run), "--pick", "index:0", *moves]
        assert apply.main([*common, "--mesh", str(egg), "--out", str(tmp_path / "moved.vtp")]) == 0
        after = np.asarray(pyvista.read(tmp_path / "moved.vtp").points)
        before = np.asarray(pyvista.read(egg).points)
        np.testing.assert_array_equal(after[held], before[held])
        assert np.linalg.norm(after - before, axis=1).max() > 0.1
        arguments = [*common, "--mesh", str(tmp_path / "finer.ply"), "--out", str(tmp_path / "moved.ply")]
        assert apply.main(arguments) == 0
        fine: Any = trimesh.load(tmp_path / "finer.ply", process=False)
        fine_moved: Any = trimesh.load(tmp_path / "moved.ply", process=False)
        points = np.asarray(fine.vertices)
        blend = smooth_step(cdist(points, chosen.hold.points if chosen.hold else points).min(axis=1), 0.8)
        if symmetric:
            both = np.concatenate([record.vertices[held], record.vertices[held] * [1, -1, 1]])
            blend = smooth_step(cdist(points, both).min(axis=1), 0.8)
        weights = chosen.weights(rows)
        expected = points + blend[:, None] * chosen.free_displacement(points, weights)
        np.testing.assert_allclose(np.asarray(fine_moved.vertices), expected, atol=1e-5)


def test_what_is_held_on_one_side_of_a_symmetric_run_stays_on_both_when_applied(egg: Path, tmp_path: Path) -> None:
    overrides = ["method=random", "method.population=3", "scenario.symmetry=y", "scenario.symmetry_at=0"]
    run = a_run(egg, tmp_path / "run", *overrides, "scenario.hold=[null,0.6,null,null,null,null]")
    record = read(run)
    assert record.blend is not None
    assert record.held is not None
    assert (record.held[:, 1] >= 0.6).all()
    both = np.abs(record.vertices[:, 1]) >= 0.6
    np.testing.assert_array_equal(record.blend == 0, both)
    assert export.main([str(run), "--pick", "index:0", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    moves = ["--displacements", str(tmp_path / "out" / "displacements.csv"), "--mesh", str(egg)]
    assert apply.main([str(run), "--pick", "index:0", *moves, "--out", str(tmp_path / "moved.vtp")]) == 0
    move = np.linalg.norm(np.asarray(pyvista.read(tmp_path / "moved.vtp")["displacement"]), axis=1)
    assert (move[both] == 0).all()
    assert (move[~both] > 0).any()


def test_a_closing_table_names_centers_with_no_free_vertex_in_reach(
    egg: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ["scenario=mesh", f"scenario.template={egg}", "scenario.sensitivity=sensitivity"]
    settings += ["scenario.hold=[null,null,null,1,null,null]", "scenario.keep_out=false", "kernel.support=0.3"]
    settings += ["centers=4", "figures=false", "method=random", "method.population=3"]
    assert main([f"hydra.run.dir={tmp_path}", *settings]) == 0
    record, lines = read(tmp_path), capsys.readouterr().out.splitlines()
    assert record.blend is not None
    free = record.vertices[record.blend > 0]
    idle = cdist(record.centers.reshape(-1, 3), free).min(axis=1).reshape(3, 4) >= 0.3
    best = int(np.argmax(record.improvement_potential))
    numbers = ", ".join(map(str, np.flatnonzero(idle[best])))
    assert idle[best].any()
    assert f"best P (row {best}): no free vertex in reach of centers {numbers}, which move nothing" in lines


def test_a_run_is_resumed_only_with_the_same_hold(egg: Path, tmp_path: Path) -> None:
    first = held_scenario(egg, hold="end", hold_width=0.7)
    other = held_scenario(egg, hold="end", hold_width=0.9)
    from rbfevo.runs.checkpoint import digest

    assert digest(first.blend) != digest(other.blend)


# --- heuristics and fits ---------------------------------------------------------------------------------------------


def test_ols_picks_the_candidate_that_gains_most_under_the_hold(egg: Path, tmp_path: Path) -> None:
    run = a_run(egg, tmp_path / "run", "method=ols", "method.per_axis=7", "centers=1", "scenario.keep_out=false", *BUSY)
    record = read(run)
    axes = [np.linspace(a, b, 7) for a, b in zip(record.lower, record.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    r = cdist(record.vertices, grid)
    assert record.blend is not None

    def gains(rows: np.ndarray) -> np.ndarray:
        columns = rows[:, None] * np.where(r < SUPPORT, (1 - r / SUPPORT) ** 4 * (4 * r / SUPPORT + 1), 0.0)
        squares = np.maximum((columns**2).sum(axis=0), 1e-300)
        return np.square(columns.T @ record.gradient).sum(axis=1) / squares

    best = gains(record.blend)
    np.testing.assert_allclose(record.centers[0, 0], grid[np.argmax(best)], atol=1e-12)
    assert record.improvement_potential[0] == pytest.approx(best.max(), rel=1e-9)
    assert np.argmax(gains(np.ones_like(record.blend))) != np.argmax(best)


@pytest.mark.parametrize("manipulation", ["indirect", "direct", "orthogonalized"])
def test_fits_move_nothing_that_is_held(manipulation: str, egg: Path) -> None:
    scenario = held_scenario(egg, hold="end", hold_width=0.7, weights="area")
    kernel = Wendland(SUPPORT)
    centers = scenario.sample(1, 5, torch.Generator().manual_seed(2))[0]
    found = deformation(scenario, kernel, centers, manipulation)
    assert (found.U[scenario.blend == 0] == 0).all()
    blend, roots = scenario.blend.numpy()[:, None], np.sqrt(scenario.weights.numpy())[:, None]
    Phi = blend * numpy_phi(kernel, cdist(scenario.vertices.numpy(), centers.numpy()))
    np.testing.assert_allclose((found.U @ found.M).numpy(), Phi, atol=1e-12)
    sigma = np.linalg.svd(roots * found.U.numpy(), compute_uv=False)
    assert found.regularity == pytest.approx(sigma[-1] / sigma[0], rel=1e-9)
    expected = 1.0
    if manipulation != "orthogonalized":
        expected = float(evaluator_of(scenario, kernel, manipulation).definition(centers).regularity)
    assert found.regularity == pytest.approx(expected, rel=1e-9)
