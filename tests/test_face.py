"""The sphere and the face: closest points against brute force, what is rejected, frames, notes and refusals."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
import trimesh

from rbfevo.errors import UserError
from rbfevo.geometry import correspondence, placement
from rbfevo.scenarios import face, plane
from rbfevo.scenarios.coarse import coarsened
from rbfevo.scenarios.face import average_face


@pytest.fixture(scope="module")
def built_in():
    return face()


@pytest.fixture(scope="module")
def placed_face():
    vertices, triangles = average_face()
    vertices, triangles = placement.merge_coincident(placement.turn(vertices, "z", "y"), triangles)
    assert triangles is not None
    return placement.fit_box(vertices)[0], triangles


def hemisphere(rings: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A closed grid over the front (z >= 0) half of the unit sphere; its only open boundary is the equator."""
    around = 3 * rings
    polar = np.linspace(0.0, np.pi / 2.0, rings + 1)[1:]
    azimuth = np.arange(around) * 2.0 * np.pi / around
    p, a = (grid.ravel() for grid in np.meshgrid(polar, azimuth, indexing="ij"))
    vertices = np.concatenate(
        [[[0.0, 0.0, 1.0]], np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=1)]
    )
    triangles = [(0, 1 + k, 1 + (k + 1) % around) for k in range(around)]
    for ring, k in itertools.product(range(rings - 1), range(around)):
        i, j = 1 + ring * around + k, 1 + ring * around + (k + 1) % around
        triangles += [(i, i + around, j + around), (i, j + around, j)]
    return vertices, np.array(triangles)


