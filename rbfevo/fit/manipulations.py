"""What the design parameters of a setup are: weights, displacements of the centers, or orthonormal directions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.choices import FIT_MANIPULATIONS as MANIPULATIONS
from rbfevo.choices import refuse_others
from rbfevo.errors import UserError
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.evolvability import evolvability, singular
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.representations import RBF, Representation


class Deformation(NamedTuple):
    """The deformation X' = X + U P of one setup under one manipulation, U = Phi M^-1.

    Attributes:
        U: [n, m].
        M: [m, m], so that the RBF weights of parameters P [m, k] are M^-1 P.
        W: [r, m], so that of another representation than RBFs they are W M^-1 P; None for the identity.
        regularity: R of U; improvement_potential: P of U; both in [0, 1] and the larger the better (paper, eqs. 7, 8).
    """

    U: Tensor
    M: Tensor
    regularity: float
    improvement_potential: float
    W: Tensor | None = None

    def weights(self, parameters: Tensor) -> Tensor:
        """The RBF weights [*batch, m, k] of parameters [*batch, m, k]: u(x) = sum_j weights_j phi(|c_j - x|)."""
        found = torch.linalg.solve(self.M, parameters)
        return found if self.W is None else self.W @ found


def deformation(scenario: Scenario, kernel: Kernel | Representation, centers: Tensor, manipulation: str) -> Deformation:
    """The deformation of one setup: indirect U = Phi (paper, eq. 2), direct U = Phi Psi^-1 (eq. 4), orthogonalized.

    Orthogonalized is the thin Q of the QR decomposition of Phi, rows weighted: the same designs are within reach, at
    R = 1 (proposed by Richter et al., GECCO 2018).

    Args:
        scenario, kernel: the design, and phi, or another representation, which a run has made.
        centers: [m, d], model units, or another setup [D].
        manipulation: one of `MANIPULATIONS`.

    Raises:
        UserError: for another manipulation, centers that do not fit the design or are not finite, a numerically
            rank-deficient Phi, and, if direct, a numerically singular Psi.
    """
    refuse_others("manipulation", manipulation, MANIPULATIONS)
    if scenario.mirror is not None:
        raise UserError("setups with a symmetry plane cannot be fitted: a fit moves their centers one by one")
    if scenario.planar is not None:
        raise UserError("setups of a planar design cannot be fitted: a fit moves their centers in all three directions")
    if isinstance(kernel, Representation) and not isinstance(kernel, RBF):
        return _represented(scenario, kernel, centers, manipulation)
    n, d = scenario.vertices.shape
    if centers.ndim != 2 or centers.shape[1] != d or not 1 <= len(centers) <= n:
        raise UserError(f"the centers of a setup must have shape [m, {d}], 1 <= m <= {n}, not {list(centers.shape)}")
    m, root = len(centers), scenario.weights.sqrt()[:, None]
    representation = RBF(kernel) if isinstance(kernel, Kernel) else kernel
    Phi = representation.phi(scenario.vertices, centers)
    Phi = Phi if scenario.blend is None else scenario.blend[:, None] * Phi
    if not bool(centers.isfinite().all() and Phi.isfinite().all()):
        raise UserError("the setup has centers that are not finite: choose another setup")
    regularity, potential, variability = evolvability(Phi, scenario.gradient, scenario.weights)
    rank = round(float(variability) * n)
    if rank < m:
        raise UserError(
            f"Phi is numerically rank-deficient ({rank} of {m} columns are independent): choose another setup"
        )
    if manipulation == "indirect":
        return Deformation(Phi, torch.eye(m, dtype=Phi.dtype), float(regularity), float(potential))
    if manipulation == "direct":
        M = representation.psi(centers)
        inverse, _ = torch.linalg.inv_ex(M)
        if bool(singular(M, inverse)):
            raise UserError("Psi is numerically singular, so these centers cannot be moved directly: "
                            "choose another setup or another manipulation")  # fmt: skip
        U = torch.linalg.solve(M.mT, Phi.mT).mT
    else:
        Q, M = torch.linalg.qr(root * Phi)
        U = Q / root
    sigma = torch.linalg.svdvals(root * U)
    return Deformation(U, M, float(sigma[-1] / sigma[0]), float(potential))


def _represented(scenario: Scenario, representation: Representation, setup: Tensor, manipulation: str) -> Deformation:
    """The deformation of a setup [D] of another representation than RBFs."""
    if manipulation == "direct" and not representation.narrows:
        raise UserError(
            "this run has no points on the surface that could be moved: choose manipulation indirect or orthogonalized"
        )
    representation.refuse(setup[None], scenario.vertices.shape[1])
    W = None if manipulation == "indirect" else representation.weights(setup)
    Phi = representation.phi(scenario.vertices, setup)
    Phi = Phi if scenario.blend is None else scenario.blend[:, None] * Phi
    U = Phi if W is None else Phi @ W
    if not bool(U.isfinite().all()):
        raise UserError("the setup has values that are not finite: choose another setup")
    regularity, potential, variability = evolvability(U, scenario.gradient, scenario.weights)
    m = U.shape[1]
    rank = round(float(variability) * len(U))
    if rank < m:
        raise UserError(
            f"U is numerically rank-deficient ({rank} of {m} columns are independent): choose another setup"
        )
    M = torch.eye(m, dtype=U.dtype)
    if manipulation == "orthogonalized":
        root = scenario.weights.sqrt()[:, None]
        Q, M = torch.linalg.qr(root * U)
        U, regularity = Q / root, torch.ones(())
    return Deformation(U, M, float(regularity), float(potential), W)
