"""Half models: their plane of symmetry is found from the open boundary, proposed, or asked about."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from slabs import ring, saved, strip

from rbfevo.errors import UserError
from rbfevo.geometry.rims import Rim, rim_of, rim_of_curve
from rbfevo.scenarios import mesh
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scenarios.templates import read_template


@pytest.fixture(autouse=True)
def read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A template of another test must not be remembered."""
    monkeypatch.setattr(sys.modules["rbfevo.scenarios.mesh"], "read_template", read_template)


def ball() -> Any:
    return pv.Sphere(radius=1.0, theta_resolution=24, phi_resolution=24)


def half_ball() -> Any:
    return ball().clip("y", origin=(0, 0, 0), invert=False)


def half_ball_with_a_hole() -> Any:
    return half_ball().clip_box((-0.4, 0.4, 0.5, 2.0, -0.4, 0.4), invert=True)


def swept(profile: np.ndarray, closed: bool, length: float, steps: int, bend: float = 0.0, widen: float = 0.0) -> Any:
    """A profile [k, 2] (y, z) swept along x, bent upwards, and widened on its way."""
    k, x = len(profile), np.linspace(0.0, length, steps + 1)
    grow = 1.0 + widen * x / length
    rise = bend * (1.0 - np.cos(np.pi * x / length)) / 2.0
    points = np.stack(
        [np.column_stack([np.full(k, a), g * profile + [0.0, r]]) for a, g, r in zip(x, grow, rise, strict=True)]
    )
    here = np.arange(k if closed else k - 1)
    quads = [
        [4, i * k + j, i * k + (j + 1) % k, (i + 1) * k + (j + 1) % k, (i + 1) * k + j]
        for i in range(steps)
        for j in here
    ]
    return pv.PolyData(points.reshape(-1, 3), np.ravel(quads))


def box_side(count: int) -> np.ndarray:
    """Half of a square duct of the width 1, from the plane y = 0 round to it: bottom, side, top."""
    t = np.linspace(0.0, 1.0, count + 1)
    bottom, side = np.column_stack([0.5 * t, 0 * t]), np.column_stack([0.5 + 0 * t, t])
    return np.concatenate([bottom, side[1:], np.column_stack([0.5 - 0.5 * t, 1 + 0 * t])[1:]])


def half_duct(length: float = 5.0) -> Any:
    return swept(box_side(4), False, length, 20, bend=1.0)


def tube(widen: float = 0.0) -> Any:
    return swept(0.5 * ring(24), True, 3.0, 12, widen=widen)


def half_wing(taper: float = -0.5) -> Any:
    """Open at root and tip; its span is along x."""
    return swept(0.2 * ring(24), True, 3.0, 12, widen=taper)


def rim_in(surface: Any) -> Rim:
    surface = surface.triangulate()
    return rim_of(np.asarray(surface.points, float), np.asarray(surface.regular_faces, np.int64))


def build(surface: Any, tmp_path: Path, **settings: Any) -> Scenario:
    surface = surface.extract_surface(algorithm=None) if not isinstance(surface, pv.PolyData) else surface
    surface.clear_data()
    surface.points = np.asarray(surface.points, np.float64)
    x = np.asarray(surface.points)
    wanted = np.stack([np.exp(-((x[:, 0] - 0.7) ** 2)), x[:, 1], 0.3 + x[:, 2] ** 2], axis=1)
    return mesh(
        template=str(saved(surface, tmp_path / "t.vtp", s=wanted)),
        sensitivity="s",
        sensitivity_kind="nodal",
        **settings,
    )


