"""Radial basis functions around centers, without a polynomial term (paper, eqs. 1 to 5)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbfevo.choices import POLYNOMIALS, refuse_others
from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.scoring.kernels import Kernel, kernel_of
from rbfevo.scoring.representations.representation import Pull, Reduced, Representation, Space

if TYPE_CHECKING:
    from torch import Tensor

    from rbfevo.scenarios.scenario import Scenario


class Image(NamedTuple):
    """What mirror images of the centers add to the columns: sign +1 for components along the plane, -1 across it."""

    mirror: Mirror
    sign: float


class RBF(Representation):
    """Setups are centers [m, d]; column j of Phi is phi(|c_j - x|), with the image of c_j where there is one.

    Indirect manipulation moves the weights, U = Phi (eq. 2); direct manipulation moves the centers, U = Phi Psi^-1
    (eq. 4), Psi being Phi at the centers.

    Args:
        kernel: phi; image: what mirror images of the centers add to the columns, where the design is symmetric.
    """

    name = "rbf"
    dims = 2
    manipulations = ("indirect", "direct")
    plain = True  # each column is the kernel around one center

    def __init__(self, kernel: Kernel, image: Image | None = None) -> None:
        self.kernel, self.image = kernel, image

    def columns(self, setups: Any) -> int:
        """m."""
        return int(setups.shape[-2])

    def phi(self, points: Any, setups: Any) -> Any:
        """Phi_ij = phi(|c_j - x_i|) [*pop, q, m], plus or minus that of the images of the centers."""
        plain = self.kernel(_distances(setups, points))
        if self.image is None:
            return plain.mT
        images = self.kernel(_distances(self.image.mirror.image(setups), points))
        return (plain + self.image.sign * images).mT

    def psi(self, setups: Any) -> Any:
        """Psi_ij = phi(|c_j - c_i|), [*pop, m, m], symmetric."""
        return self.phi(setups, setups)

    def spec(self) -> dict[str, Any]:
        """The kernel; planes of symmetry are the run's."""
        return {"target": f"{RBF.__module__}.{RBF.__qualname__}", "kernel": self.kernel.spec()}

    @classmethod
    def of_spec(cls, **numbers: Any) -> RBF:
        """With the kernel that `kernel` describes."""
        return cls(kernel_of(numbers["kernel"]))

    def space(self, scenario: Scenario, centers: int) -> Space:
        """The scenario's box, its sampler, and what symmetry and fixed regions make of centers."""
        lower, upper = scenario.search_box
        placement = scenario.parameterization
        return Space(
            lower.expand(centers, -1),
            upper.expand(centers, -1),
            lambda count, generator: scenario.sample(count, centers, generator),
            placement,
            placement.pull,
        )

    def refuse(self, setups: Tensor, dimension: int) -> None:
        """Raise UserError unless setups are [*pop, m, d] with m >= 1."""
        if setups.ndim < 2 or setups.shape[-1] != dimension or setups.shape[-2] < 1:
            raise UserError(f"centers must have shape [*pop, m, {dimension}] with m >= 1, not {list(setups.shape)}")

    def handles(self, setups: Any) -> Any:
        """The centers."""
        return setups

    def reduce(self, setups: Tensor, factor: Tensor, manipulation: str) -> Reduced:
        """Psi^-1 T, whose singular values are those of Phi Psi^-1, and Psi^-1."""
        import torch

        from rbfevo.scoring.evolvability import singular
        from rbfevo.scoring.matrices import all_finite, inverse_definite, product, solve

        if manipulation == "indirect":
            return super().reduce(setups, factor, manipulation)
        m = setups.shape[1]
        Psi = self.psi(setups)
        identity = torch.eye(m, dtype=Psi.dtype, device=Psi.device)
        if self.kernel.positive_definite and self.image is None:
            inverse, sound = inverse_definite(Psi)
            reduced = product(inverse, factor)
            index = torch.nonzero(~sound).flatten()
        else:
            reduced, inverse = torch.empty_like(factor), torch.empty_like(Psi)
            index = torch.arange(len(Psi), device=Psi.device)
        if len(index):  # Psi = Psi^T
            solution = solve(Psi[index], torch.cat((factor[index], identity.expand_as(Psi[index])), dim=2))
            reduced[index], inverse[index] = solution[:, :, :m], solution[:, :, m:]
        lost = singular(Psi, inverse) | ~(all_finite(reduced) & all_finite(inverse))
        reduced = torch.where(lost[:, None, None], identity, reduced)
        return Reduced(reduced, torch.where(lost[:, None, None], identity, inverse), lost)

    def matrix(self, phi: Tensor, setup: Tensor, manipulation: str) -> Tensor | None:
        """Phi, or Phi Psi^-1; None where Psi is numerically singular."""
        import torch

        from rbfevo.scoring.evolvability import singular

        if manipulation == "indirect":
            return phi
        Psi = self.psi(setup)
        inverse, _ = torch.linalg.inv_ex(Psi)
        return None if bool(singular(Psi, inverse)) else torch.linalg.solve(Psi.mT, phi.mT).mT

    def pull(self, points: Tensor, setups: Tensor, gradient: Tensor) -> Tensor:
        """dc_j = sum_i dPhi_ij phi'(r_ij)/r_ij (c_j - x_i), and what comes through the images, turned over."""
        from rbfevo.scoring.matrices import product

        weighted = gradient * self.kernel.slope(_distances(setups, points))
        found = weighted.sum(2, keepdim=True) * setups - product(weighted, points)
        if self.image is not None:
            mirror, sign = self.image
            images = mirror.image(setups)
            weighted = gradient * self.kernel.slope(_distances(images, points))
            through = sign * (weighted.sum(2, keepdim=True) * images - product(weighted, points))
            through[..., mirror.axis].neg_()
            found = found + through
        return found

    def pull_reduction(self, setups: Tensor, through: Pull) -> Tensor:
        """With W = Psi^-1, sigma changes by -v_i^T dPsi z_i; |c_j' - c_i| = |c_j - c_i'| pulls both centers alike."""
        from rbfevo.scoring.matrices import product

        return self.pull_psi(setups, -product(through.scaled, through.reduced.mT))

    def pull_psi(self, setups: Tensor, dPsi: Tensor) -> Tensor:
        """Gradient [p, m, d] of a function whose gradient in the kernel's Psi is [p, m, m]."""
        from rbfevo.scoring.matrices import product

        S = dPsi + dPsi.mT
        H = S * self.kernel.slope(_distances(setups, setups))
        found = H.sum(2, keepdim=True) * setups - product(H, setups)
        if self.image is not None:
            mirror, sign = self.image
            images = mirror.image(setups)
            H = sign * S * self.kernel.slope(_distances(setups, images))
            found += H.sum(2, keepdim=True) * setups - product(H, images)
        return found

    def symmetric(self, mirror: Mirror) -> tuple[RBF, RBF]:
        """phi_c + phi_c' along the plane, and phi_c - phi_c' across it."""
        return RBF(self.kernel, Image(mirror, 1.0)), RBF(self.kernel, Image(mirror, -1.0))

    def assemble(self, centers: Tensor) -> Tensor:
        """The centers themselves."""
        return centers

    def atoms(self, points: Tensor) -> Callable[[Tensor], Tensor]:
        """phi(|c_j - x_i|), without images."""
        from rbfevo.scoring.gram import kernel_columns

        return kernel_columns(points, self.kernel)


def _distances(a: Any, b: Any) -> Any:
    """Distances [*pop, p, q] between points a [*pop, p, d] and b [*pop, q, d]."""
    if isinstance(a, np.ndarray):
        from scipy.spatial.distance import cdist

        return cdist(a, b)
    from rbfevo.scoring.distances import distances

    return distances(a, b)


def rbf(scenario: Scenario, kernel: Kernel, centers: int, polynomial: str | None = None) -> RBF:
    """Radial basis functions of the kernel that `kernel=` chooses, alone or with a `linear` polynomial.

    Raises:
        UserError: for another polynomial.
    """
    if polynomial is None:
        return RBF(kernel)
    refuse_others("representation.polynomial", polynomial, POLYNOMIALS)
    from rbfevo.scoring.representations.linear import LinearRBF, linear_functions

    return LinearRBF(kernel, linear_functions(scenario))
