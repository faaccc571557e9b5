"""The peer of the evaluator: a plain loop in NumPy and SciPy, written directly from the paper."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

Array = NDArray[Any]


def phi(r: Array, support: float | None, dimension: int) -> Array:
    """Wendland's C2 function, or, if `support` is None, r^2 log r on the plane and r^3 in space."""
    if support is not None:
        q = np.minimum(r / support, 1.0)
        return (1.0 - q) ** 4 * (4.0 * q + 1.0)
    if dimension == 2:
        return r**2 * np.log(np.where(r > 0.0, r, 1.0))
    return r**3


def numpy_scores(X: Array, g: Array, centers: Array, support: float | None, manipulation: str) -> Array:
    """Regularity and improvement potential [p, 2] of setups [p, m, d], one after the other; all weights are 1.

    R is the ratio of the extreme singular values of U, and P = |left^T g|_F^2 over its left singular vectors above the
    rank cutoff (paper, eqs. 2 to 8); they span the same space for Phi and for Phi Psi^-1.
    """
    scores = np.empty((len(centers), 2))
    for i, C in enumerate(centers):
        U = phi(cdist(X, C), support, X.shape[1])
        if manipulation == "direct":
            Psi = phi(cdist(C, C), support, X.shape[1])
            U = np.linalg.solve(Psi, U.T).T  # Psi is symmetric
        left, sigma, _ = np.linalg.svd(U, full_matrices=False)
        kept = sigma > max(U.shape) * np.finfo(np.float64).eps * sigma[0]
        coordinates = left[:, kept].T @ g
        scores[i] = sigma[-1] / sigma[0] if kept.all() else 0.0, np.sum(coordinates**2)
    return scores
