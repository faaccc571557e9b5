"""Carry displacements into the inside of a mesh: a graph Laplacian over its edges.

Each component u of the displacement, where it is not fixed, is the weighted mean of those of its neighbours,

    sum over the edges ij at point i of w_ij (u_i - u_j) = 0,    w_ij = 1 / |x_i - x_j|^2,

so short edges are stiff, and thin cells beside a wall move with it. A displacement that is the same at all fixed points
is the same inside, and none exceeds the largest at a fixed point (the maximum principle).
"""

from __future__ import annotations

from typing import NamedTuple

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


class Extension:
    """The linear map from displacements at fixed places of a mesh to those of all its points, and its transpose.

    Where displacements are fixed they are kept bit by bit; parts of the mesh without a fixed point do not move.

    Args:
        points: [n, 3], model units; edges: [e, 2] into points, each once.
        fixed: [n, k], for each component apart.
        factorized: up to how many unknowns the matrix is factorized, once for components with the same points fixed;
            above, conjugate gradients take at most `steps` for each component.

    Raises:
        UserError: if edges have no length.
    """

    def __init__(
        self, points: Array, edges: Ints, fixed: Mask, factorized: int = FACTORIZED, steps: int = STEPS
    ) -> None:
        matrix = laplacian(points, edges)
        piece = connected_components(matrix, directed=False)[1]
        self.fixed, self._parts = fixed, []
        for mask in np.unique(fixed, axis=1).T:
            components = np.flatnonzero((fixed == mask[:, None]).all(axis=0))
            reached = np.bincount(piece, mask) > 0
            free, known = np.flatnonzero(~mask & reached[piece]), np.flatnonzero(mask)
            rows = matrix[free]
            solver = _Solver(rows[:, free], factorized, steps) if len(free) else None
            self._parts.append(_Part(components, free, known, rows[:, known], solver))

    def __call__(self, displacement: Array) -> Array:
        """Displacements [n, k] of all points; of those given [n, k] the entries at fixed places count.

        Raises:
            UserError: if conjugate gradients do not converge.
        """
        found = np.where(self.fixed, displacement, 0.0)
        for part in self._parts:
            found[:, part.components] = part.carried(found[:, part.components])
        return found

    def carried(self, component: int, columns: Array) -> Array:
        """Columns [n, r] of displacements along one component, carried as `__call__` does; errors alike."""
        found = np.where(self.fixed[:, component, None], columns, 0.0)
        return self._part(component).carried(found)

    def transposed(self, forces: Array) -> Array:
        """The transpose: from derivatives [n, k] by all displacements to those by the fixed ones, 0 at other places.

        Raises:
            UserError: if conjugate gradients do not converge.
        """
        found = np.zeros_like(forces)
        for part in self._parts:
            found[:, part.components] = part.pulled(forces[:, part.components])
        return found

    def _part(self, component: int) -> _Part:
        return next(part for part in self._parts if component in part.components)


class _Part(NamedTuple):
    """Components with the same points fixed: which they are, free and known points, and the rows of the free ones.

    Attributes:
        coupling: [f, h] of the Laplacian, between free and known points; solver: of its square part, None without.
    """

    components: Ints
    free: Ints
    known: Ints
    coupling: csr_array
    solver: _Solver | None

    def carried(self, values: Array) -> Array:
        """Values [n, r], which are 0 at points that are not known, with those of the free points."""
        found = values.copy()
        if self.solver is not None:
            found[self.free] = self.solver(-(self.coupling @ values[self.known]))
        return found

    def pulled(self, forces: Array) -> Array:
        """The transpose: what known points take of forces [n, r], 0 elsewhere."""
        found = np.zeros_like(forces)
        found[self.known] = forces[self.known]
        if self.solver is not None:
            found[self.known] -= self.coupling.T @ self.solver(forces[self.free])
        return found


class _Solver:
    """x [n, r] of A x = b for a symmetric positive definite A [n, n], scaled so that its diagonal is 1."""

    def __init__(self, matrix: csr_array, factorized: int, steps: int) -> None:
        self._scale, self._steps = 1.0 / np.sqrt(matrix.diagonal()), steps
        self._matrix = csr_array(diags_array(self._scale) @ matrix @ diags_array(self._scale))
        self._factor = None
        if len(self._scale) <= factorized:
            options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
            self._factor = splu(csc_array(self._matrix), permc_spec="MMD_AT_PLUS_A", options=options)

    def __call__(self, right: Array) -> Array:
        right = self._scale[:, None] * right
        if self._factor is not None:
            return self._scale[:, None] * self._factor.solve(right)
        found = np.zeros_like(right)
        for column in range(right.shape[1]):
            own = right[:, column]
            found[:, column], failed = cg(self._matrix, own, rtol=RESIDUAL, maxiter=self._steps)
            if failed:
                residual = np.linalg.norm(self._matrix @ found[:, column] - own) / np.linalg.norm(own)
                raise UserError(
                    f"the Laplacian of {len(self._scale)} points did not converge in {self._steps} steps: the residual "
                    f"is {residual:.1e} of the right-hand side, {RESIDUAL:.0e} is wanted; are edges extremely short?"
                )
        return self._scale[:, None] * found
