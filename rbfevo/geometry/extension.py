"""Carry displacements into the inside of a mesh: a graph Laplacian over its edges.

Each component u of the displacement, where it is not fixed, is the weighted mean of those of its neighbours,

    sum over the edges ij at point i of w_ij (u_i - u_j) = 0,    w_ij = 1 / |x_i - x_j|^2,

so short edges are stiff, and thin cells beside a wall move with it. A displacement that is the same at all fixed points
is the same inside, and none exceeds the largest at a fixed point (the maximum principle).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg, splu

from rbfevo.arrays import Array, Ints
from rbfevo.errors import UserError

FACTORIZED = 20_000  # unknowns up to which a factorization is the faster way (192,000 take 262 s and 5.3 GB)
RESIDUAL = 1e-11  # of the scaled right-hand side: where conjugate gradients stop
STEPS = 20_000

Mask = NDArray[np.bool_]


def laplacian(points: Array, edges: Ints) -> csr_array:
    """The graph Laplacian [n, n] with weights 1 / length^2, in units of 1 / length^2; its rows sum to 0.

    Args:
        points: [n, 3], model units; edges: [e, 2] into points, each once.

    Raises:
        UserError: if edges have no length.
    """
    first, second = edges.T
    squared = ((points[first] - points[second]) ** 2).sum(axis=1)
    if (squared == 0.0).any():
        raise UserError(f"{int((squared == 0.0).sum())} of {len(edges)} edges of its cells have no length")
    weights, n = 1.0 / squared, len(points)
    rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
    neighbours = csr_array((np.concatenate([weights, weights]), (rows, columns)), shape=(n, n))
    return csr_array(diags_array(neighbours.sum(axis=1)) - neighbours)


def extended(
    points: Array, edges: Ints, displacement: Array, fixed: Mask, factorized: int = FACTORIZED, steps: int = STEPS
) -> Array:
    """Displacements [n, k]: those given where they are fixed, bit by bit, and carried along the edges elsewhere.

    Parts of the mesh without a fixed point do not move.

    Args:
        points: [n, 3], model units; edges: [e, 2] into points, each once.
        displacement: [n, k], its entries at fixed places count; fixed: [n, k], for each component apart.
        factorized: up to how many unknowns the matrix is factorized; above, conjugate gradients take at most `steps`.

    Raises:
        UserError: if edges have no length, or conjugate gradients do not converge.
    """
    matrix = laplacian(points, edges)
    piece = connected_components(matrix, directed=False)[1]
    found = np.where(fixed, displacement, 0.0)
    for mask in np.unique(fixed, axis=1).T:
        components = np.flatnonzero((fixed == mask[:, None]).all(axis=0))
        reached = np.bincount(piece, mask) > 0
        free, known = np.flatnonzero(~mask & reached[piece]), np.flatnonzero(mask)
        if len(free):
            rows = matrix[free]
            right = -(rows[:, known] @ found[np.ix_(known, components)])
            found[np.ix_(free, components)] = _solution(rows[:, free], right, factorized, steps)
    return found


def _solution(matrix: csr_array, right: Array, factorized: int, steps: int) -> Array:
    """x [n, k] of A x = b for a symmetric positive definite A [n, n], scaled so that its diagonal is 1."""
    scale = 1.0 / np.sqrt(matrix.diagonal())
    scaled = csr_array(diags_array(scale) @ matrix @ diags_array(scale))
    right = scale[:, None] * right
    if len(scale) <= factorized:
        options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
        return scale[:, None] * splu(csc_array(scaled), permc_spec="MMD_AT_PLUS_A", options=options).solve(right)
    found = np.zeros_like(right)
    for column in range(right.shape[1]):
        found[:, column], failed = cg(scaled, right[:, column], rtol=RESIDUAL, maxiter=steps)
        if failed:
            residual = np.linalg.norm(scaled @ found[:, column] - right[:, column]) / np.linalg.norm(right[:, column])
            raise UserError(
                f"the Laplacian of {len(scale)} points did not converge in {steps} steps: the residual is "
                f"{residual:.1e} of the right-hand side, {RESIDUAL:.0e} is wanted; are edges extremely short?"
            )
    return scale[:, None] * found
