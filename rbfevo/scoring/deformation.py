"""From setups to the deformation matrix U of X' = X + U P (paper, eqs. 2 to 5)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from rbfevo.choices import MANIPULATIONS, refuse_others
from rbfevo.errors import UserError
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.matrices import solve
from rbfevo.scoring.representations import RBF, Representation
from rbfevo.scoring.representations.rbf import Image


class Deformation(nn.Module):
    """The deformation of a design in one representation, under one manipulation: setups [*pop, *setup] -> Phi and U.

    Args:
        vertices: [n, d], model units.
        representation: what makes columns of a setup.
        manipulation: `indirect` or `direct`.
        blend: [n] what rows of Phi, and so of U, are multiplied by: 0 where a vertex is held; None for ones.

    Raises:
        UserError: if the manipulation is unknown, or the representation does not offer it.
    """

    def __init__(
        self,
        vertices: Tensor,
        representation: Representation,
        manipulation: str = "indirect",
        blend: Tensor | None = None,
    ) -> None:
        super().__init__()
        refuse_others("manipulation", manipulation, MANIPULATIONS)
        if manipulation not in representation.manipulations:
            offered = " or ".join(representation.manipulations)
            raise UserError(f"manipulation={manipulation}: representation={representation.name} offers {offered}")
        self.register_buffer("vertices", vertices)
        self.vertices: Tensor
        self.register_buffer("blend", blend)
        self.blend: Tensor | None
        self.kernel: Any = representation.kernel if isinstance(representation, RBF) else None
        self.representation = representation
        self.manipulation = manipulation

    def phi(self, setups: Tensor, rows: slice = slice(None)) -> Tensor:
        """Phi [*pop, n, r] at the vertices, or at some of them, times the blend."""
        phi = self.representation.phi(self.vertices[rows], setups)
        return phi if self.blend is None else self.blend[rows, None] * phi

    def forward(self, setups: Tensor) -> Tensor:
        """U [*pop, n, m]; setups for which W does not exist come out as NaN instead of raising."""
        phi, dims = self.phi(setups), self.representation.dims
        flat, each = phi.reshape(-1, *phi.shape[-2:]), setups.reshape(-1, *setups.shape[-dims:])
        found = [self.representation.matrix(p, s, self.manipulation) for p, s in zip(flat, each, strict=True)]
        like = next((U for U in found if U is not None), flat[0])
        U = torch.stack([torch.full_like(like, torch.nan) if one is None else one for one in found])
        return U.reshape(*phi.shape[:-2], *like.shape)


class RBFDeformation(Deformation):
    """The RBF deformation of a design: centers [*pop, m, d] -> U [*pop, n, m].

    Indirect manipulation moves the weights, U = Phi (eq. 2); direct manipulation moves the centers, U = Phi Psi^-1
    (eq. 4). There is no polynomial term (eq. 1).

    Args:
        vertices: [n, d], model units.
        kernel: phi.
        manipulation: `indirect` or `direct`.
        image: what mirror images of the centers add to the columns, where the design is symmetric.
        blend: as for `Deformation`; Psi is free of it.

    Raises:
        UserError: if the manipulation is unknown.
    """

    def __init__(
        self,
        vertices: Tensor,
        kernel: Kernel,
        manipulation: str = "indirect",
        image: Image | None = None,
        blend: Tensor | None = None,
    ) -> None:
        super().__init__(vertices, RBF(kernel, image), manipulation, blend)
        self.rbf = RBF(kernel, image)

    def psi(self, centers: Tensor) -> Tensor:
        """Psi_ij = phi(|c_j - c_i|), [*pop, m, m], symmetric."""
        return self.rbf.psi(centers)

    def forward(self, setups: Tensor) -> Tensor:
        """U [*pop, n, m]; direct setups with a singular Psi come out as infinite or NaN instead of raising."""
        phi = self.phi(setups)
        if self.manipulation == "indirect":
            return phi
        n, m = phi.shape[-2:]
        solution = solve(self.psi(setups).reshape(-1, m, m), phi.reshape(-1, n, m).mT)  # U Psi = Phi, Psi = Psi^T
        return solution.mT.reshape(phi.shape)


def deformation_of(
    vertices: Tensor, of: Kernel | Representation, manipulation: str, blend: Tensor | None = None
) -> Deformation:
    """The deformation in a representation, or in that by RBFs of a kernel."""
    if isinstance(of, Kernel):
        return RBFDeformation(vertices, of, manipulation, blend=blend)
    if isinstance(of, RBF) and of.plain:
        return RBFDeformation(vertices, of.kernel, manipulation, of.image, blend)
    return Deformation(vertices, of, manipulation, blend)