def distance_by_hand(point: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Distance of a point to a surface: the least over every triangle's foot point and every edge's closest point."""
    corners = vertices[triangles]
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    system = np.ones((len(triangles), 4, 4))  # point = barycentric weights * corners + height * normal
    system[:, :3, :3], system[:, :3, 3], system[:, 3, 3] = corners.transpose(0, 2, 1), normal, 0.0
    weights = np.linalg.solve(system, np.broadcast_to(np.append(point, 1.0)[:, None], (len(triangles), 4, 1)))[..., 0]
    best = np.abs(weights[(weights[:, :3] >= 0.0).all(axis=1), 3]).min(initial=np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        t = (((point - start) * (end - start)).sum(axis=1) / ((end - start) ** 2).sum(axis=1)).clip(0.0, 1.0)
        best = min(best, np.linalg.norm(point - start - t[:, None] * (end - start), axis=1).min())
    return float(best)


# closest points


def test_closest_points_match_brute_force(placed_face):
    vertices, triangles = placed_face
    draw = np.random.default_rng(0)
    points = np.concatenate([draw.normal(size=(60, 3)), draw.uniform(-1.0, 1.0, (40, 3))])
    closest, triangle = correspondence.closest_on_surface(points, vertices, triangles)
    assert closest.dtype == np.float64
    expected = [distance_by_hand(point, vertices, triangles) for point in points]
    np.testing.assert_allclose(np.linalg.norm(closest - points, axis=1), expected, rtol=1e-12, atol=1e-12)
    for point, index in zip(closest, triangle, strict=True):
        assert distance_by_hand(point, vertices, triangles[index][None]) < 1e-12


def test_closest_points_of_a_cloud_match_brute_force():
    draw = np.random.default_rng(1)
    points, cloud = draw.normal(size=(60, 3)), draw.normal(size=(400, 3))
    closest, index = correspondence.closest_in_cloud(points, cloud)
    expected = np.linalg.norm(points[:, None] - cloud, axis=2).argmin(axis=1)
    np.testing.assert_array_equal(index, expected)
    np.testing.assert_array_equal(closest, cloud[expected])


# rejection


def test_boundary_of_a_square():
    side = np.linspace(0.0, 1.0, 5)
    vertices = np.array([(x, y, 0.0) for y in side for x in side])
    corner = [x + 5 * y for y in range(4) for x in range(4)]
    triangles = np.array([t for i in corner for t in ((i, i + 1, i + 6), (i, i + 6, i + 5))])
    inside = [
        (0.5, 0.5, 1.0),
        (0.25, 0.25, -2.0),
        (0.25, 0.6, 0.3),
        (0.3, 0.3, 0.0),
        (0.999, 0.5, 0.1),
        (0.9, 0.9, 5.0),
    ]
    outside = [(1.5, 0.5, 1.0), (1.0, 0.5, 0.7), (-1.0, -1.0, 0.0), (0.3, -0.1, 0.0), (2.0, 2.0, 2.0), (0.0, 1.0, 0.0)]
    points = np.array(inside + outside)
    closest, triangle = correspondence.closest_on_surface(points, vertices, triangles)
    rejected = correspondence.on_open_boundary(closest, triangle, vertices, triangles)
    assert rejected.tolist() == [False] * len(inside) + [True] * len(outside)


def test_a_closed_surface_rejects_nothing():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.7)
    vertices, triangles = np.asarray(ball.vertices), np.asarray(ball.faces)
    points = np.random.default_rng(2).normal(size=(300, 3))
    points = np.concatenate([points, vertices * 1.3])  # some end exactly on a vertex
    closest, triangle = correspondence.closest_on_surface(points, vertices, triangles)
    assert not correspondence.on_open_boundary(closest, triangle, vertices, triangles).any()


def test_a_hemisphere_is_met_by_the_front_only():
    vertices, triangles = hemisphere()
    points = np.random.default_rng(3).normal(size=(2000, 3))
    points = 1.4 * points / np.linalg.norm(points, axis=1, keepdims=True)
    closest, triangle = correspondence.closest_on_surface(points, vertices, triangles)
    rejected = correspondence.on_open_boundary(closest, triangle, vertices, triangles)
    clear = np.abs(points[:, 2]) > 0.1  # the facets lean a little at the equator
    np.testing.assert_array_equal(rejected[clear], points[clear, 2] < 0.0)


@pytest.mark.parametrize("spread", ["spiral", "random"])
@pytest.mark.parametrize("n", [1000, 8000])
def test_the_rim_of_a_cloud(n, spread):
    if spread == "spiral":
        z = (np.arange(n) + 0.5) / n
        azimuth = np.arange(n) * np.pi * (3.0 - np.sqrt(5.0))
    else:
        z, azimuth = np.random.default_rng(4).uniform(size=(2, n)) * [[1.0], [2.0 * np.pi]]
    cloud = np.stack([np.sqrt(1.0 - z**2) * np.cos(azimuth), np.sqrt(1.0 - z**2) * np.sin(azimuth), z], axis=1)
    points = np.random.default_rng(5).normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    _, index = correspondence.closest_in_cloud(points, cloud)
    rejected = correspondence.beyond_rim(points, index, cloud)
    spacing = np.sqrt(2.0 * np.pi / n)
    front, back = points[:, 2] > 3.0 * spacing, points[:, 2] < -3.0 * spacing
    assert rejected[back].mean() > 0.99
    assert rejected[front].mean() < 0.01


@pytest.mark.parametrize("n", [2, 3, 5, 30])
def test_tiny_clouds_are_judged_without_trouble(n):
    draw = np.random.default_rng(n)
    cloud, points = draw.normal(size=(n, 3)), draw.normal(size=(50, 3))
    _, index = correspondence.closest_in_cloud(points, cloud)
    assert correspondence.beyond_rim(points, index, cloud).shape == (50,)


def test_pairs_from_behind_whatever_the_orientation():
    vertices, triangles = hemisphere()
    points = np.array([[0.0, 0.0, 1.5], [0.5, 0.5, 1.2], [0.2, 0.9, 0.9], [0.1, 0.0, 0.5]])
    outward = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.7, 0.7], [0.0, 0.0, -1.0]])
    _, triangle = correspondence.closest_on_surface(points, vertices, triangles)
    for faces in (triangles, triangles[:, ::-1]):
        behind = correspondence.from_behind(triangle, outward, np.ones(4, bool), vertices, faces)
        assert behind.tolist() == [False, False, False, True]
        kept = np.array([True, True, True, False])
        assert not correspondence.from_behind(triangle, outward, kept, vertices, faces).any()


# the built-in face


def test_built_in_face(built_in, placed_face):
    assert built_in.name == "face"
    assert built_in.vertices.shape == (10242, 3)
    assert built_in.faces.shape == (20480, 3)
    assert built_in.gradient.shape == (10242, 3)
    assert {built_in.vertices.dtype, built_in.gradient.dtype} == {torch.float64}
    assert built_in.lower.tolist() == [-1.0] * 3
    assert built_in.upper.tolist() == [1.0] * 3
    assert built_in.support == 1.0
    torch.testing.assert_close(built_in.vertices.norm(dim=1), torch.ones(10242, dtype=torch.float64))
    assert built_in.gradient.norm().item() == pytest.approx(1.0, abs=1e-13)

    moved = (built_in.gradient.norm(dim=1) > 0.0).numpy()
    x = built_in.vertices.numpy()
    reached = x[moved] + built_in.gradient.numpy()[moved] * built_in.gradient_norm
    on_scan, _ = correspondence.closest_on_surface(reached, *placed_face)
    assert np.linalg.norm(reached - on_scan, axis=1).max() < 1e-12
    assert not moved[x[:, 2] < 0.0].any()  # the back of the sphere stays
    assert moved[x[:, 2] > 0.75].all()  # its front becomes the face
    assert f"{(~moved).sum()} of 10242 vertices have no pair and stay" in built_in.notes["rejected"]
    assert "fsaverage" in built_in.notes["scan"]
    assert "average MRI head" in built_in.notes["scan"]


def test_built_in_scan_is_a_face(placed_face):
    vertices, triangles = placed_face
    assert len(vertices) == 1008
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    np.testing.assert_allclose([low[1], high[1], high[2]], [-1.0, 1.0, 1.0], atol=1e-9)
    assert high[0] == pytest.approx(-low[0])
    assert np.abs(vertices).max() <= 1.0
    nose = vertices[vertices[:, 2].argmax()]
    assert abs(nose[0]) < 0.05  # in the middle, a little below the centre
    assert -0.6 < nose[1] < -0.1
    normals = np.cross(*np.moveaxis(np.diff(vertices[triangles], axis=1), 1, 0))
    assert (normals[:, 2] > 0.0).mean() > 0.85  # most of it looks to the front


def test_reject_none_keeps_every_pair(built_in):
    everything = face(reject="none")
    assert (everything.gradient.norm(dim=1) > 0.0).sum() > 10200
    kept = built_in.gradient.norm(dim=1) > 0.0
    torch.testing.assert_close(
        everything.gradient[kept] * everything.gradient_norm, built_in.gradient[kept] * built_in.gradient_norm
    )
    assert everything.notes["rejected"].startswith("0 of 10242")


@pytest.mark.parametrize("subdivisions", [1, 3])
def test_subdivisions(subdivisions):
    assert len(face(subdivisions=subdivisions).vertices) == 10 * 4**subdivisions + 2


def test_the_same_twice(built_in):
    again = face()
    assert torch.equal(again.gradient, built_in.gradient)
    assert torch.equal(again.vertices, built_in.vertices)


def test_sampler_is_uniform_on_the_sphere_and_seeded(built_in):
    first = built_in.sample(300, 25, torch.Generator().manual_seed(1))
    assert first.shape == (300, 25, 3)
    assert first.dtype == torch.float64
    assert torch.equal(first, built_in.sample(300, 25, torch.Generator().manual_seed(1)))
    assert not torch.equal(first, built_in.sample(300, 25, torch.Generator().manual_seed(2)))
    torch.testing.assert_close(first.norm(dim=-1), torch.ones(300, 25, dtype=torch.float64))
    for axis in range(3):  # each coordinate of a uniform point on the sphere is uniform in [-1, 1] (Archimedes)
        counts = torch.histc(first[..., axis], bins=10, min=-1.0, max=1.0)
        assert ((counts - 750.0) ** 2 / 750.0).sum().item() < 27.9  # 0.999 quantile for 9 degrees of freedom


def test_what_a_fit_needs(built_in, placed_face):
    """The pairs it was made of: closest points at the start are the wanted displacement, but for those that stay."""
    assert built_in.stays.shape == (10242,)
    wanted = built_in.gradient * built_in.gradient_norm
    assert torch.equal(built_in.stays, (wanted == 0).all(dim=1))
    fitted = (~built_in.stays).numpy()
    start = built_in.vertices.numpy()[fitted]
    np.testing.assert_allclose(built_in.closest(start) - start, wanted.numpy()[fitted], atol=1e-12)
    points = np.random.default_rng(8).normal(size=(7, 3))
    expected, _ = correspondence.closest_on_surface(points, *placed_face)
    np.testing.assert_array_equal(built_in.closest(points), expected)
    assert built_in.closest(points[:0]).shape == (0, 3)
    moved = built_in.to(torch.device("cpu"))
    assert torch.equal(moved.stays, built_in.stays)
    assert moved.closest is built_in.closest


def test_a_plane_has_a_fixed_target_and_a_coarse_face_too(built_in):
    assert plane((5, 5)).closest is None
    assert plane((5, 5)).to(torch.device("cpu")).stays is None
    fewer = coarsened(built_in, 500)
    assert fewer.closest is None
    assert fewer.stays is None
    with pytest.raises(UserError, match="do not match"):
        dataclasses.replace(built_in, stays=built_in.stays[:-1])


# scans of the user


def write_obj(path, vertices, triangles, seams=False):
    if seams:  # every triangle has its own vertices, as some exporters write them
        vertices, triangles = vertices[triangles].reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    path.write_text("\n".join(lines + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles.tolist()]))
    return path


def test_units_place_and_axes_of_a_scan_do_not_matter(tmp_path, placed_face):
    vertices, triangles = placed_face
    scan = face(subdivisions=3, scan=write_obj(tmp_path / "a.obj", vertices, triangles))
    same = face(subdivisions=3)
    torch.testing.assert_close(scan.gradient, same.gradient, rtol=0.0, atol=1e-10)
    turned = np.stack([vertices[:, 2], -vertices[:, 0], -vertices[:, 1]], axis=1) * 160.0 + [4e3, -7.0, 55.0]
    path = write_obj(tmp_path / "b.obj", turned, triangles, seams=True)
    other = face(subdivisions=3, scan=path, up="-z", front="x")
    torch.testing.assert_close(other.gradient, same.gradient, rtol=0.0, atol=1e-8)
    assert str(path) in other.notes["scan"]


def test_a_cloud_of_the_face_gives_nearly_the_gradient_of_its_surface(tmp_path, placed_face, built_in):
    mesh = trimesh.Trimesh(*placed_face, process=False)
    cloud = trimesh.sample.sample_surface(mesh, 20000, seed=0)[0]
    path = tmp_path / "cloud.csv"
    np.savetxt(path, cloud, delimiter=";", header="x;y;z", comments="")
    from_cloud = face(scan=path)
    assert "a cloud" in from_cloud.notes["scan size"]
    points = np.random.default_rng(6).normal(size=(50, 3))
    assert from_cloud.closest is not None
    assert from_cloud.stays is not None
    ends = from_cloud.closest(points)
    np.testing.assert_allclose(
        np.linalg.norm(ends - points, axis=1), np.linalg.norm(points - built_in.closest(points), axis=1), atol=0.06
    )
    stays = [scenario.gradient.norm(dim=1) == 0.0 for scenario in (built_in, from_cloud)]
    assert torch.equal(stays[1], from_cloud.stays)
    assert (stays[0] != stays[1]).double().mean() < 0.02
    kept = ~(stays[0] | stays[1])
    difference = (from_cloud.gradient * from_cloud.gradient_norm - built_in.gradient * built_in.gradient_norm)[kept]
    assert difference.norm(dim=1).median() < 0.02


def test_a_stray_point_changes_next_to_nothing(tmp_path):
    cloud = trimesh.sample.sample_surface(trimesh.Trimesh(*hemisphere(), process=False), 3000, seed=1)[0]
    clean, stray = tmp_path / "clean.xyz", tmp_path / "stray.xyz"
    np.savetxt(clean, cloud)
    np.savetxt(stray, np.concatenate([cloud, [[0.0, 90.0, -40.0]]]))
    results = [face(subdivisions=3, scan=path) for path in (clean, stray)]
    torch.testing.assert_close(results[0].gradient, results[1].gradient)
    assert "1 stray vertices dropped" in results[1].notes["scan size"]


# refusals


@pytest.mark.parametrize("subdivisions", [0, 9, -1, 2.0, "3", True, None])
def test_bad_subdivisions(subdivisions):
    with pytest.raises(UserError, match="whole number from 1 to 8"):
        face(subdivisions=subdivisions)


@pytest.mark.parametrize("reject", ["all", "", None, "Boundary"])
def test_bad_reject(reject):
    with pytest.raises(UserError, match="one of boundary, none"):
        face(reject=reject)


@pytest.mark.parametrize(("up", "front"), [("y", "y"), ("z", None), ("w", "x"), ("y", "-y")])
def test_bad_axes_of_a_scan(tmp_path, up, front):
    path = write_obj(tmp_path / "a.obj", *hemisphere(3))
    with pytest.raises(UserError, match=r"^scenario\.(up|front)="):
        face(subdivisions=1, scan=path, up=up, front=front)


def test_missing_scan(tmp_path):
    with pytest.raises(UserError, match=r"nobody\.ply: no such file"):
        face(scan=tmp_path / "nobody.ply")


def test_every_pair_rejected(tmp_path):
    sliver = np.array([[0.0, 0.0, 0.0], [3.0, 10.0, 0.0], [1.50001, 5.0, 0.0]])
    path = write_obj(tmp_path / "sliver.obj", sliver, np.array([[0, 1, 2]]))
    with pytest.raises(UserError, match="all pairs of sphere and scan are rejected"):
        face(subdivisions=2, scan=path)
    everything = face(subdivisions=2, scan=path, reject="none")
    assert (everything.gradient.norm(dim=1) > 0.0).sum() >= 161  # the vertex (0, 0, 1) is there already


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_seams_close_and_small_triangles_stay_in_any_unit(scale):
    ball = trimesh.creation.icosphere(subdivisions=2)
    whole, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    # Every triangle has corners of its own, which miss each other by far less than 1e-6 of the size.
    corners = whole[faces].reshape(-1, 3) + np.random.default_rng(0).uniform(-1e-7, 1e-7, (3 * len(faces), 3))
    points, merged = placement.merge_coincident(scale * corners, np.arange(len(corners)).reshape(-1, 3))
    assert points.shape == whole.shape
    assert merged is not None
    assert merged.shape == faces.shape
    # But 1e-5 of the size is a distance.
    two = np.concatenate([whole, [whole[0] + [1e-5, 0.0, 0.0]]])
    kept, _ = placement.merge_coincident(scale * two, None)
    assert len(kept) == len(whole) + 1


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
@pytest.mark.parametrize(("share", "rejected"), [(0.4, False), (0.6, True), (0.9, True)])
def test_a_pair_is_rejected_from_half_a_spacing_beyond_the_rim(share, rejected, scale):
    x, y = np.meshgrid(np.arange(21.0), np.arange(21.0), indexing="ij")
    cloud = scale * np.stack([x.ravel(), y.ravel(), np.zeros(441)], axis=1)
    end = 10  # (0, 10), in the middle of the rim
    distance = np.sort(np.linalg.norm(cloud - cloud[end], axis=1))[1:25]
    point = cloud[[end]] - [share * distance.mean(), 0.0, 0.3 * scale]  # upwards does not count
    assert correspondence.beyond_rim(point, np.array([end]), cloud).tolist() == [rejected]
