"""Orthogonal least squares that pays for columns apart from those picked, by preference, on a few vertices.

With w = phi - Q Q^T phi of a candidate's column phi (`rbfevo.methods.ols`), OLS picks the largest gain in P,
|w^T r|_F^2 / (w^T w). Its ill-conditioned setups have picks with a small w^T w, so a preference lambda for regularity
picks the largest gain^(1 - lambda) (w^T w)^lambda: with lambda = 1 this is a QR factorization with column pivoting
(Businger & Golub, Numer. Math. 7, 1965). All preferences share each product with the candidates' columns.
"""

from __future__ import annotations

import torch
from torch import Tensor

VANISH = 1e-10  # of phi^T phi: a candidate with a smaller w^T w is not picked
TINY = 1e-300


@torch.no_grad()
def penalized(columns: Tensor, gradient: Tensor, count: int, preferences: Tensor, kept: Tensor | None = None) -> Tensor:
    """Pick `count` of c candidates greedily for each preference; indices [p, count].

    Args:
        columns: Phi [n, c] of the candidates, rows times the roots of the weights; gradient: g [n, k], likewise.
        count: how many to pick; preferences: [p] from 0 (OLS) to 1.
        kept: [n, q] columns that are there already.

    Returns:
        The indices, a candidate more than once where no other is left that is independent of those picked.
    """
    p, (n, c) = len(preferences), columns.shape
    whole = columns.square().sum(0)
    left = whole.expand(p, c).clone()
    moment = (columns.T @ gradient).expand(p, -1, -1).clone()
    residual = gradient.expand(p, n, -1).clone()
    basis = gradient.new_zeros(p, n, 0)
    share = preferences[:, None]
    picked = []
    for column in () if kept is None else kept.T:
        basis = _advance(columns, column.expand(p, n), basis, left, moment, residual)
    for _ in range(count):
        gain = moment.square().sum(2) / left.clamp_min(TINY)
        usable = (left > VANISH * whole) & torch.isfinite(left)
        merit = (1.0 - share) * gain.clamp_min(TINY).log() + share * left.clamp_min(TINY).log()
        best = torch.where(usable, merit, -torch.inf).argmax(1)
        picked.append(best)
        basis = _advance(columns, columns[:, best].T, basis, left, moment, residual)
    return torch.stack(picked, dim=1)


def _advance(columns: Tensor, chosen: Tensor, basis: Tensor, left: Tensor, moment: Tensor, residual: Tensor) -> Tensor:
    """Bring w^T w [p, c], w^T r [p, c, k] and r [p, n, k] up to date with columns `chosen` [p, n]; the new basis."""
    w = chosen[:, :, None]
    for _ in range(2):
        w = w - basis @ (basis.mT @ w)
    length = torch.linalg.vector_norm(w, dim=1, keepdim=True)
    q = torch.where(length > 0, w / length.clamp_min(TINY), 0.0)
    y = (columns.T @ q[:, :, 0].T).T
    reached = q.mT @ residual
    left.sub_(y.square()).clamp_min_(0.0)
    moment.sub_(y[:, :, None] * reached)
    residual.sub_(q * reached)
    return torch.cat((basis, q), dim=2)
