"""Topology of triangle meshes: every oddity is told, winding is mended, normals and areas are those of known shapes."""

import numpy as np
import pytest
import trimesh

from rbfevo.geometry import topology
from rbfevo.geometry.crossings import piercing_edges

BALL = trimesh.creation.icosphere(subdivisions=2, radius=3.0)
BOX = trimesh.creation.box(extents=(1.0, 2.0, 3.0))
FAN = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]])


def parts(*meshes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    faces = [np.asarray(faces) + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def ball(center: float = 0.0, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(BALL.vertices) * size + [center, 0.0, 0.0], np.asarray(BALL.faces, np.int64)


def strip(twisted: bool, count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """A band once around: a cylinder, or a Moebius strip."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    lean = angle / 2.0 if twisted else np.zeros(count)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    side = 0.2 * (np.cos(lean)[:, None] * [0.0, 0.0, 1.0] + np.sin(lean)[:, None] * ring)
    vertices = np.concatenate([ring - side, ring + side])
    a, b = np.arange(count), (np.arange(count) + 1) % count
    c, d = b + count, a + count
    if twisted:
        c[-1], b[-1] = 0, count
    return vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def test_a_sound_closed_surface_needs_no_word():
    assert topology.oddities(*ball()) == {}


def test_open_boundary():
    vertices, triangles = strip(twisted=False)
    found = topology.oddities(vertices, triangles)
    assert found == {"open boundary": "40 of 80 edges belong to one triangle only"}


def test_non_manifold_edges():
    found = topology.oddities(FAN, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert found["non-manifold edges"].startswith("1 of 7 edges")


def test_pieces():
    found = topology.oddities(*parts(ball(), ball(10.0), (np.asarray(BOX.vertices) + 50.0, BOX.faces)))
    assert found == {"pieces": f"3 pieces that share no vertex; the largest has {len(BALL.vertices)} vertices"}


def test_winding():
    vertices, triangles = ball()
    triangles = triangles.copy()
    triangles[7] = triangles[7, ::-1]
    assert topology.oddities(vertices, triangles) == {"winding": "at 3 edges the two triangles have opposite winding"}


def test_inside_out():
    vertices, triangles = ball()
    found = topology.oddities(*parts((vertices + 1e4, triangles[:, ::-1]), ball(-50.0)))
    assert found["inside out"] == "1 of 2 closed pieces have normals that point inwards"
    vertices, triangles = strip(twisted=False)
    assert "inside out" not in topology.oddities(vertices, triangles[:, ::-1])


@pytest.mark.parametrize(("shift", "expected"), [(1.0, True), (5.9, True), (6.1, False), (20.0, False)])
def test_crossings(shift, expected):
    assert ("crossings" in topology.oddities(*parts(ball(), ball(shift)))) == expected


def test_crossings_agree_with_plane_by_plane():
    draw = np.random.default_rng(5)
    vertices = draw.uniform(size=(36, 3))
    triangles = np.arange(36).reshape(-1, 3)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    pierced = set()
    for k, (p, q) in enumerate(vertices[edges]):
        for t, (a, b, c) in enumerate(vertices[triangles]):
            if k % len(triangles) == t:
                continue
            s, u, v = np.linalg.solve(np.stack([q - p, a - b, a - c], axis=1), a - p)
            if 0 < s < 1 and u > 0 and v > 0 and u + v < 1:
                pierced.add(k)
    assert len(pierced) > 5
    assert piercing_edges(vertices, triangles, edges).tolist() == sorted(pierced)


def test_seams_and_touches_are_no_crossings():
    soup = np.asarray(BALL.triangles).reshape(-1, 3)
    assert "crossings" not in topology.oddities(soup, np.arange(len(soup)).reshape(-1, 3))
    base = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, 0], [1, 2, 3], [2, 1, 3]])  # a corner upon a face
    assert "crossings" not in topology.oddities(base, np.array([[0, 1, 2], [3, 4, 5]]))
    base[3, 2] = -0.1
    assert topology.oddities(base, np.array([[0, 1, 2], [3, 4, 5]]))["crossings"].endswith("2 edges pierce a triangle")


def test_crossings_of_a_large_mesh_are_not_looked_for(monkeypatch):
    monkeypatch.setattr(topology, "MOST_TRIANGLES", len(BALL.faces) - 1)
    assert topology.oddities(*ball())["crossings"].startswith("self-intersections were not searched for")


def consistent(triangles: np.ndarray) -> bool:
    runs = [tuple(run) for t in triangles.tolist() for run in zip(t, t[1:] + t[:1], strict=True)]
    return len(runs) == len(set(runs))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
def test_closed_pieces_are_wound_outward(share):
    vertices, triangles = parts(ball(), ball(10.0, 0.1), (np.asarray(BOX.vertices) - 50.0, BOX.faces))
    turned = np.random.default_rng(0).uniform(size=len(triangles)) < share
    given = np.where(turned[:, None], triangles[:, ::-1], triangles)
    wound, count = topology.oriented(vertices, given)
    assert count == turned.sum()
    assert consistent(wound)
    normals = np.cross(*np.moveaxis(np.diff(vertices[wound], axis=1), 1, 0))
    expected = np.cross(*np.moveaxis(np.diff(vertices[triangles], axis=1), 1, 0))
    np.testing.assert_allclose(normals, expected, atol=1e-9)
    np.testing.assert_array_equal(np.sort(wound, axis=1), np.sort(given, axis=1))


def test_an_open_piece_is_wound_as_most_of_it():
    vertices, triangles = strip(twisted=False)
    few = triangles.copy()
    few[3:8] = few[3:8, ::-1]
    wound, count = topology.oriented(vertices, few)
    assert (count, consistent(wound)) == (5, True)
    most = triangles[:, ::-1].copy()
    most[0] = most[0, ::-1]
    assert topology.oriented(vertices, most)[1] == 1


def test_a_moebius_strip_keeps_a_clash():
    vertices, triangles = strip(twisted=True)
    wound, _ = topology.oriented(vertices, triangles)
    assert "winding" in topology.oddities(vertices, wound)
    np.testing.assert_array_equal(np.sort(wound, axis=1), np.sort(triangles, axis=1))


def test_winding_of_odd_meshes():
    book = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert topology.oriented(FAN, book)[1] == 0  # an edge with three triangles joins none of them
    assert topology.oriented(FAN, book[:1])[0].tolist() == [[0, 1, 2]]
    pillow = np.array([[0, 1, 2], [0, 1, 2]])  # two triangles with three common edges
    wound, count = topology.oriented(FAN, pillow)
    assert count == 1
    assert consistent(wound)


def test_normals_of_a_sphere():
    vertices, triangles = ball()
    normals = topology.vertex_normals(vertices, triangles)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-14)
    assert np.einsum("ij,ij->i", normals, vertices).min() > 0.999 * 3.0
    np.testing.assert_allclose(topology.vertex_normals(vertices * 1e60, triangles), normals, atol=1e-12)


def test_normals_are_weighted_with_the_area():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 3, 0], [0, 0, 1]])
    triangles = np.array([[0, 1, 2], [0, 3, 4]])  # areas 1/2 up z, 3/2 along x
    normals = topology.vertex_normals(vertices, triangles)
    np.testing.assert_allclose(normals[0], np.array([3.0, 0.0, 1.0]) / np.sqrt(10.0))
    np.testing.assert_allclose(normals[4], [1.0, 0.0, 0.0])
    cancelled = topology.vertex_normals(vertices, np.array([[0, 1, 2], [0, 2, 1]]))
    np.testing.assert_array_equal(cancelled, 0.0)


def test_areas_add_up():
    vertices, triangles = ball()
    areas = topology.vertex_areas(vertices, triangles)
    assert areas.shape == (len(vertices),)
    assert areas.sum() == pytest.approx(BALL.area, rel=1e-12)
    np.testing.assert_allclose(topology.vertex_areas(FAN[:3], np.array([[0, 1, 2]])), 0.5 / 3.0)


def test_the_wall_of_a_cavity_points_into_it() -> None:
    """A hollow ball is closed and right as it is; turned inside out as a whole, only its outer wall is turned."""
    outer, inner = trimesh.creation.icosphere(2), trimesh.creation.icosphere(1, radius=0.4)
    n = len(outer.vertices)
    vertices = np.concatenate([outer.vertices, inner.vertices])
    triangles = np.concatenate([outer.faces, inner.faces[:, ::-1] + n])
    assert set(topology.oddities(vertices, triangles)) == {"pieces"}
    assert topology.oriented(vertices, triangles)[1] == 0
    solid = np.concatenate([outer.faces[:, ::-1], inner.faces + n])
    assert "1 of 2 closed pieces" in topology.oddities(vertices, solid)["inside out"]
    assert topology.oriented(vertices, solid)[1] == len(outer.faces)
