"""Planar designs together with held regions, smoothing, and the sides of their normals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from scipy.spatial.distance import cdist
from slabs import HALVES, ring, saved, strip, volume
from test_holding import smooth_step

from rbfevo import apply, export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.geometry import sobolev
from rbfevo.recorded.record import read
from rbfevo.scenarios import mesh

COUNT = 80


@pytest.fixture(scope="module")
def slab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A slab whose nose is marked on the front alone, with a sensitivity that is rough."""
    surface = strip(COUNT)
    points = np.asarray(surface.points, np.float64)
    rough = np.random.default_rng(0).normal(size=(COUNT, 2))
    s = np.zeros((2 * COUNT, 3))
    s[:, :2] = np.stack([np.cos(points[:, 0]), points[:, 1]], axis=1) + np.tile(rough, (2, 1))
    marks = ((points[:, 0] < -1.7) & (points[:, 2] > 0)).astype(float)
    return saved(surface, tmp_path_factory.mktemp("slab") / "slab.vtp", s=s, nose=marks)


def planar(slab: Path, **settings: Any) -> Any:
    return mesh(template=str(slab), sensitivity="s", planar="z", sensitivity_kind="nodal", **settings)


def test_what_is_held_on_one_side_is_held_on_both_and_blends_alike(slab: Path) -> None:
    scenario = planar(slab, hold="nose", hold_width=0.6)
    X, blend = scenario.vertices.numpy(), scenario.blend.numpy()
    flat = X[:, :2]
    expected = smooth_step(cdist(flat, flat[flat[:, 0] < -1.7]).min(axis=1), 0.6)
    np.testing.assert_allclose(blend, expected, atol=1e-12)
    np.testing.assert_array_equal(blend[:COUNT], blend[COUNT:])
    assert (scenario.gradient.numpy()[blend == 0] == 0).all()
    assert scenario.keep_out.contains(scenario.vertices[blend == 0]).all()
    box = planar(slab, hold=[None, None, 0.09, -1.7, None, None], hold_width=0.6)  # a box that holds the front alone
    np.testing.assert_array_equal(box.blend.numpy(), blend)


def test_a_held_slab_moves_alike_and_its_nose_not_at_all(slab: Path, tmp_path: Path) -> None:
    settings = ["scenario=mesh", f"scenario.template={slab}", "scenario.sensitivity=s", "scenario.planar=z"]
    settings += ["scenario.hold=nose", "scenario.hold_width=0.6", "kernel.support=1.2", "centers=5", "method=random"]
    settings += ["method.population=3", "figures=false", "quiet=true", "scenario.sensitivity_kind=nodal"]
    assert main([f"hydra.run.dir={tmp_path / 'run'}", *settings]) == 0
    out = tmp_path / "out"
    assert export.main([str(tmp_path / "run"), "--pick", "index:0", "--out", str(out), "--quiet"]) == 0
    volume(COUNT).save(tmp_path / "volume.vtu")
    arguments = [str(tmp_path / "run"), "--pick", "index:0", "--displacements", str(out / "displacements.csv")]
    arguments += ["--mesh", str(tmp_path / "volume.vtu"), "--out", str(tmp_path / "moved.vtu"), "--force"]
    assert apply.main(arguments) == 0
    moved: Any = pv.read(tmp_path / "moved.vtu")
    move = np.asarray(moved["displacement"])
    half = len(move) // 2
    np.testing.assert_array_equal(move[:half], move[half:])
    assert (move[:, 2] == 0).all()
    record = read(tmp_path / "run")
    assert record.blend is not None
    held = record.vertices[record.blend == 0]
    before = np.asarray(volume(COUNT).points)
    nose = cdist(before, held).min(axis=1) == 0
    assert nose.any()
    assert (move[nose] == 0).all()
    assert np.linalg.norm(move, axis=1).max() > 0.01