def test_the_share_of_the_rim_is_a_length() -> None:
    """Of the duct's rim: the two edges in the plane; inlet and outlet; sides of triangles in a plane do not count."""
    rim = rim_in(swept(box_side(4), False, 4.0, 20))
    assert float(rim.sizes.sum()) == pytest.approx(2 * 4.0 + 2 * 2.0)
    assert rim.share(1, 0.0) == pytest.approx(8 / 12)
    assert rim.share(0, 0.0) == rim.share(0, 4.0) == pytest.approx(2 / 12)
    assert rim.share(1, 0.5) == rim.share(2, 0.0) == rim.share(2, 1.0) == 0.0
    assert rim.reach(1, 0.0) == pytest.approx(1.0)
    assert rim.reach(0, 0.0) == pytest.approx(1.0)
    assert rim.reach(1, 0.5) == 0.0
    assert rim_in(ball()).share(1, -1.0) == 0.0
    slab = strip(20).triangulate()
    points, faces = np.asarray(slab.points), np.asarray(slab.regular_faces)
    assert len(rim_of(points, faces).edges) == 40
    assert len(rim_of(points, faces, without=2).edges) == 0


def test_ends_of_a_curve() -> None:
    points = np.array([[0.0, 0, 0], [1, 1, 0], [2, 0, 0]])
    for segments in ([[0, 1], [1, 2]], [[1, 0], [1, 2]], [[1, 0], [2, 1]]):
        rim = rim_of_curve(points, np.array(segments))
        assert rim.share(1, 0.0) == 1.0
        assert rim.share(0, 0.0) == rim.share(0, 2.0) == 0.5
        assert rim.share(1, 1.0) == 0.0


def port() -> Any:
    """A body that is not symmetric, with a window in its side at an end of the template, and a larger one elsewhere."""
    body: Any = pv.Cube(x_length=4.0, y_length=2.0, z_length=1.0).triangulate().subdivide(4)
    body.points[:, 2] *= 1.0 + 0.5 * (body.points[:, 1] < 0) * np.abs(body.points[:, 1])
    centers = body.cell_centers().points
    small = (np.abs(centers[:, 1] - 1.0) < 1e-6) & (np.abs(centers[:, 0]) < 0.5) & (np.abs(centers[:, 2]) < 0.25)
    large = (np.abs(centers[:, 0] - 2.0) < 1e-6) & (np.abs(centers[:, 1]) < 0.7) & (np.abs(centers[:, 2]) < 0.4)
    return body.extract_cells(~(small | large))


FOUND: dict[str, tuple[Callable[[], Any], str, float]] = {
    "half ball": (half_ball, "y", 0.0),
    "half ball with a hole": (half_ball_with_a_hole, "y", 0.0),
    "half duct": (half_duct, "y", 0.0),
    "short half duct": (lambda: half_duct(1.5), "y", 0.0),
    "closed ball": (ball, "y", 0.0),
    "tube across": (tube, "y", 0.0),
    "tube along": (tube, "x", 1.5),
    "half duct turned": (lambda: half_duct().rotate_z(90.0), "x", 0.0),
    "a port": (port, "y", 0.0),
}


@pytest.mark.parametrize("name", FOUND)
def test_the_plane_is_found(name: str, tmp_path: Path) -> None:
    made, axis, at = FOUND[name]
    scenario = build(made(), tmp_path, symmetry=axis)
    assert scenario.mirror is not None
    assert scenario.mirror.at == pytest.approx(at, abs=1e-6)
    if name.startswith(("half", "short")):
        assert "one half" in scenario.notes["symmetry"]
    assert ("half model" in scenario.notes) == ("duct" in name or "hole" in name or name == "tube along")
    if name == "tube along":
        assert "open at x = 0 and x = 3 but symmetric about its middle x = 1.5" in scenario.notes["half model"]
        assert "set scenario.symmetry_at=0 or scenario.symmetry_at=3" in scenario.notes["half model"]
    if name == "half duct":
        share = int(scenario.notes["half model"].split("%")[0])
        assert 70 < share < 75
        assert "% of the open boundary lies in the plane y = 0" in scenario.notes["half model"]
        assert "of a whole one, set scenario.symmetry_at=0.25" in scenario.notes["half model"]


