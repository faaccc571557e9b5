"""The brush, what it paints, and how a place on the screen becomes a place on the mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import painted
import pytest

from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.studio.brush import Brush, Spot, reach, reached
from rbfevo.studio.painting import Painting
from rbfevo.studio.picking import Camera, Surface
from rbfevo.studio.scene import CLAY, HELD, PULLED, PUSHED, Scene, colors_of

UP = np.array([0.0, 0.0, 1.0])


def spot(x: float, y: float, z: float = 0.0, normal: np.ndarray = UP) -> Spot:
    return Spot(np.array([x, y, z]), np.asarray(normal, np.float64))


def painting_of(made: tuple[np.ndarray, np.ndarray]) -> Painting:
    return Painting(*made)


def stroke(painting: Painting, brush: Brush, spots: Sequence[Spot | None], mirror: Mirror | None = None) -> bool:
    painting.begin(brush)
    for one in spots:
        painting.touch(one, mirror)
    return painting.end()


def test_the_reach_of_a_brush_fades_over_its_edge_as_its_formula_says() -> None:
    brush = Brush("pull", 2.0, 1.0, 0.5)
    distances = np.array([0.0, 0.9, 1.0, 1.25, 1.5, 1.75, 2.0, 3.0])
    t = np.array([0.0, 0.0, 0.0, 0.25, 0.5, 0.75, 1.0, 1.0])
    np.testing.assert_allclose(reach(brush, distances), 1.0 - 3.0 * t**2 + 2.0 * t**3, atol=1e-15)
    hard = Brush("pull", 2.0, 1.0, 0.0)
    np.testing.assert_array_equal(reach(hard, np.array([0.0, 1.999, 2.0])), [1.0, 1.0, 0.0])


def test_a_way_reaches_vertices_by_their_distance_from_it() -> None:
    vertices, triangles = painted.plate()
    normals = np.tile(UP, (len(vertices), 1))
    brush, begin, end = Brush("pull", 0.17, 1.0, 0.6), spot(0.2, 0.3), spot(0.7, 0.55)
    rows, shares = reached(brush, vertices, normals, begin, end)
    for row, vertex in enumerate(vertices):
        way = np.linspace(begin.point, end.point, 20_001)
        expected = float(reach(brush, np.linalg.norm(way - vertex, axis=1).min()[None])[0])
        found = shares[rows == row]
        assert (found[0] if len(found) else 0.0) == pytest.approx(expected, abs=1e-6)
    assert len(triangles)


def test_the_back_of_a_plate_is_left_out() -> None:
    vertices, _ = painted.plate()
    both = np.concatenate([vertices, vertices - (0.0, 0.0, 0.01)])
    normals = np.concatenate([np.tile(UP, (len(vertices), 1)), np.tile(-UP, (len(vertices), 1))])
    rows, _ = reached(Brush("pull", 0.2, 1.0), both, normals, spot(0.5, 0.5), spot(0.5, 0.5))
    assert len(rows)
    assert (rows < len(vertices)).all()


def test_a_stroke_does_not_depend_on_how_often_the_pointer_is_heard() -> None:
    brush = Brush("pull", 0.2, 0.1, 0.8)
    fields = []
    for count in (2, 5, 33):
        painting = painting_of(painted.plate())
        assert stroke(painting, brush, [spot(x, 0.5) for x in np.linspace(0.2, 0.8, count)])
        fields.append(painting.field)
    np.testing.assert_allclose(fields[1], fields[0], atol=1e-15)
    np.testing.assert_allclose(fields[2], fields[0], atol=1e-15)
    assert fields[0][:, 2].max() == pytest.approx(0.1)
    assert not fields[0][:, :2].any()


def test_a_brush_that_leaves_the_surface_paints_nothing_between() -> None:
    painting = painting_of(painted.plate())
    stroke(painting, Brush("pull", 0.1, 0.1), [spot(0.1, 0.5), None, spot(0.9, 0.5)])
    middle = np.abs(painting.vertices[:, 0] - 0.5) < 0.25
    assert not painting.field[middle].any()
    assert painting.field[~middle].any()


def test_pull_push_erase_and_directions() -> None:
    vertices, triangles = painted.ball()
    top, brush = spot(0.0, 0.0, 0.35), Brush("pull", 0.3, 0.05)
    pulled = Painting(vertices, triangles)
    stroke(pulled, brush, [top])
    row = int(np.argmax(vertices[:, 2]))
    np.testing.assert_allclose(pulled.field[row], 0.05 * pulled.normals[row], rtol=1e-6)
    assert pulled.field[row, 2] > 0.0
    stroke(pulled, brush._replace(action="push"), [top])  # takes back what was pulled
    np.testing.assert_allclose(pulled.field, 0.0, atol=1e-15)
    stroke(pulled, brush._replace(direction="x"), [top])
    np.testing.assert_allclose(pulled.field[row], [0.05, 0.0, 0.0], atol=1e-6)
    assert not pulled.field[:, 1:].any()
    before = pulled.field.copy()
    stroke(pulled, brush._replace(action="erase", radius=0.15), [top])
    shares = reach(brush._replace(radius=0.15), np.linalg.norm(vertices - top.point, axis=1))
    shares = np.where(pulled.normals[:, 2] > 0.0, shares, 0.0)
    np.testing.assert_allclose(pulled.field, (1.0 - shares)[:, None] * before, atol=1e-15)


def test_a_stroke_that_comes_back_erases_no_more_than_once() -> None:
    fields = []
    for ways in (1, 3):
        painting = painting_of(painted.plate())
        painting.replace(np.ones_like(painting.vertices))
        there = [spot(x, 0.5) for x in np.linspace(0.3, 0.7, 9)]
        stroke(painting, Brush("erase", 0.2, 1.0), [*there, *there[::-1], *there][: 9 * ways])
        fields.append(painting.field)
    np.testing.assert_allclose(fields[1], fields[0], atol=1e-15)
    assert fields[0].min() == pytest.approx(0.0, abs=1e-12)


def test_held_vertices_are_marked_and_released() -> None:
    painting = painting_of(painted.plate())
    brush = Brush("hold", 0.21, 1.0, 1.0)
    assert stroke(painting, brush, [spot(0.5, 0.5)])
    away = np.linalg.norm(painting.vertices - (0.5, 0.5, 0.0), axis=1)
    np.testing.assert_array_equal(painting.held, away < 0.21)
    assert not painting.field.any()
    stroke(painting, brush._replace(action="release", radius=0.11), [spot(0.5, 0.5)])
    np.testing.assert_array_equal(painting.held, (away < 0.21) & (away >= 0.11))


@pytest.mark.parametrize("direction", ["normal", "x", "y", "z"])
def test_a_mirrored_stroke_is_symmetric(direction: str) -> None:
    vertices, triangles = painted.ball()
    painting, mirror = Painting(vertices, triangles), Mirror(1, 0.0)
    spots = [spot(0.1, 0.3, 0.25, np.array([0.1, 0.7, 0.7])), spot(0.3, 0.1, 0.3, np.array([0.2, 0.2, 0.9]))]
    stroke(painting, Brush("pull", 0.25, 0.05, 1.0, direction), spots, mirror)
    image = vertices * (1.0, -1.0, 1.0)
    partner = [int(np.linalg.norm(vertices - one, axis=1).argmin()) for one in image]
    np.testing.assert_allclose(vertices[partner], image, atol=1e-12)
    np.testing.assert_allclose(painting.field[partner], painting.field * (1.0, -1.0, 1.0), atol=1e-12)
    sides = [painting.field[vertices[:, 1] * sign > 0.05].any() for sign in (1.0, -1.0)]
    assert sides == [True, True]


def test_strokes_are_undone_and_done_again_one_by_one() -> None:
    painting = painting_of(painted.plate())
    kept = [(painting.field.copy(), painting.held.copy())]
    for number, action in enumerate(("pull", "hold", "push", "erase", "release")):
        assert stroke(painting, Brush(action, 0.25, 0.1), [spot(0.2 + 0.12 * number, 0.5), spot(0.5, 0.6)])
        kept.append((painting.field.copy(), painting.held.copy()))
    assert not stroke(painting, Brush("pull", 0.01, 0.1), [None])
    for field, held in reversed(kept[:-1]):
        assert painting.undo()
        np.testing.assert_array_equal(painting.field, field)
        np.testing.assert_array_equal(painting.held, held)
    assert not painting.undo()
    assert painting.redoable == 5
    for field, held in kept[1:3]:
        assert painting.redo()
        np.testing.assert_array_equal(painting.field, field)
        np.testing.assert_array_equal(painting.held, held)
    assert stroke(painting, Brush("pull", 0.25, 0.1), [spot(0.9, 0.9)])
    assert not painting.redo()
    assert (painting.undoable, painting.redoable) == (3, 0)


def test_bad_brushes_and_fields_are_refused() -> None:
    painting = painting_of(painted.plate())
    for brush, message in (
        (Brush("carve", 1.0, 1.0), "action carve: choose one of pull, push, erase, hold, release"),
        (Brush("pull", 0.0, 1.0), "radius 0: give a positive length"),
        (Brush("pull", 1.0, float("nan")), "strength nan: give a positive length"),
        (Brush("pull", 1.0, 1.0, 1.5), "edge 1.5: give a number from 0"),
        (Brush("pull", 1.0, 1.0, 1.0, "u"), "direction u: choose one of normal, x, y, z"),
    ):
        with pytest.raises(UserError, match=message.split(":")[1]):
            painting.begin(brush)
    with pytest.raises(UserError, match="3 rows, and the mesh 441 vertices"):
        Painting(painting.vertices, painting.triangles, np.zeros((3, 3)))
    with pytest.raises(UserError, match="not finite"):
        Painting(painting.vertices, painting.triangles, np.full_like(painting.vertices, np.nan))


SENT = {"position": [2.0, -3.0, 1.5], "focalPoint": [0.1, 0.2, 0.0], "viewUp": [0.0, 0.1, 1.0]}
LENSES = [(30.0, False), (30.0, True), (75.0, False)]


def camera(angle: float, parallel: bool, aspect: float = 1.6) -> Camera:
    sent = {**SENT, "viewAngle": angle, "parallelProjection": parallel, "parallelScale": 0.8}
    return Camera.of(sent, aspect)


@pytest.mark.parametrize(("angle", "parallel"), LENSES)
def test_a_camera_sees_points_where_vtk_does(angle: float, parallel: bool) -> None:
    from vtkmodules.vtkRenderingCore import vtkCamera

    own, other = camera(angle, parallel), vtkCamera()
    other.SetPosition(*SENT["position"])
    other.SetFocalPoint(*SENT["focalPoint"])
    other.SetViewUp(*SENT["viewUp"])
    other.SetViewAngle(angle)
    other.SetParallelProjection(parallel)
    other.SetParallelScale(0.8)
    other.SetClippingRange(0.1, 100.0)
    matrix = other.GetCompositeProjectionTransformMatrix(1.6, -1.0, 1.0)
    rows = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    projected = np.column_stack([points, np.ones(20)]) @ rows.T
    expected = (1.0 + projected[:, :2] / projected[:, 3:] * (1.0, -1.0)) / 2.0
    np.testing.assert_allclose(own.places(points), expected, atol=1e-12)
    for point, (x, y) in zip(points, expected, strict=True):
        origin, direction = own.ray(x, y)
        away = point - origin
        np.testing.assert_allclose(away - (away @ direction) * direction, 0.0, atol=1e-12)
        np.testing.assert_allclose(own.dragged(point, x, y), point, atol=1e-12)
        moved = own.dragged(point, x + 0.1, y - 0.05)
        assert (moved - point) @ own.axes[2] == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(own.places(moved[None])[0], (x + 0.1, y - 0.05), atol=1e-12)


def test_a_point_behind_the_camera_has_no_place() -> None:
    own = camera(30.0, False)
    behind = own.position - 0.5 * own.axes[2]
    assert np.isnan(own.places(behind[None])).all()


@pytest.mark.parametrize("sent", [None, {}, {**SENT, "viewUp": [0, 0, 0]}, {**SENT, "position": SENT["focalPoint"]}])
def test_a_camera_that_sees_nothing_is_refused(sent: object) -> None:
    if isinstance(sent, dict) and sent:
        sent = {**sent, "viewAngle": 30.0, "parallelProjection": False, "parallelScale": 1.0}
    with np.errstate(invalid="ignore"), pytest.raises(UserError, match="the page sent"):
        Camera.of(sent, 1.5)


def hits_of(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> list[tuple[float, int]]:
    """How far along a ray it meets triangles [f, 3, 3], and which: each one's linear system solved."""
    found = []
    for cell, (a, b, c) in enumerate(corners):
        t, u, v = np.linalg.solve(np.column_stack([direction, a - b, a - c]), a - origin)
        if u >= 0.0 and v >= 0.0 and u + v <= 1.0 and t > 0.0:
            found.append((float(t), cell))
    return sorted(found)


