"""Linear elasticity on a mesh of hexahedra: compliance, volume, and their exact derivatives by all nodes.

With displacements u, strains e = (grad u + grad u^T) / 2, stresses s = lambda tr(e) I + 2 mu e, and a traction t,

    a(u, v) = integral of s(u) : e(v)  =  f(v) = integral over the loaded faces of t . v,      J = f(u).

Let the nodes X move with a field w, trilinear as the cells are. Then grad u changes by -grad u grad w, a volume by its
share div w, and the area of a loaded face by div w - n . grad w n. u is its own adjoint state, so nothing else has to
be solved:

    dJ = 2 df(u) - da(u, u)
       = 2 integral over loaded faces of (t . u) (div w - n . grad w n)
         + integral of (2 grad u^T s - (s : e) I) : grad w.

With the quadrature points of a and f this is the derivative of the discrete J, to rounding.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
ORDER = 4  # of the quadrature


class Solution(NamedTuple):
    """The state of one shape.

    Attributes:
        compliance: J; volume: V.
        compliance_gradient, volume_gradient: [n, 3] dJ/dX and dV/dX, by the coordinates of all nodes of the mesh.
        displacement: [n, 3] of the nodes; stress: [c] von Mises, the mean in each cell.
    """

    compliance: float
    volume: float
    compliance_gradient: Array
    volume_gradient: Array
    displacement: Array
    stress: Array


class ShapeError(Exception):
    """Cells are turned inside out, so there is no solution."""


@dataclasses.dataclass(frozen=True)
class Body:
    """An elastic body: the cells of its mesh, its material, its supports and its load.

    Attributes:
        corners: [c, 8] of hexahedra, in the order of scikit-fem.
        young, poisson: E and nu; traction: [3] force per area of the loaded faces.
        supports: [n, 3] True for nodes and components that cannot move. The middle of an edge cannot where both of its
            ends cannot.
        loaded: [n] True for the nodes of the loaded faces.
    """

    corners: NDArray[np.int64]
    young: float
    poisson: float
    traction: Array
    supports: Mask
    loaded: Mask

    @property
    def moduli(self) -> tuple[float, float]:
        """lambda and mu."""
        shear = self.young / (2.0 * (1.0 + self.poisson))
        return 2.0 * shear * self.poisson / (1.0 - 2.0 * self.poisson), shear

    def solve(self, points: Array) -> Solution:
        """The solution with the nodes at `points` [n, 3]: displacements of 20 nodes a cell, on trilinear cells.

        Raises:
            ShapeError: if cells are inside out.
        """
        mesh = skfem.MeshHex(np.ascontiguousarray(points.T), np.ascontiguousarray(self.corners.T))
        cells = skfem.CellBasis(mesh, skfem.ElementHexS2(), intorder=ORDER)
        volumes = cells.mapping.detDF(cells.X)
        turned = (volumes * np.sign(volumes.sum()) <= 0.0).any(axis=1)  # cells may be left-handed, all of them
        if turned.any():
            raise ShapeError(f"{int(turned.sum())} of {mesh.nelements} cells are turned inside out")
        outer = mesh.boundary_facets()
        facets = outer[self.loaded[mesh.facets[:, outer]].all(axis=0)]
        faces = skfem.FacetBasis(mesh, skfem.ElementHexS2(), facets=facets, intorder=ORDER)
        slopes = gradients(cells)
        force = self._force(faces)
        u = self._solved(mesh, cells, slopes, force)

        grad = np.einsum("aci,acqj->cqij", u[cells.element_dofs], slopes)
        first, second = self.moduli
        strain = (grad + grad.swapaxes(2, 3)) / 2.0
        trace = np.trace(strain, axis1=2, axis2=3)[:, :, None, None] * np.eye(3)
        stress = first * trace + 2.0 * second * strain
        energy = np.einsum("cqij,cqij->cq", stress, strain)[:, :, None, None] * np.eye(3)
        shape = skfem.CellBasis(mesh, skfem.ElementHex1(), intorder=ORDER)
        moves = gradients(shape)
        inner = 2.0 * np.einsum("cqik,cqij->cqkj", grad, stress) - energy
        by_cells = np.einsum("cq,cqkj,acqj->ack", cells.dx, inner, moves)
        volume = np.einsum("cq,acqk->ack", cells.dx, moves)
        deviator = stress - np.trace(stress, axis1=2, axis2=3)[:, :, None, None] * np.eye(3) / 3.0
        mises = np.sqrt(1.5 * np.einsum("cqij,cqij->cq", deviator, deviator))
        return Solution(
            float((force * u).sum()),
            float(cells.dx.sum()),
            gathered(shape, by_cells, len(points)) + self._by_faces(mesh, faces, u, len(points)),
            gathered(shape, volume, len(points)),
            u[cells.nodal_dofs[0]],
            (cells.dx * mises).sum(axis=1) / cells.dx.sum(axis=1),
        )

    def _solved(self, mesh: Any, cells: Any, slopes: Array, force: Array) -> Array:
        """The displacements [d, 3] of all degrees of freedom of the scalar basis."""
        supported = np.zeros(force.shape, bool)
        supported[cells.nodal_dofs[0]] = self.supports
        supported[cells.edge_dofs[0]] = self.supports[mesh.edges].all(axis=0)
        free, u = np.flatnonzero(~supported), np.zeros(force.shape)
        matrix = csc_array(self._stiffness(cells, slopes)[free][:, free])
        options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", options=options)
        u.reshape(-1)[free] = factor.solve(force.reshape(-1)[free])
        return u

    def _stiffness(self, cells: Any, slopes: Array) -> Any:
        """a(u, v) as a matrix [3 d, 3 d].

        What scikit-fem assembles from a form, pair by pair of 60 functions a cell, in a twentieth of the time.
        """
        (count, c, _, _), (first, second) = slopes.shape, self.moduli
        rooted = np.sqrt(cells.dx)[:, :, None] * slopes
        rooted = rooted.transpose(1, 0, 3, 2).reshape(c, 3 * count, -1)  # [c, (a, i), q]
        pairs = (rooted @ rooted.swapaxes(1, 2)).reshape(c, count, 3, count, 3)  # of d_i N_a and d_j N_b
        local = first * pairs + second * pairs.swapaxes(2, 4)
        local += second * np.einsum("cakbk->cab", pairs)[:, :, None, :, None] * np.eye(3)[:, None, :]
        places = (3 * cells.element_dofs.T[:, :, None] + np.arange(3)).reshape(c, -1)
        rows, columns = np.broadcast_arrays(places[:, :, None], places[:, None, :])
        local = local.reshape(c, 3 * count, 3 * count)
        return coo_array((local.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * cells.N, 3 * cells.N)).tocsr()

    def _force(self, faces: Any) -> Array:
        """f(v) as vectors [d, 3]."""
        values = np.stack([np.broadcast_to(part[0], faces.dx.shape) for part in faces.basis])
        shares = np.einsum("fq,afq->af", faces.dx, values)
        return gathered(faces, shares[:, :, None] * self.traction, faces.N)

    def _by_faces(self, mesh: Any, faces: Any, u: Array, count: int) -> Array:
        """2 df(u) by all nodes [n, 3]: loaded faces change their size."""
        shape = skfem.FacetBasis(mesh, skfem.ElementHex1(), facets=faces.find, intorder=ORDER)
        values = np.stack([np.broadcast_to(part[0], faces.dx.shape) for part in faces.basis])
        work = faces.dx * np.einsum("afi,afq,i->fq", u[faces.element_dofs], values, self.traction)
        moves, normal = gradients(shape), faces.normals.transpose(1, 2, 0)
        along = moves - np.einsum("afqj,fqj->afq", moves, normal)[..., None] * normal
        return gathered(shape, 2.0 * np.einsum("fq,afqk->afk", work, along), count)


def gradients(basis: Any) -> Array:
    """Derivatives [a, c, q, 3] of the functions of a scalar basis at its quadrature points."""
    return np.stack([part[0].grad for part in basis.basis]).transpose(0, 2, 3, 1)


def gathered(basis: Any, values: Array, count: int) -> Array:
    """Sums [count, 3] of values [a, c, 3] at the degrees of freedom of a scalar basis."""
    places = basis.element_dofs.ravel()
    return np.stack([np.bincount(places, values[:, :, k].ravel(), minlength=count) for k in range(3)], axis=1)
