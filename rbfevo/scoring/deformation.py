"""From control points to the deformation matrix U of X' = X + U P (paper, eqs. 2 to 5)."""

from __future__ import annotations

from torch import Tensor, nn

from rbfevo.choices import MANIPULATIONS, refuse_others
from rbfevo.scoring.images import Image, values
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.matrices import solve


class RBFDeformation(nn.Module):
    """The RBF deformation of a design: centers [*pop, m, d] -> U [*pop, n, m].

    Indirect manipulation moves the weights, U = Phi (eq. 2); direct manipulation moves the centers, U = Phi Psi^-1
    (eq. 4). There is no polynomial term (eq. 1).

    Args:
        vertices: [n, d], model units.
        kernel: phi.
        manipulation: `indirect` or `direct`.
        image: what mirror images of the centers add to the columns, where the design is symmetric.

    Raises:
        UserError: if the manipulation is unknown.
    """

    def __init__(
        self, vertices: Tensor, kernel: Kernel, manipulation: str = "indirect", image: Image | None = None
    ) -> None:
        super().__init__()
        refuse_others("manipulation", manipulation, MANIPULATIONS)
        self.register_buffer("vertices", vertices)
        self.vertices: Tensor
        self.kernel = kernel
        self.manipulation = manipulation
        self.image = image

    def columns(self, points: Tensor, centers: Tensor) -> Tensor:
        """Phi at other points [*pop, q, d] than the vertices, [*pop, q, m]."""
        return values(self.kernel, centers, points, self.image).mT

    def phi(self, centers: Tensor) -> Tensor:
        """Phi_ij = phi(|c_j - x_i|), [*pop, n, m]."""
        return self.columns(self.vertices, centers)

    def psi(self, centers: Tensor) -> Tensor:
        """Psi_ij = phi(|c_j - c_i|), [*pop, m, m], symmetric."""
        return self.columns(centers, centers)

    def forward(self, centers: Tensor) -> Tensor:
        """U [*pop, n, m]; direct setups with a singular Psi come out as infinite or NaN instead of raising."""
        phi = self.phi(centers)
        if self.manipulation == "indirect":
            return phi
        n, m = phi.shape[-2:]
        solution = solve(self.psi(centers).reshape(-1, m, m), phi.reshape(-1, n, m).mT)  # U Psi = Phi, Psi = Psi^T
        return solution.mT.reshape(phi.shape)
