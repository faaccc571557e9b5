"""The error that a design optimization minimizes, in m coordinates instead of n vertices.

With S = [sqrt(W) U; sqrt(smoothness) L U] = Q T (thin QR rather than the normal equations, since U may be
ill-conditioned), v = T P are orthonormal coordinates of the deformation and |S P - y|^2 = |v - Q^T y|^2 + const: an
error costs m x m, whatever n. Only a new set of closest points, one a generation, looks at vertices.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.scenarios.scenario import Scenario


class Pairs(NamedTuple):
    """What B designs are compared with: while these pairs hold, the error of coordinates v is |v - target|^2 + floor.

    Attributes:
        target: [B, m, k] the best coordinates for these pairs.
        floor: [B] the error at the target.
        error: [B] that of the design which the pairs were looked up for.
    """

    target: Tensor
    floor: Tensor
    error: Tensor


class Optimum(NamedTuple):
    """The least error [B], its coordinates v [B, m, k], and how often closest points were looked up for it [B]."""

    error: Tensor
    coordinates: Tensor
    iterations: Tensor


class Objective:
    """Errors of deformed designs X + U P for B setups at once, minimized; float64, on the host.

    Where the scenario's target is fixed the error is |U P - t|_F^2, t = gradient * gradient_norm, rows weighted. Where
    it has closest points it is, with u = U P,

        sum over the other vertices |x_i + u_i - c_i|^2 + sum over those that stay |u_i|^2 + smoothness |L u|_F^2,

    c_i the closest point of x_i + u_i, the first two sums weighted, L = I - D^-1 A the umbrella Laplacian. Which
    vertices stay is decided once, by the scenario, so that closest points and least squares in turn lower the error.

    Args:
        scenario: the design and what it should become.
        matrices: B deformation matrices U [n, m] of full rank, taken one at a time; none is kept.
        smoothness: weight of the Laplacian term, at least 0.

    Attributes:
        T: [B, m, m] upper triangular, v = T P.
        size: [B] |sqrt(W) U|_F.
        wanted: |t|_F, weighted: the square root of the error of P = 0.

    Raises:
        UserError: if smoothness is negative or not finite, or positive where the target is fixed.
    """

    def __init__(self, scenario: Scenario, matrices: Iterable[Tensor], smoothness: float = 0.0) -> None:
        if not (math.isfinite(smoothness) and smoothness >= 0):
            raise UserError(f"smoothness={smoothness}: give a number of at least 0")
        self._closest = scenario.closest
        if self._closest is None and smoothness > 0:
            raise UserError(
                f"smoothness={smoothness}: scenario {scenario.name} has a fixed target and takes none; leave it out"
            )
        n = len(scenario.vertices)
        root = scenario.weights.sqrt()[:, None]
        stays = torch.zeros(n, dtype=torch.bool) if scenario.stays is None else scenario.stays
        self._fitted, self._root = ~stays, root[~stays]
        self._start = scenario.vertices[~stays]
        t = root * scenario.gradient * scenario.gradient_norm
        self.wanted = float(t.norm())
        L = umbrella(scenario.faces.numpy(), n) if smoothness > 0 else None
        factors = [self._factor(U, root, L, smoothness, t) for U in matrices]
        names = ("T", "size", "_target", "_floor") if self._closest is None else ("T", "size", "_Q", "_regularizer")
        self._batched = names
        for name, parts in zip(names, zip(*factors, strict=True), strict=False):
            setattr(self, name, torch.stack(parts))
        self.T: Tensor
        self.size: Tensor
        self._target: Tensor  # [B, m, k] and [B], where the target is fixed
        self._floor: Tensor
        self._Q: Tensor  # [B, fitted, m] rows of Q; and R of its other rows, of the vertices that stay and of L
        self._regularizer: Tensor

    def _factor(
        self, U: Tensor, root: Tensor, L: csr_array | None, smoothness: float, t: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        S = root * U
        size = S.norm()
        if L is not None:
            S = torch.cat([S, math.sqrt(smoothness) * torch.from_numpy(L @ U.numpy())])
        Q, T = torch.linalg.qr(S)
        if self._closest is None:
            target = Q.mT @ t
            return T, size, target, (t - Q @ target).square().sum()
        fitted = torch.cat([self._fitted, torch.zeros(len(S) - len(U), dtype=torch.bool)])
        return T, size, Q[fitted], torch.linalg.qr(Q[~fitted], mode="r")[1]

    def __len__(self) -> int:
        return len(self.T)

    def select(self, elements: Tensor) -> Objective:
        """The same objective for some of the setups: `elements` [B] bool."""
        chosen = copy.copy(self)
        for name in self._batched:
            setattr(chosen, name, getattr(self, name)[elements])
        return chosen

    def pairs(self, coordinates: Tensor) -> Pairs:
        """Look up the closest points for the designs of coordinates v [B, m, k], and their errors."""
        if self._closest is None:
            error = (coordinates - self._target).square().sum((1, 2)) + self._floor
            return Pairs(self._target, self._floor, error)
        u = self._Q @ coordinates
        points = (self._start + u / self._root).numpy()
        closest = torch.from_numpy(self._closest(points.reshape(-1, points.shape[-1]))).reshape(u.shape)
        y = self._root * (closest - self._start)
        target = self._Q.mT @ y
        error = (u - y).square().sum((1, 2)) + (self._regularizer @ coordinates).square().sum((1, 2))
        floor = (error - (coordinates - target).square().sum((1, 2))).clamp(min=0)
        return Pairs(target, floor, error)

    def errors(self, parameters: Tensor, pairs: Pairs) -> Tensor:
        """Errors [B, lambda] of parameters P [B, lambda, m, k] while `pairs` hold."""
        B, offspring, m, k = parameters.shape
        v = parameters.mT.reshape(B, offspring * k, m) @ self.T.mT
        return (v.unflatten(1, (offspring, k)) - pairs.target.mT[:, None]).square().sum((2, 3)) + pairs.floor[:, None]

    def optimum(self, tolerance: float = 1e-8, limit: int = 2000, stop: Callable[[], bool] | None = None) -> Optimum:
        """The least error: exact for a fixed target, else the limit of closest points and least squares in turn.

        From P = 0, until a turn lowers the error by no more than `tolerance` of it, at most `limit` turns. It belongs
        to the design space: no manipulation changes it. Where `stop()` is true, the iteration ends early.
        """
        if self._closest is None:
            return Optimum(self._floor, self._target, torch.ones(len(self), dtype=torch.int64))
        objective, running = self, torch.arange(len(self))
        pairs = objective.pairs(torch.zeros_like(self._Q[:, :1].mT).expand(-1, -1, 3))
        error, iterations = pairs.error.clone(), torch.ones(len(self), dtype=torch.int64)
        coordinates = torch.zeros_like(pairs.target)
        for _ in range(limit):
            after = objective.pairs(pairs.target)
            coordinates[running], error[running] = pairs.target, after.error
            iterations[running] += 1
            going = pairs.error - after.error > tolerance * after.error
            objective, running = objective.select(going), running[going]
            pairs = Pairs(*(part[going] for part in after))
            if len(running) == 0 or (stop is not None and stop()):
                break
        return Optimum(error, coordinates, iterations)


def residuals(scenario: Scenario, displacement: Tensor) -> Tensor:
    """The residuals [n, k] of a displacement u [n, k]: u - t, or the difference from the closest point.

    For vertices that stay it is u itself. Model units; without the Laplacian term.
    """
    if scenario.closest is None:
        return displacement - scenario.gradient * scenario.gradient_norm
    points = scenario.vertices + displacement
    left = points - torch.from_numpy(scenario.closest(points.numpy()))
    return left if scenario.stays is None else torch.where(scenario.stays[:, None], displacement, left)


def umbrella(faces: NDArray[np.int64], n: int) -> csr_array:
    """The umbrella operator L = I - D^-1 A [n, n] of triangles [f, 3], D the valences; 0 where a vertex has no edge."""
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    A = csr_array((np.ones(len(i)), (i, j)), shape=(n, n))
    valence = A.sum(axis=1)
    mean = diags_array(1.0 / np.maximum(valence, 1.0)) @ A
    return csr_array(diags_array((valence > 0).astype(np.float64)) - mean)