def test_a_smoothed_slab_keeps_front_and_back_alike(slab: Path) -> None:
    rough, scenario = planar(slab), planar(slab, smooth=0.3)
    g = scenario.gradient.numpy()
    np.testing.assert_array_equal(g[:COUNT], g[COUNT:])
    assert (g[:, 2] == 0).all()
    raw = scenario.gradient_raw.numpy() * scenario.gradient_norm
    np.testing.assert_allclose(raw, rough.gradient.numpy() * rough.gradient_norm, rtol=1e-12, atol=1e-12)
    assert (np.diff(g[:COUNT], axis=0) ** 2).sum() < 0.2 * (np.diff(rough.gradient.numpy()[:COUNT], axis=0) ** 2).sum()


# --- curves ----------------------------------------------------------------------------------------------------------


def a_circle(count: int) -> tuple[np.ndarray, np.ndarray]:
    angle = 2 * np.pi * np.arange(count) / count
    points = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    here = np.arange(count)
    return points, np.stack([here, (here + 1) % count], axis=1)


def test_the_filter_of_a_circle_divides_its_waves_by_one_plus_l_squared_k_squared() -> None:
    errors = []
    for count in (40, 80, 160):
        points, segments = a_circle(count)
        M, K = sobolev.mass(points, segments), sobolev.stiffness(points, segments)
        np.testing.assert_allclose(M.sum(), 2 * count * np.sin(np.pi / count), rtol=1e-12)
        np.testing.assert_allclose(K @ np.ones(count), 0.0, atol=1e-10)
        wave = np.cos(3 * np.arctan2(points[:, 1], points[:, 0]))[:, None]
        found = sobolev.smoothed(wave, M, K, 0.4)
        errors.append(float(np.abs(found - wave / (1 + 0.4**2 * 9)).max()))
        np.testing.assert_allclose(sobolev.smoothed(np.ones((count, 1)), M, K, 0.4), 1.0, rtol=1e-12)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.1)


def curve_file(folder: Path, turned: bool) -> Path:
    flat = ring(COUNT)
    points = np.column_stack([flat, np.zeros(COUNT)])
    here = np.arange(COUNT)
    segments = np.stack([here, (here + 1) % COUNT], axis=1)
    segments = segments[:, ::-1] if turned else segments
    curve = pv.PolyData()
    curve.points = points
    curve.lines = np.hstack([np.full((COUNT, 1), 2), segments]).ravel()
    return saved(curve, folder / f"curve{int(turned)}.vtp", s=1.0 + 0.5 * points[:, 0] / HALVES[0])


def test_curves_are_smoothed_and_ask_for_the_side_of_their_normals(tmp_path: Path) -> None:
    plain, turned = curve_file(tmp_path, False), curve_file(tmp_path, True)
    common: dict[str, Any] = {"sensitivity": "s", "planar": "z"}
    outward = mesh(template=str(plain), **common)
    assert "inwards" in outward.notes["largest move"]  # J rises where the curve grows
    with pytest.raises(UserError, match=r"scenario\.sensitivity_normal=outward"):
        mesh(template=str(turned), **common)
    same = mesh(template=str(turned), sensitivity_normal="outward", **common)
    np.testing.assert_allclose(same.gradient.numpy(), outward.gradient.numpy(), atol=1e-12)
    other = mesh(template=str(turned), sensitivity_normal="as_wound", **common)
    np.testing.assert_allclose(other.gradient.numpy(), -outward.gradient.numpy(), atol=1e-12)
    smooth = mesh(template=str(plain), smooth=0.5, **common)
    assert smooth.gradient_raw is not None
    assert smooth.smooth == 0.5
    assert "g is smoothed over 0.5" in smooth.notes["smooth"]
    held = mesh(template=str(plain), hold=[None, None, None, -1.5, None, None], hold_width=0.5, **common)
    assert held.blend is not None
    assert (held.blend.numpy() == 0).sum() == (held.vertices.numpy()[:, 0] <= -1.5).sum() > 0
