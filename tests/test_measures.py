"""What claims are measured by, against plain loops and known answers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import rankdata

from reproduction import measures

GENERATOR = np.random.default_rng(0)


def test_separation_is_the_least_distance_of_two() -> None:
    centers = GENERATOR.normal(size=(7, 3))
    least = min(np.linalg.norm(a - b) for a, b in itertools.combinations(centers, 2))
    assert measures.separation(centers) == pytest.approx(least, rel=1e-14)


def test_matched_distance_is_the_least_over_all_pairings() -> None:
    one, other = GENERATOR.normal(size=(2, 5, 2))
    pairings = itertools.permutations(range(5))
    least = min(np.linalg.norm(one - other[list(order)], axis=1).mean() for order in pairings)
    assert measures.matched_distance(one, other) == pytest.approx(least, rel=1e-14)
    assert measures.matched_distance(one, one[::-1]) == 0


def test_adaptation_counts_what_the_closest_vertices_have_to_move() -> None:
    vertices = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(-1, 2)
    error = vertices[:, 0]  # 0, 1, 2, 3 from left to right: 1.5 on average
    left, right = np.array([[0.1, 0.2], [0.2, 1.9]]), np.array([[3.1, 0.0], [2.9, 2.2]])
    np.testing.assert_allclose(measures.adaptation(np.stack([left, right]), vertices, error), [0.0, 2.0])
    assert measures.adaptation(vertices, vertices, error) == pytest.approx(1.0)


def test_scaled_front_ends_at_the_corners_and_steps_are_in_its_units() -> None:
    front = np.array([[1.0, 50.0], [2.0, 30.0], [5.0, 10.0]])
    np.testing.assert_allclose(measures.scaled(front, front), [[0, 1], [0.25, 0.5], [1, 0]])
    np.testing.assert_allclose(measures.steps(front), [np.hypot(0.25, 0.5), np.hypot(0.75, 0.5)])


def test_roughness_is_nothing_on_a_smooth_front_and_grows_with_dents_and_steps() -> None:
    x = np.linspace(0, 1, 60)
    assert measures.roughness(np.stack([x, 1 - x], axis=1)) < 1e-9
    arc = np.stack([np.sin(np.pi / 2 * x), np.cos(np.pi / 2 * x)], axis=1)
    assert measures.roughness(arc) < 1e-6
    assert measures.roughness(arc * [3.0, 0.001]) < 1e-6  # whatever the units
    for count in (3, 6):
        corners = np.repeat(np.linspace(0, 1, count + 1), 2)
        stairs = np.stack([corners[1:], 1 - corners[:-1]], axis=1)
        assert measures.roughness(stairs) > 300
    dented = arc.copy()
    dented[20:35, 1] -= 0.15
    assert measures.roughness(dented) > 150


def test_best_given_looks_only_at_rivals_that_are_as_good_otherwise() -> None:
    front = np.array([[0.1, 0.9], [0.5, 0.6], [0.8, 0.2]])
    assert measures.best_given(front, np.array([0.4, 0.5]), gained=0) == 0.5
    assert measures.best_given(front, np.array([0.4, 0.5]), gained=1) == 0.6
    assert measures.best_given(front, np.array([0.9, 0.1]), gained=1) == -np.inf


def test_preferred_is_the_best_of_equation_9() -> None:
    objectives, preference = GENERATOR.uniform(size=(9, 2)), np.array([0.0, 0.3, 1.0])
    expected = [max(p * R + (1 - p) * P for R, P in objectives) for p in preference]
    np.testing.assert_allclose(measures.preferred(objectives, preference), expected, rtol=1e-15)


def test_spearman_is_the_correlation_of_ranks() -> None:
    one, other = GENERATOR.normal(size=(2, 20)).round(1)
    expected = np.corrcoef(rankdata(one), rankdata(other))[0, 1]
    assert measures.spearman(one, other) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(measures.spearman(one, np.ones(20)))
