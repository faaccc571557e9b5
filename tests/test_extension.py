"""Displacements carried along the edges of a mesh, against a dense solution and by value."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from grids import EDGES, hexahedra

from rbfevo.errors import UserError
from rbfevo.geometry.extension import Extension, laplacian


def grid() -> tuple[Any, Any, Any]:
    """A graded grid of 6 x 5 x 7 points, its edges, and which points lie on its boundary."""
    points, corners = hexahedra(np.geomspace(1, 9, 6), np.array([0.0, 0.2, 0.3, 0.9, 1.0]), np.linspace(-1, 1, 7) ** 3)
    edges = np.unique(np.sort(corners[:, EDGES].reshape(-1, 2), axis=1), axis=0)
    outer = ((points == points.min(axis=0)) | (points == points.max(axis=0))).any(axis=1)
    return points, edges, outer


def dense(points: Any, edges: Any, given: Any, fixed: Any) -> Any:
    """The weighted means, equation by equation."""
    n, found = len(points), np.where(fixed, given, 0.0)
    matrix = np.zeros((n, n))
    for i, j in edges:
        weight = 1.0 / ((points[i] - points[j]) ** 2).sum()
        matrix[i, i] += weight
        matrix[j, j] += weight
        matrix[i, j] -= weight
        matrix[j, i] -= weight
    for k in range(given.shape[1]):
        free = np.flatnonzero(~fixed[:, k])
        known = np.flatnonzero(fixed[:, k])
        right = -matrix[np.ix_(free, known)] @ given[known, k]
        found[free, k] = np.linalg.solve(matrix[np.ix_(free, free)], right)
    return found


def extended(points: Any, edges: Any, given: Any, fixed: Any, *options: int, **more: int) -> Any:
    return Extension(points, edges, fixed, *options, **more)(given)


@pytest.mark.parametrize("factorized", [10**6, 0])
def test_it_solves_the_dense_equations_with_a_mask_for_each_component(factorized: int) -> None:
    points, edges, outer = grid()
    rng = np.random.default_rng(3)
    given = rng.normal(size=points.shape)
    fixed = np.repeat(outer[:, None], 3, axis=1)
    fixed[points[:, 1] == 0.0] = [False, True, False]  # slip
    fixed[points[:, 2] == 1.0] = True
    found = extended(points, edges, given, fixed, factorized)
    np.testing.assert_array_equal(found[fixed], given[fixed])
    np.testing.assert_allclose(found, dense(points, edges, given, fixed), rtol=0, atol=1e-9)


def test_units_do_not_count() -> None:
    points, edges, outer = grid()
    given, fixed = np.random.default_rng(3).normal(size=points.shape), np.repeat(outer[:, None], 3, axis=1)
    for unit in (1e-9, 1e9):
        np.testing.assert_allclose(
            extended(unit * points, edges, unit * given, fixed) / unit,
            extended(points, edges, given, fixed),
            atol=1e-12,
        )


@pytest.mark.parametrize("factorized", [10**6, 0])
def test_the_transpose_and_single_columns_are_those_of_the_dense_matrix(factorized: int) -> None:
    points, edges, outer = grid()
    fixed = np.repeat(outer[:, None], 3, axis=1)
    fixed[points[:, 1] == 0.0] = [False, True, False]
    n, extension = len(points), Extension(points, edges, fixed, factorized)
    forces = np.random.default_rng(5).normal(size=points.shape)
    for component in range(3):
        identity, mask = np.eye(n), np.repeat(fixed[:, component : component + 1], n, axis=1)
        matrix = dense(points, edges, identity, mask) * fixed[:, component]
        np.testing.assert_allclose(extension.carried(component, identity), matrix, rtol=0, atol=1e-9)
        pulled = extension.transposed(forces)[:, component]
        np.testing.assert_allclose(pulled, matrix.T @ forces[:, component], rtol=0, atol=1e-8)
        assert (pulled[~fixed[:, component]] == 0.0).all()


@pytest.mark.parametrize("factorized", [10**6, 0])
def test_a_constant_stays_and_the_boundary_bounds_the_inside(factorized: int) -> None:
    points, edges, outer = grid()
    fixed = np.repeat(outer[:, None], 3, axis=1)
    same = np.where(fixed, [1.0, -2.0, 3.0], np.nan)
    np.testing.assert_allclose(extended(points, edges, same, fixed, factorized), np.tile([1, -2, 3], (len(points), 1)))
    given = np.random.default_rng(1).uniform(-1, 1, points.shape)
    found = extended(points, edges, given, fixed, factorized)
    assert (found[~outer] < given[outer].max(axis=0)).all()
    assert (found[~outer] > given[outer].min(axis=0)).all()


def test_between_two_ends_each_edge_takes_its_squared_length() -> None:
    x = np.array([0.0, 1.0, 3.0, 3.5, 7.0])
    points, edges = np.stack([x, 0 * x, 0 * x], axis=1), np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    fixed = np.array([True, False, False, False, True])[:, None]
    found = extended(points, edges, np.array([0, 0, 0, 0, 1.0])[:, None], fixed)
    squared = np.diff(x) ** 2
    np.testing.assert_allclose(found[:, 0], np.concatenate([[0.0], np.cumsum(squared) / squared.sum()]), atol=1e-15)
    matrix = laplacian(points, edges).toarray()
    np.testing.assert_allclose(np.diag(matrix, 1), -1 / squared)
    np.testing.assert_allclose(matrix.sum(axis=1), 0, atol=1e-15)


def test_a_piece_without_a_fixed_point_stays() -> None:
    points, edges = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [6, 0, 0]]), np.array([[0, 1], [2, 3]])
    fixed = np.array([[True, False], [False, False], [False, False], [False, True]])
    found = extended(points, edges, np.full((4, 2), 2.0), fixed)
    np.testing.assert_array_equal(found, [[2, 0], [2, 0], [0, 2], [0, 2]])
    np.testing.assert_array_equal(extended(points, edges, np.ones((4, 1)), np.ones((4, 1), bool)), np.ones((4, 1)))


def test_what_cannot_be_solved_is_an_error() -> None:
    points, edges, outer = grid()
    given, fixed = np.random.default_rng(3).normal(size=points.shape), np.repeat(outer[:, None], 3, axis=1)
    with pytest.raises(UserError, match=r"the Laplacian of 60 points did not converge in 2 steps: the residual is \d"):
        extended(points, edges, given, fixed, factorized=0, steps=2)
    points[edges[7, 1]] = points[edges[7, 0]]
    with pytest.raises(UserError, match=f"1 of {len(edges)} edges of its cells have no length"):
        extended(points, edges, given, fixed)
