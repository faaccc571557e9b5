"""Planar designs: slabs one cell thick, what they want, where their centers sit, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
import torch
from scipy.spatial.distance import cdist
from slabs import HALVES, THICK, lifted, ring, saved, strip

from rbfevo.errors import UserError
from rbfevo.fit.manipulations import deformation
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.parameterization import BoxRegion, Parameterization, VertexRegion
from rbfevo.geometry.planar import Plane, layers
from rbfevo.scenarios import mesh
from rbfevo.scenarios.coarse import coarsened, matched
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.reach import unfit
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import Cubic, Kernel, Wendland
from rbfevo.scoring.symmetric import evaluator_of

COUNT = 40
FLAT = ring(COUNT)
NORMALS = FLAT / np.square(HALVES)
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
ONES = torch.ones(3, dtype=torch.float64)


def fields(surface: pv.PolyData, axis: int = 2) -> dict[str, np.ndarray]:
    """Sensitivities of a strip: values of both sides alike, and values that are not."""
    x, y = np.tile(FLAT, (2, 1)).T
    flat = np.stack([np.exp(-((x - 1.0) ** 2)), y], axis=1)
    even = lifted(flat, axis, 0.0)
    along = even.copy()
    along[:, axis] = 0.5
    odd = np.where(np.arange(2 * COUNT) < COUNT, 1.0, 3.0)[:, None] * even
    front = np.where(np.arange(2 * COUNT) < COUNT, 0.0, 1.0) * (x > 1.0)
    return {"even": even, "along": along, "odd": odd, "scalar": 1.0 + x, "marked": front}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("slabs")
    for axis in range(3):
        surface = strip(COUNT, axis)
        saved(surface, directory / f"{'xyz'[axis]}.vtp", **fields(surface, axis))
    return directory


def build(folder: Path, **settings: Any) -> Scenario:
    axis = settings.pop("planar", "z")
    return mesh(template=str(folder / f"{axis}.vtp"), planar=axis, **{"sensitivity": "even", **settings})


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_front_and_back_want_the_same_within_the_plane(axis: int, folder: Path) -> None:
    plain, along, odd = (build(folder, planar="xyz"[axis], sensitivity=name) for name in ("even", "along", "odd"))
    assert plain.planar == Plane(axis, 0.05, 0.05)
    wanted = -fields(strip(COUNT), axis)["even"]
    np.testing.assert_allclose(plain.gradient.numpy(), wanted / np.linalg.norm(wanted), atol=1e-14)
    for other in (along, odd):
        torch.testing.assert_close(other.gradient, plain.gradient, rtol=0, atol=1e-14)
        assert bool((other.gradient[:, axis] == 0).all())
        assert torch.equal(other.gradient[:COUNT], other.gradient[COUNT:])
    assert not [title for title in plain.notes if title.startswith("planar ")]
    share = 2 * COUNT * 0.25 / (2 * COUNT * 0.25 + (wanted**2).sum())
    assert f"{share:.3%} of |g|^2" in along.notes["planar component"]
    assert "planar difference" not in along.notes
    # Of 1 and 3 times a field the mean is twice it: 1 + 1 of 1 + 9 parts are lost.
    assert "20.000% of |g|^2 is lost" in odd.notes["planar difference"]
    assert odd.gradient_norm == pytest.approx(2.0 * plain.gradient_norm)


@pytest.mark.parametrize("weights", ["uniform", "area"])
@pytest.mark.parametrize("kind", ["nodal", "density"])
def test_normals_lie_in_the_plane_and_do_not_depend_on_how_quadrilaterals_are_cut(
    folder: Path, weights: str, kind: str
) -> None:
    scenario = build(folder, sensitivity="scalar", sensitivity_kind=kind, weights=weights)
    sides = np.linalg.norm(np.roll(FLAT, -1, axis=0) - FLAT, axis=1)
    area = 0.5 * THICK * 0.5 * (sides + np.roll(sides, 1))
    chords = np.roll(FLAT, -1, axis=0) - np.roll(FLAT, 1, axis=0)
    normals = np.stack([chords[:, 1], -chords[:, 0]], axis=1) / np.linalg.norm(chords, axis=1, keepdims=True)
    assert ((normals * NORMALS).sum(axis=1) > 0.99).all()
    mass = area / area.mean() if weights == "area" else np.ones(COUNT)
    wanted = -((1.0 + FLAT[:, 0]) * (area if kind == "density" else 1.0) / mass)[:, None] * normals
    wanted /= np.sqrt(2.0 * (mass[:, None] * wanted**2).sum())
    for side in (scenario.gradient[:COUNT], scenario.gradient[COUNT:]):
        np.testing.assert_allclose(side[:, :2].numpy(), wanted, atol=1e-12)
    np.testing.assert_allclose(scenario.weights.numpy(), np.tile(mass, 2), rtol=1e-9)


def test_the_middle_is_as_far_from_front_as_from_back() -> None:
    """To the bit where a double can be, and to rounding anywhere."""
    generator, alike = np.random.default_rng(0), 0
    for low, high in [(0.0, 0.1), (-0.5, 0.5), (0.0, 1.0), (-0.05, 0.05), (0.25, 0.375), (0.0, 3e-3)]:
        plane = Plane.between(2, low, high)
        assert plane.at - low == high - plane.at == plane.depth
    for _ in range(500):
        low = float(np.round(generator.uniform(-5, 5), int(generator.integers(1, 8))))
        high = low + float(np.round(generator.uniform(1e-3, 1), 3))
        plane = Plane.between(1, low, high)
        assert abs((plane.at - low) - (high - plane.at)) <= np.spacing(max(abs(low), abs(high)))
        alike += plane.at - low == high - plane.at
    assert alike > 200


def test_layers_are_told_apart_by_more_than_rounding() -> None:
    assert layers(np.array([0.3, 0.1, 0.1 + 1e-9, 0.3 - 1e-9]), 1e-6) == [0.1 + 1e-9, 0.3]
    assert len(layers(np.linspace(0.0, 1.0, 101), 1e-6)) == 101
    assert len(layers(np.linspace(0.0, 1e-5, 1001), 1e-6)) > 5  # steps below the tolerance do not hide a slope


def points(*shape: int) -> torch.Tensor:
    return 4 * torch.rand(*shape, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 2


MIRROR = Mirror.across(1, 0.2, -2 * ONES, 2 * ONES)
PLACEMENTS = {
    "plain": (None, None),
    "mirror": (MIRROR, None),
    "box": (None, "box"),
    "vertices": (None, "vertices"),
    "all": (MIRROR, "box"),
    "all by vertices": (MIRROR, "vertices"),
}


@pytest.mark.parametrize("which", PLACEMENTS)
def test_centers_are_pinned_to_the_plane_with_mirror_and_region(which: str) -> None:
    mirror, kind = PLACEMENTS[which]
    plane = Plane(2, 0.1)
    region: Any = None
    if kind == "box":
        low, high = torch.tensor([-1.0, -1, -torch.inf]), torch.tensor([1.0, 1, torch.inf])
        region = BoxRegion(low, high, (-2 * ONES, 2 * ONES), mirror)
    if kind == "vertices":
        places = plane.pinned(points(200))
        region = VertexRegion(places, places[:, 0] > 0.5, mirror)
    place = Parameterization(mirror, 1.0, region, plane)
    where = points(8, 5)
    centers = place(where)
    assert bool((centers[..., 2] == 0.1).all())
    assert bool((place.settle(where)[..., 2] == 0.1).all())
    torch.testing.assert_close(place(centers), centers, rtol=0, atol=1e-12)
    if region is not None:
        assert not bool(region.contains(centers)[:, :-1].any())
        assert not torch.equal(centers[..., :2], where[..., :2])
    if mirror is not None:
        assert bool((centers[:, -1, 1] == 0.2).all())
        assert bool((centers[..., 1] >= 0.2).all())
    slope, h = points(1, 8, 5)[0], 1e-7
    pulled = place.pull(where, slope)
    assert bool((pulled[..., 2] == 0).all())
    if kind != "vertices":  # whose projection counts as constant
        for way in points(3, 8, 5):
            ahead, behind = (slope * place(where + h * way)).sum(), (slope * place(where - h * way)).sum()
            torch.testing.assert_close((pulled * way).sum(), (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize("kernel", [Wendland(1.5), Cubic()])
def test_scores_have_gradients_in_the_free_coordinates(kernel: Kernel, manipulation: str, folder: Path) -> None:
    scenario = build(folder, symmetry="y", symmetry_at=0.0)
    evaluate = evaluator_of(scenario, kernel, manipulation, "eager")
    place = scenario.parameterization
    where = scenario.sample(3, 5, torch.Generator().manual_seed(3)) + 0.05 * points(3, 5)

    def value(p: torch.Tensor) -> torch.Tensor:
        spectrum = evaluate.spectrum(place(p))
        return (share * spectrum.sigma.log()).sum() + spectrum.potential.sum()

    spectrum = evaluate.spectrum(place(where))
    share = torch.ones_like(spectrum.sigma)
    share[:, -1] = 0.0  # the center on the symmetry plane has no column across: its place in sigma is a filler
    pulled = place.pull(where, spectrum.backward(share, torch.ones(3, dtype=torch.float64)))
    assert bool((pulled[..., 2] == 0).all())
    h = 1e-6
    for way in points(3, 3, 5):
        expected = (value(where + h * way) - value(where - h * way)) / (2 * h)
        torch.testing.assert_close((pulled * way).sum(), expected, rtol=1e-3, atol=3e-3)


def test_r_and_p_are_those_of_the_textbook_in_space(folder: Path) -> None:
    """Distances are those in space, r^3 is the triharmonic kernel, and one side with twice its weights is the whole."""
    scenario = build(folder)
    centers = scenario.parameterization(scenario.sample(4, 6, torch.Generator().manual_seed(1)))
    X, g = scenario.vertices.numpy(), scenario.gradient.numpy()
    for kernel in (Wendland(1.5), Cubic()):
        found = Evaluator(scenario.vertices, scenario.gradient, kernel)(centers)
        front = scenario.front()
        half = Evaluator(front.vertices, front.gradient, kernel, weights=front.weights)(centers)
        torch.testing.assert_close(half.objectives, found.objectives, rtol=1e-9, atol=1e-12)
        for i, setup in enumerate(centers.numpy()):
            r = cdist(X, setup)
            U = r**3 if kernel.name == "triharmonic" else np.where(r < 1.5, (1 - r / 1.5) ** 4 * (4 * r / 1.5 + 1), 0)
            sigma = np.linalg.svd(U, compute_uv=False)
            assert float(found.regularity[i]) == pytest.approx(sigma[-1] / sigma[0], rel=1e-6)
            left = np.linalg.norm(g - U @ np.linalg.lstsq(U, g, rcond=None)[0]) ** 2
            assert float(found.improvement_potential[i]) == pytest.approx(1 - left, abs=1e-8)
    assert len(front.vertices) == COUNT
    assert bool((front.vertices[:, 2] == THICK).all())


@pytest.mark.parametrize("thick", [0.02, 1.0])
def test_a_coarse_design_keeps_the_distance_to_the_plane(thick: float, tmp_path: Path) -> None:
    surface = strip(800, heights=(0.0, thick))
    x, y = np.tile(ring(800), (2, 1)).T
    path = saved(surface, tmp_path / "slab.vtp", s=np.stack([np.exp(-((x - 1) ** 2)), y, 0 * x], axis=1))
    scenario = mesh(template=str(path), sensitivity="s", planar="z")
    fewer = coarsened(scenario, 200)
    assert len(fewer.vertices) <= 200
    assert bool((fewer.vertices[:, 2] == thick).all())
    assert float(fewer.weights.sum()) == pytest.approx(1600.0)
    centers = scenario.parameterization(scenario.sample(20, 6, torch.Generator().manual_seed(1)))
    kernel = Wendland(1.5)
    exact = Evaluator(scenario.vertices, scenario.gradient, kernel)(centers)
    found = Evaluator(fewer.vertices, fewer.gradient, kernel, weights=fewer.weights)(centers)
    fewer = matched(fewer, found.improvement_potential, exact.improvement_potential)
    found = Evaluator(fewer.vertices, fewer.gradient, kernel, weights=fewer.weights)(centers)
    torch.testing.assert_close(found.improvement_potential, exact.improvement_potential, rtol=0, atol=2e-3)
    torch.testing.assert_close(found.regularity, exact.regularity, rtol=2e-2, atol=0)
    assert len(coarsened(scenario, 1000).vertices) == 800  # one side is exact
    assert coarsened(scenario, 1600) is scenario


@pytest.mark.parametrize("cap", [False, True])
def test_a_target_is_met_in_the_plane(cap: bool, folder: Path, tmp_path: Path) -> None:
    """A slab of another thickness at another height: only its outline counts, not its front and back."""
    bigger = strip(400, heights=(2.0, 2.3))
    bigger.points[:, :2] *= 1.25
    if cap:
        lids = [np.hstack([[400], np.arange(400)[::-1]]), np.hstack([[400], np.arange(400, 800)])]
        bigger = pv.PolyData(bigger.points, np.hstack([bigger.faces, *lids]))
    bigger.save(tmp_path / "bigger.vtp")
    scenario = build(folder, sensitivity=None, target=str(tmp_path / "bigger.vtp"))
    wanted = (scenario.gradient * scenario.gradient_norm).numpy()
    assert not scenario.warnings
    assert (wanted[:, 2] == 0).all()
    np.testing.assert_array_equal(wanted[:COUNT], wanted[COUNT:])
    outline = 1.25 * ring(40_000)
    nearest = outline[cdist(FLAT, outline).argmin(axis=1)]
    np.testing.assert_allclose(wanted[:COUNT, :2], nearest - FLAT, atol=1e-2)
    assert scenario.notes["rejected"].startswith("0 of 80")
    assert scenario.closest is not None
    np.testing.assert_allclose(scenario.closest(scenario.vertices.numpy()), scenario.vertices.numpy() + wanted)
    cloud = pv.PolyData(lifted(outline[::40], 2, 7.0))
    cloud.save(tmp_path / "cloud.vtp")
    by_cloud = build(folder, sensitivity=None, target=str(tmp_path / "cloud.vtp"))
    torch.testing.assert_close(by_cloud.gradient, scenario.gradient, rtol=0, atol=1e-2)
    assert by_cloud.notes["rejected"].startswith("0 of 80")


def test_the_ends_of_an_open_target_are_still_rejected(folder: Path, tmp_path: Path) -> None:
    right = strip(400).clip("x", origin=(0.0, 0, 0), invert=False)
    right.points[:, :2] *= 1.2
    right.save(tmp_path / "right.vtp")
    scenario = build(folder, sensitivity=None, target=str(tmp_path / "right.vtp"))
    assert scenario.stays is not None
    beyond = np.tile(FLAT[:, 0], 2) < -1e-9
    assert scenario.stays.numpy()[beyond].all()
    assert scenario.stays.numpy()[np.tile(FLAT[:, 0], 2) > 0.5].sum() == 0


@pytest.mark.parametrize("fixed", ["marked", [1.0, None, None, None, None, 0.05]])
def test_what_is_fixed_on_one_side_is_fixed_on_the_other(fixed: Any, folder: Path) -> None:
    scenario = build(folder, fixed=fixed, keep_out=True)
    held = np.tile(FLAT[:, 0] > 1.0 - 1e-12 if fixed != "marked" else FLAT[:, 0] > 1.0, 2)
    assert scenario.stays is not None
    np.testing.assert_array_equal(scenario.stays.numpy(), held)
    assert bool((scenario.gradient[torch.from_numpy(held)] == 0).all())
    wide = scenario.lower + torch.rand(40, 7, 3, generator=torch.Generator().manual_seed(0)) * (
        scenario.upper - scenario.lower
    )
    centers = scenario.parameterization(wide.to(torch.float64))
    assert bool((centers[..., 2] == 0.05).all())
    if fixed == "marked":
        near = cdist(centers.reshape(-1, 3)[:, :2].numpy(), FLAT).argmin(axis=1)
        assert (FLAT[near, 0] <= 1.0).all()
    else:
        assert float(centers[..., 0].max()) <= 1.0
    assert scenario.parameterization(scenario.sample(5, 4, torch.Generator().manual_seed(1))).shape == (5, 4, 3)


def test_the_default_radius_is_the_reach_in_the_plane(folder: Path, tmp_path: Path) -> None:
    scenario = build(folder, support="20%")
    sides = (scenario.upper - scenario.lower)[:2]
    assert scenario.diagonal == pytest.approx(float(sides.norm()))
    assert scenario.support == pytest.approx(np.hypot(0.2 * scenario.diagonal, 0.05))
    assert build(folder, support=0.7).support == 0.7
    assert unfit(scenario, scenario.support) == []
    thick = strip(COUNT, heights=(0.0, 2.0))
    made = mesh(template=str(saved(thick, tmp_path / "thick.vtp", **fields(thick))), sensitivity="even", planar="z")
    assert made.support > 1.0
    (line,) = unfit(made, made.support)
    assert "the slab is 2 thick" in line
    assert f"reaches {0.15 * made.diagonal:.3g} in the plane" in line
    assert "reaches no vertex at all" in unfit(made, 0.9)[0]
    drawn = made.parameterization(made.sample(3, 5, torch.Generator().manual_seed(0)))
    assert bool((Evaluator(made.vertices, made.gradient, Wendland(made.support))(drawn).regularity > 0).all())


def refusal(path: Path, **settings: Any) -> str:
    with pytest.raises(UserError) as error:
        mesh(template=str(path), **{"planar": "z", "sensitivity": "even", **settings})
    assert "\n" not in str(error.value)
    return str(error.value)


def test_what_is_no_slab_is_refused(folder: Path, tmp_path: Path) -> None:
    assert "choose x, y or z, the axis across the plane, or null" in refusal(folder / "z.vtp", planar="w")
    assert "the vertices lie in 21 layers across x" in refusal(folder / "z.vtp", planar="x")
    assert "choose two different axes" in refusal(folder / "z.vtp", symmetry="z")
    surface = strip(COUNT)
    three = pv.merge([strip(COUNT, heights=(0.0, 0.1)), strip(COUNT, heights=(0.1, 0.2))])
    three = saved(three.extract_surface(algorithm=None), tmp_path / "three.vtp", even=np.ones((120, 3)))
    assert "scenario.planar=z: the vertices lie in 3 layers across z" in refusal(three)
    surface.points[COUNT : COUNT + 3, 0] += 1e-3
    moved = saved(surface, tmp_path / "moved.vtp", **fields(surface))
    assert "6 of 80 vertices have no vertex opposite to them on the other side" in refusal(moved)
    surface = strip(COUNT)
    surface.points[COUNT : COUNT + 3, 0] += 1e-7  # rounding
    surface.points[:7, 2] += 1e-7
    near = saved(surface, tmp_path / "near.vtp", **fields(surface))
    made = mesh(template=str(near), planar="z", sensitivity="even")
    assert made.planar is not None
    assert made.planar.at == pytest.approx(0.05, abs=1e-6)
    assert torch.equal(made.gradient[:COUNT], made.gradient[COUNT:])
    surface.point_data["up"] = np.tile([0.0, 0.0, 1.0], (80, 1))
    assert "no component across z" in refusal(saved(surface, tmp_path / "up.vtp"), sensitivity="up")
    flat = pv.Plane(i_size=9.0, j_size=9.0)
    flat.save(tmp_path / "sheet.vtp")
    assert "the target lies in one plane" in refusal(
        folder / "z.vtp", sensitivity=None, target=str(tmp_path / "sheet.vtp")
    )


def test_coincident_vertices_of_a_sharp_edge_have_partners() -> None:
    flat = np.concatenate([FLAT, FLAT[:1]])
    vertices = np.concatenate([lifted(flat, 2, 0.0), lifted(flat[::-1], 2, 1.0)])
    found = Planar.of("z", vertices)
    assert found is not None
    np.testing.assert_array_equal(found.partner[found.partner], np.arange(len(vertices)))
    np.testing.assert_allclose(vertices[found.partner][:, :2], vertices[:, :2])
    assert (vertices[found.partner, 2] != vertices[:, 2]).all()


def test_only_representations_of_centers_are_planar(folder: Path) -> None:
    from rbfevo.scoring.representations import RBF

    class Other(RBF):
        name = "other"

    scenario = build(folder)
    assert evaluator_of(scenario, Other(Wendland(1.0)), "indirect", "eager") is not None
    foreign: Any = dataclasses.make_dataclass("Foreign", [("name", str)])("foreign")
    with pytest.raises(UserError, match=r"scenario\.planar=z: representation=foreign has no planar setups"):
        evaluator_of(scenario, foreign, "indirect", "eager")


def test_a_fit_of_a_planar_design_is_refused(folder: Path) -> None:
    scenario = build(folder)
    centers = scenario.parameterization(scenario.sample(1, 5, torch.Generator().manual_seed(0)))[0]
    with pytest.raises(UserError, match="setups of a planar design cannot be fitted"):
        deformation(scenario, Wendland(1.0), centers, "direct")
