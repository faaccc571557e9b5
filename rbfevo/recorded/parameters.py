"""The free parameters of a setup, and a displacement as their linear function, with its transpose.

With the parameters P [m, k] of the run's manipulation a point moves by beta(x) sum_j phi_j(x) w_j, where the weights
are w = P (indirect) or Psi w = P (direct). Entries of P that a setup cannot have are no parameters: those of a center
on the symmetry plane across it, and all along the axis of a planar run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Ints
from rbfevo.errors import UserError
from rbfevo.recorded.setup import EPS, Setup

if TYPE_CHECKING:
    from rbfevo.geometry.extension import Extension


class Block(NamedTuple):
    """Parameters of the same columns of U.

    Attributes:
        components: [c] of a displacement; across: whether across the symmetry plane; columns: of Phi.
        rows: [r] of the parameters [m, k]; places: [r, c] of the parameters in a flat list of all.
        triangle: T [r, r] of U = Q T, or None.
    """

    components: Ints
    across: bool
    columns: Ints
    rows: Ints
    places: Ints
    triangle: Array | None


class Parameters:
    """The free parameters of a setup as a flat list [r]: center after center, the components of each in order.

    Args:
        chosen: the setup; k: components of a displacement.
        triangle: T [m, m] for the columns along the symmetry plane, or of all, and those across (True); the parameters
            are then q = T p of the orthonormal columns. None: p, those of the run's manipulation.

    Raises:
        UserError: if the control points cannot be moved one by one, or T has no inverse.
    """

    def __init__(self, chosen: Setup, k: int, triangle: Callable[[bool], Array] | None = None) -> None:
        if chosen.manipulation == "direct" and (reason := chosen.immovable(k)):
            raise UserError(f"{reason}; choose another pick, or a run with manipulation=indirect")
        self.chosen, self.k = chosen, k
        direct = chosen.manipulation == "direct"
        self.shape = (len(chosen.centers) if direct else chosen.count, k)
        found = [part for part in chosen.parities(k) if len(part[0]) and len(part[2])]
        parts = [(*part, chosen.rows_of(part[1]) if direct else part[2]) for part in found]
        free = np.zeros(self.shape, bool)
        for components, _, _, rows in parts:
            free[np.ix_(rows, components)] = True
        self.centers, self.components = np.nonzero(free)
        number = np.full(self.shape, -1)
        number[free] = np.arange(len(self.centers))
        self.blocks = [
            Block(c, across, columns, rows, number[np.ix_(rows, c)], None if triangle is None else triangle(across))
            for c, across, columns, rows in parts
        ]
        for block in self.blocks:
            if block.triangle is not None:
                diagonal = np.abs(np.diag(block.triangle))
                if not diagonal.min() > EPS * len(diagonal) * diagonal.max():
                    raise UserError(
                        "the columns of U depend on each other, so there are no orthonormal parameters for all of "
                        "them: choose another pick, or the parameters of the run's manipulation"
                    )

    def __len__(self) -> int:
        return len(self.centers)

    def rows(self, parameters: Array) -> Array:
        """The parameters [m, k] of the run's manipulation, as `rbfevo.apply` takes them; 0 where there are none."""
        found = np.zeros(self.shape)
        for block in self.blocks:
            own = parameters[block.places]
            found[np.ix_(block.rows, block.components)] = (
                own if block.triangle is None else np.linalg.solve(block.triangle, own)
            )
        return found

    def flat(self, rows: Array) -> Array:
        """The parameters [r] of rows [m, k] that the run's manipulation takes.

        Raises:
            UserError: if a center is to leave a plane that it cannot leave.
        """
        self.chosen.refuse_across(rows, "parameter")
        found = np.zeros(len(self))
        for block in self.blocks:
            own = rows[np.ix_(block.rows, block.components)]
            found[block.places] = own if block.triangle is None else block.triangle @ own
        return found

    def weights(self, parameters: Array) -> Array:
        """The RBF weights [m, k]."""
        rows = self.rows(parameters)
        return self.chosen.weights(rows) if self.chosen.manipulation == "direct" else rows

    def transposed(self, forces: Array) -> Array:
        """The transpose of `weights`: from derivatives [m, k] by the weights to those [r] by the parameters."""
        found = np.zeros(len(self))
        for block in self.blocks:
            found[block.places] = self._through(block, forces[np.ix_(block.columns, block.components)])
        return found

    def columns(self, block: Block, phi: Array) -> Array:
        """The columns [q, r] of a displacement that the parameters of a block have, of those phi [q, r] of weights."""
        return self._through(block, phi.T).T

    def _through(self, block: Block, rows: Array) -> Array:
        """T^-T W^T times rows [r, ...] of the weights' columns."""
        if self.chosen.manipulation == "direct":
            rows = self.chosen.through(rows, block.across)
        return rows if block.triangle is None else np.linalg.solve(block.triangle.T, rows)


