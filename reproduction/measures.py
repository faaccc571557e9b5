"""Quantities that claims are measured by: uniformity of centers, adaptation to the target, and shape of a front."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist, pdist
from scipy.stats import spearmanr

Array = NDArray[np.float64]


def spearman(one: Array, other: Array) -> float:
    """Spearman's rank correlation of two scores [q], in [-1, 1]; NaN where one of them does not vary."""
    if np.ptp(one) == 0 or np.ptp(other) == 0:
        return float("nan")
    return float(spearmanr(one, other)[0])  # pyright: ignore[reportArgumentType]


def separation(centers: Array) -> float:
    """The separation distance of centers [m, d]: the least distance between two (Wendland 2004; paper, section 7)."""
    return float(pdist(centers).min())


def matched_distance(one: Array, other: Array) -> float:
    """The mean distance of centers [m, d] to those of another setup, paired so that it is minimal."""
    distance = cdist(one, other)
    return float(distance[linear_sum_assignment(distance)].mean())


def adaptation(centers: Array, vertices: Array, local_error: Array) -> Array:
    """The initial local error at the centers, relative to its average.

    The mean over the centers [*pop, m, d] of the initial local error [n] at the vertex [n, d] closest to each, divided
    by its mean over all vertices; about 1 for centers placed independently of the target.
    """
    _, nearest = KDTree(vertices).query(centers)
    return local_error[nearest].mean(axis=-1) / local_error.mean()


def scaled(objectives: Array, front: Array) -> Array:
    """Objectives [p, 2] in units of the front's extent: its ends lie at (0, 1) and (1, 0)."""
    low, high = front.min(axis=0), front.max(axis=0)
    return (objectives - low) / np.where(high > low, high - low, 1.0)


def steps(front: Array) -> Array:
    """Distances [p - 1] between neighbours of a front [p, 2] sorted by its first objective, in units of its extent."""
    return np.linalg.norm(np.diff(scaled(front, front), axis=0), axis=1)


def roughness(front: Array, places: int = 15) -> float:
    """Degrees by which a front [p, 2], scaled to its extent, turns back and forth along its length.

    The sum of the absolute turns less the absolute value of their sum, over `places` segments of equal length: 0 for a
    front that bends in one direction only; every dent adds twice its turn, and a staircase of k steps about 180 k, as
    far as the segments resolve it."""
    points = scaled(front, front)
    along = np.concatenate([[0.0], np.cumsum(steps(front))])
    at = np.linspace(0, along[-1], places + 1)
    way = np.diff(np.stack([np.interp(at, along, column) for column in points.T], axis=1), axis=0)
    turns = np.degrees(np.angle(np.exp(1j * np.diff(np.arctan2(way[:, 1], way[:, 0])))))
    return float(np.abs(turns).sum() - abs(turns.sum()))


def best_given(front: Array, at_least: Array, gained: int) -> float:
    """The best of objective `gained` among setups [p, 2] that are at least as good as `at_least` [2] in the other one.

    -inf if there is none.
    """
    rivals = front[front[:, 1 - gained] >= at_least[1 - gained]]
    return float(rivals[:, gained].max()) if len(rivals) else -np.inf


def preferred(objectives: Array, preference: Array) -> Array:
    """The best preference R + (1 - preference) P among setups [p, 2], for preferences [q]: [q] (paper, eq. 9)."""
    return (preference[:, None] * objectives[:, 0] + (1 - preference[:, None]) * objectives[:, 1]).max(axis=1)
