"""The Sobolev filter: matrices beside integrals of linear elements, and what it does to known fields."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from rbfevo.geometry import sobolev

RANDOM = np.random.default_rng(7)
SHEET = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0.5], [0, 1, 0], [1, 2, 1]])
SHEET_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4]])


def ball(level: int) -> tuple[np.ndarray, np.ndarray]:
    made = trimesh.creation.icosphere(subdivisions=level, radius=1.0)
    return np.asarray(made.vertices, np.float64), np.asarray(made.faces, np.int64)


def by_gradients(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """K from the gradients of hat functions, which are known along two edges and zero along the normal."""
    found = np.zeros((len(vertices), len(vertices)))
    for triangle in triangles:
        a, b, c = vertices[triangle]
        normal = np.cross(b - a, c - a)
        frame = np.stack([b - a, c - a, normal])
        gradients = np.linalg.solve(frame, np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))
        found[np.ix_(triangle, triangle)] += np.linalg.norm(normal) / 2.0 * gradients.T @ gradients
    return found


def filtered(vertices: np.ndarray, triangles: np.ndarray, density: np.ndarray, length: float) -> np.ndarray:
    return sobolev.smoothed(density, sobolev.mass(vertices, triangles), sobolev.stiffness(vertices, triangles), length)


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_the_stiffness_is_the_integral_of_gradients(size):
    found = sobolev.stiffness(size * SHEET, SHEET_TRIANGLES).toarray()
    np.testing.assert_allclose(found, by_gradients(SHEET, SHEET_TRIANGLES), atol=1e-14)
    right = sobolev.stiffness(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])).toarray()
    np.testing.assert_allclose(right, [[1.0, -0.5, -0.5], [-0.5, 0.5, 0.0], [-0.5, 0.0, 0.5]], atol=1e-15)


def test_the_mass_is_a_third_of_the_areas():
    found = sobolev.mass(SHEET[:4] * [1, 1, 0], np.array([[0, 1, 2], [0, 2, 3]]))
    np.testing.assert_allclose(found, [2 / 3, 1 / 3, 2 / 3, 1 / 3])


def test_the_operator_is_symmetric_and_positive():
    vertices, triangles = ball(2)
    stiffness = sobolev.stiffness(vertices, triangles).toarray()
    np.testing.assert_allclose(stiffness, stiffness.T, atol=1e-14)
    np.testing.assert_allclose(stiffness.sum(axis=1), 0.0, atol=1e-13)
    assert np.linalg.eigvalsh(stiffness)[0] > -1e-12
    mass = sobolev.mass(vertices, triangles)
    one, other = RANDOM.normal(size=(2, len(vertices), 1))
    left, right = (
        (mass[:, None] * u * filtered(vertices, triangles, v, 0.4)).sum() for u, v in ((one, other), (other, one))
    )
    assert left == pytest.approx(right, rel=1e-12)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("length", [1e-3, 0.3, 30.0])
def test_constants_stay_and_the_integral_is_conserved(length, size):
    vertices, triangles = ball(2)
    vertices = size * vertices * [1.0, 0.4, 2.0]
    mass = sobolev.mass(vertices, triangles)
    constant = np.tile([2.0, -1.0, 0.0], (len(vertices), 1))
    np.testing.assert_allclose(filtered(vertices, triangles, constant, size * length), constant, atol=1e-9)
    field = RANDOM.normal(size=(len(vertices), 3))
    found = filtered(vertices, triangles, field, size * length)
    np.testing.assert_allclose(mass @ found, mass @ field, atol=1e-9 * mass.sum())
    assert (mass @ found**2 < mass @ field**2).all()


def test_no_length_changes_nothing():
    field = RANDOM.normal(size=(len(SHEET), 2))
    np.testing.assert_array_equal(filtered(SHEET, SHEET_TRIANGLES, field, 0.0), field)


@pytest.mark.parametrize(
    ("degree", "harmonic"),
    [
        (1, lambda x, y, z: z),
        (2, lambda x, y, z: x * y),
        (3, lambda x, y, z: z * (5 * z**2 - 3)),
        (4, lambda x, y, z: x * y * (7 * z**2 - 1)),
    ],
)
def test_spherical_harmonics_are_divided_by_their_eigenvalue_with_order_two(degree, harmonic):
    length, errors = 0.5, []
    for level in (3, 4, 5):
        vertices, triangles = ball(level)
        field = harmonic(*vertices.T)[:, None]
        expected = field / (1.0 + length**2 * degree * (degree + 1))
        mass = sobolev.mass(vertices, triangles)
        errors.append(
            np.sqrt(mass @ (filtered(vertices, triangles, field, length) - expected) ** 2 / (mass @ expected**2))[0]
        )
    rates = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert errors[-1] < 1e-2
    np.testing.assert_allclose(rates, 2.0, atol=0.2)


def strip(count: int, length: float) -> tuple[np.ndarray, np.ndarray]:
    x = np.linspace(0.0, length, count)
    vertices = np.array([[a, b, 0.0] for a in x for b in (0.0, x[1])])
    k = 2 * np.arange(count - 1)[:, None]
    return vertices, np.concatenate([k + np.array([0, 2, 3]), k + np.array([0, 3, 1])])


def test_nothing_flows_over_an_open_rim():
    """A step on a strip of length L: the solution with zero slope at both ends, by cosines."""
    vertices, triangles = strip(401, 1.0)
    x, length = vertices[:, 0], 0.3
    found = filtered(vertices, triangles, (x < 0.25)[:, None].astype(float), length)[:, 0]
    expected = np.full(len(x), 0.25)
    for k in range(1, 2000):
        wave = k * np.pi
        expected += 2.0 * np.sin(wave * 0.25) / wave / (1.0 + (length * wave) ** 2) * np.cos(wave * x)
    np.testing.assert_allclose(found, expected, atol=5e-3)


def test_pieces_do_not_influence_each_other():
    vertices, triangles = ball(2)
    both = np.concatenate([vertices, vertices + 0.1]), np.concatenate([triangles, triangles + len(vertices)])
    field = RANDOM.normal(size=(len(vertices), 2))
    found = filtered(*both, np.concatenate([field, 0 * field]), 0.7)
    np.testing.assert_allclose(found[: len(vertices)], filtered(vertices, triangles, field, 0.7), atol=1e-12)
    assert not found[len(vertices) :].any()


def test_an_edge_of_three_triangles_sums_over_all():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 0, 1], [0.5, -1, -1]])
    triangles = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    stiffness = sobolev.stiffness(vertices, triangles).toarray()
    np.testing.assert_allclose(stiffness, by_gradients(vertices, triangles), atol=1e-14)
    field = RANDOM.normal(size=(5, 1))
    mass = sobolev.mass(vertices, triangles)
    dense = np.linalg.solve(np.diag(mass) + 0.49 * by_gradients(vertices, triangles), mass[:, None] * field)
    np.testing.assert_allclose(filtered(vertices, triangles, field, 0.7), dense, atol=1e-13)


@pytest.mark.parametrize("height", [0.0, 1e-12, 1e-9, 1e-6])
def test_flat_triangles_leave_everything_finite(height):
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, -height, 0], [5.0, 5, 5], [0.0, 0, 0]])
    triangles = np.array([[0, 1, 2], [1, 0, 3], [4, 4, 4], [0, 5, 0]])
    field = RANDOM.normal(size=(6, 3))
    found = filtered(vertices, triangles, field, 0.5)
    assert np.isfinite(found).all()
    assert not found[4:].any()  # without area
    if height < 1e-8:  # its cotangents are left out, and those of the other triangle are as before
        np.testing.assert_allclose(
            sobolev.stiffness(vertices, triangles).toarray()[:3, :3], by_gradients(vertices[:3], triangles[:1])
        )