def slender() -> Any:
    """A slender box that is closed at one end alone, with a window in the middle: nearly symmetric about it."""
    body: Any = pv.Cube(x_length=4.0, y_length=0.05, z_length=0.05, center=(2.0, 0, 0)).triangulate().subdivide(5)
    centers = body.cell_centers().points
    window = (np.abs(centers[:, 0] - 2.0) < 0.6) & (centers[:, 2] > 0.0249)
    return body.extract_cells(~(window | (centers[:, 0] < 1e-9)))


ASKED: dict[str, tuple[Callable[[], Any], str, str, str]] = {
    "cone open at both ends": (lambda: tube(0.5), "x", "x = 0 and x = 3", "scenario.symmetry_at=1.5, its middle"),
    "slender and symmetric": (slender, "x", "x = 0", "set scenario.symmetry_at=0 for half a model, or scenario"),
    "tapered wing": (half_wing, "x", "x = 0 and x = 3", "scenario.symmetry_at=0 or scenario.symmetry_at=3 for half"),
}


@pytest.mark.parametrize("name", ASKED)
def test_what_stays_open_is_asked_about(name: str, tmp_path: Path) -> None:
    made, axis, where, way = ASKED[name]
    with pytest.raises(UserError) as error:
        build(made(), tmp_path, symmetry=axis)
    assert str(error.value).startswith(f"scenario.symmetry={axis}: the template is open at {where}, which may cut it")
    assert way in str(error.value)
    assert "\n" not in str(error.value)
    for at in (0.0, 1.5):
        scenario = build(made(), tmp_path, symmetry=axis, symmetry_at=at)
        assert scenario.mirror is not None
        assert scenario.mirror.at == at


PROPOSED: dict[str, tuple[Callable[[], Any], str]] = {
    "half ball": (half_ball, "scenario.symmetry=y scenario.symmetry_at=0"),
    "half ball with a hole": (half_ball_with_a_hole, "scenario.symmetry=y scenario.symmetry_at=0"),
    "half duct": (half_duct, "scenario.symmetry=y scenario.symmetry_at=0"),
    "half duct turned": (lambda: half_duct().rotate_z(90.0), "scenario.symmetry=x scenario.symmetry_at="),
    "ball": (ball, ""),
    "tube": (tube, ""),
    "cone": (lambda: tube(0.5), ""),
    "slab": (lambda: strip(20), ""),
}


@pytest.mark.parametrize("name", PROPOSED)
def test_half_a_model_is_proposed(name: str, tmp_path: Path) -> None:
    made, way = PROPOSED[name]
    scenario = build(made(), tmp_path, **({"planar": "z"} if name == "slab" else {}))
    assert scenario.mirror is None
    if way:
        assert f"half a model? {way}" in scenario.notes["half model"]
        assert "of the open boundary lies in the plane" in scenario.notes["half model"]
    else:
        assert "half model" not in scenario.notes


def test_half_a_slab_and_half_a_curve(tmp_path: Path) -> None:
    slab = strip(40).clip("y", origin=(0.0, 0, 0), invert=False)
    proposed = build(slab.copy(), tmp_path, planar="z")
    assert "100% of the open boundary lies in the plane y = 0: half a model?" in proposed.notes["half model"]
    halved = build(slab, tmp_path, planar="z", symmetry="y")
    assert halved.mirror is not None
    assert halved.mirror.at == pytest.approx(0.0, abs=1e-12)
    assert "one half" in halved.notes["symmetry"]
    flat = ring(40)[:21]
    curve: Any = pv.PolyData(np.column_stack([flat, 0 * flat[:, 0]]), lines=np.array([21, *range(21)]))
    curve.point_data["s"] = np.ones((21, 3)) * [1.0, 0.5, 0.0]
    curve.save(tmp_path / "c.vtp")
    made = mesh(template=str(tmp_path / "c.vtp"), sensitivity="s", planar="z", symmetry="y")
    assert made.mirror is not None
    assert made.mirror.at == 0.0
    assert "one half" in made.notes["symmetry"]