class Displacement:
    """The displacement [n, 3] of points as a linear function of the free parameters of a setup.

    Args:
        parameters: of the setup; points: [n, 3], model units; of a run on the plane, heights move along z.
        follows: [n, 3] where a displacement is the setup's, None for everywhere; extension: carries it to the others.
    """

    def __init__(
        self,
        parameters: Parameters,
        points: Array,
        follows: NDArray[np.bool_] | None = None,
        extension: Extension | None = None,
    ) -> None:
        self.parameters, self.extension, self.count = parameters, extension, len(points)
        chosen = parameters.chosen
        self.axes = [2] if parameters.k == 1 else list(range(parameters.k))
        self._moving = np.arange(len(points)) if follows is None else np.flatnonzero(follows.any(axis=1))
        self._follows = None if follows is None else follows[self._moving]
        self._places = points[self._moving, : chosen.centers.shape[1]]
        self._blend = chosen.blend(self._places)

    def __call__(self, parameters: Array) -> Array:
        """Displacements [n, 3] under parameters [r], real or complex."""
        if np.iscomplexobj(parameters):
            return self(np.real(parameters)) + 1j * self(np.imag(parameters))
        found, moved = np.zeros((self.count, 3)), np.zeros((len(self._moving), 3))
        weights = self.parameters.weights(parameters)
        moved[:, self.axes] = self._blend * self.parameters.chosen.free_displacement(self._places, weights)
        found[self._moving] = moved if self._follows is None else np.where(self._follows, moved, 0.0)
        return found if self.extension is None else self.extension(found)

    def transposed(self, forces: Array) -> Array:
        """The transpose: from derivatives [n, 3] by the displacements to those [r] by the parameters."""
        if self.extension is not None:
            forces = self.extension.transposed(forces)
        forces = forces[self._moving]
        if self._follows is not None:
            forces = np.where(self._follows, forces, 0.0)
        forces, chosen = self._blend * forces[:, self.axes], self.parameters.chosen
        pulled, step = np.zeros((chosen.count, self.parameters.k)), chosen.rows_at_once()
        for start in range(0, len(forces), step):
            rows = slice(start, start + step)
            places = chosen.on_one_side(self._places[rows])
            for block in self.parameters.blocks:
                phi = chosen.columns(places, block.across)[:, block.columns]
                pulled[np.ix_(block.columns, block.components)] += phi.T @ forces[rows][:, block.components]
        return self.parameters.transposed(pulled)

    def columns(self) -> Iterator[tuple[int, Ints, Array]]:
        """For each axis along which points move: the axis, its parameters [r], and the derivatives [n, r] by them."""
        chosen = self.parameters.chosen
        for block in self.parameters.blocks:
            phi = chosen.columns(chosen.on_one_side(self._places), block.across)[:, block.columns]
            own = self.parameters.columns(block, self._blend * phi)
            for position, component in enumerate(block.components):
                axis, found = self.axes[component], np.zeros((self.count, own.shape[1]))
                found[self._moving] = own if self._follows is None else np.where(self._follows[:, axis, None], own, 0.0)
                if self.extension is not None:
                    found = self.extension.carried(axis, found)
                yield axis, block.places[:, position], found

    def reach(self) -> Array:
        """How far points move at most [n, 3] along each axis, if no parameter is larger than 1."""
        found = np.zeros((self.count, 3))
        for axis, _, columns in self.columns():
            found[:, axis] = np.abs(columns).sum(axis=1)
        return found


def design_matrix(chosen: Setup, points: Array, across: bool = False) -> Array:
    """U [n, m] of the run's manipulation at points [n, d]: along the symmetry plane or, of centers off it, across."""
    U = chosen.blended(points, across)
    U = U[:, chosen.off_columns] if across else U
    return chosen.through(U.T, across).T if chosen.manipulation == "direct" and U.size else U


def orthonormal(U: Array, weights: Array) -> tuple[Array, Array]:
    """Q [n, m] and upper triangular T [m, m] of U = Q T with Q^T M Q = I, M the vertex weights [n] of the run.

    With parameters q = T p the columns are those of Q, whose regularity is 1 (Richter et al., GECCO 2018). The
    diagonal of T is not negative.
    """
    root = np.sqrt(weights)[:, None]
    Q, T = np.linalg.qr(root * U)
    signs = np.where(np.diag(T) < 0, -1.0, 1.0)
    return Q * signs / root, signs[:, None] * T