def test_rays_hit_the_nearest_triangle() -> None:
    vertices, triangles = painted.ball(2)
    surface, corners = Surface(vertices, triangles), vertices[triangles]
    generator = np.random.default_rng(1)
    hits = 0
    for _ in range(40):
        origin = generator.normal(size=3)
        origin *= 3.0 / np.linalg.norm(origin)
        direction = generator.uniform(-0.6, 0.6, 3) - origin
        direction /= np.linalg.norm(direction)
        found = surface.hit(origin, direction)
        expected = hits_of(origin, direction, corners)
        if found is None:
            assert not expected
            continue
        (t, cell), *_ = expected
        a, b, c = corners[cell]
        normal = np.cross(b - a, c - a)
        np.testing.assert_allclose(found.point, origin + t * direction, atol=1e-8)
        np.testing.assert_allclose(found.normal, normal / np.linalg.norm(normal), atol=1e-10)
        hits += 1
    assert 5 < hits < 40


def test_colours_tell_which_way_and_what_stays() -> None:
    vertices, triangles = painted.plate()
    normals = np.tile(UP, (len(vertices), 1))
    field, held = np.zeros_like(vertices), np.zeros(len(vertices), bool)
    field[0], field[1], field[2], held[3] = (0.0, 0.0, 0.4), (0.0, 0.0, -0.4), (0.0, 0.0, 0.1), True
    colors = colors_of(field, normals, held).astype(int)
    assert colors[0].tolist() == list(PULLED)
    assert colors[1].tolist() == list(PUSHED)
    assert colors[3].tolist() == list(HELD)
    assert colors[4].tolist() == list(CLAY)
    np.testing.assert_allclose(colors[2], (np.array(PULLED) + CLAY) / 2.0, atol=0.51)  # the root of a quarter
    assert len(triangles)


def test_what_has_not_changed_is_not_sent_again() -> None:
    vertices, triangles = painted.ball(2)
    scene = Scene(vertices, triangles, "z")
    colors = colors_of(np.zeros_like(vertices), vertices, np.zeros(len(vertices), bool))
    scene.paint(colors)
    times = [scene._surface.GetMTime()]
    for act in (
        lambda: scene.show(vertices),
        lambda: scene.paint(colors.copy()),
        lambda: scene.show(vertices + 0.1, smooth=False),
        lambda: scene.show(vertices + 0.1),  # the normals are those of before until now
        lambda: scene.show(vertices + 0.1),
        lambda: scene.paint(colors // 2),
    ):
        act()
        times.append(scene._surface.GetMTime())
    assert (np.diff(times) > 0).tolist() == [False, False, True, True, False, True]
