"""Designs and kernels to test on, and their scores in plain NumPy and at many digits."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import mpmath
import numpy as np
import torch
import trimesh
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from torch import Tensor

from rbfevo.scoring.kernels import Cubic, Gaussian, Kernel, Multiquadric, ThinPlate, Wendland, WendlandC0, WendlandC4
from rbfevo.scoring.kernels.scaled import Scaled

EPS = np.finfo(np.float64).eps


@dataclasses.dataclass(frozen=True)
class Design:
    """Vertices [n, d], unit gradient [n, k] and weights [n] of a small plane or sphere."""

    vertices: Tensor
    gradient: Tensor
    weights: Tensor

    def centers(self, *shape: int, seed: int = 0) -> Tensor:
        """Random centers [*shape, d]: uniform in the plane's box, or on the sphere."""
        generator = torch.Generator().manual_seed(seed)
        if self.vertices.shape[1] == 2:
            box = torch.tensor([1.0, 2.0], dtype=torch.float64)
            return torch.rand(*shape, 2, generator=generator, dtype=torch.float64) * box
        points = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
        return points / points.norm(dim=-1, keepdim=True)


def _design(vertices: Tensor, k: int, weighted: bool, seed: int = 1) -> Design:
    generator = torch.Generator().manual_seed(seed)
    n = len(vertices)
    weights = torch.ones(n, dtype=torch.float64)
    if weighted:
        weights = 0.1 + torch.rand(n, generator=generator, dtype=torch.float64)
    waves = torch.stack([torch.sin((2.0 + q) * vertices[:, q % vertices.shape[1]] + q) for q in range(k)], dim=1)
    gradient = waves + 0.1 * torch.randn(n, k, generator=generator, dtype=torch.float64)
    return Design(vertices, gradient / (weights[:, None] * gradient.square()).sum().sqrt(), weights)


def plane(nx: int = 50, ny: int = 50, k: int = 1, weighted: bool = False) -> Design:
    """A grid of nx x ny vertices on [0, 1] x [0, 2]."""
    x = torch.linspace(0.0, 1.0, nx, dtype=torch.float64)
    y = torch.linspace(0.0, 2.0, ny, dtype=torch.float64)
    return _design(torch.stack([x.repeat(ny), y.repeat_interleave(nx)], dim=1), k, weighted)


def sphere(subdivisions: int = 4, k: int = 3, weighted: bool = False) -> Design:
    """An icosphere of 10 * 4^subdivisions + 2 vertices."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    return _design(torch.from_numpy(np.array(mesh.vertices, np.float64)), k, weighted)


DESIGNS = {"plane": plane, "sphere": sphere}

# The paper's: both support radii, and its triharmonic kernel, on the plane and on the sphere.
KERNELS: dict[str, dict[str, Kernel]] = {
    "plane": {"wendland 0.25": Wendland(0.25), "wendland 0.5": Wendland(0.5), "triharmonic": ThinPlate()},
    "sphere": {"wendland 0.5": Wendland(0.5), "wendland 1": Wendland(1.0), "triharmonic": Cubic()},
}
PAIRS = [(design, kernel) for design, kernels in KERNELS.items() for kernel in kernels]


def numpy_phi(kernel: Kernel, r: np.ndarray) -> np.ndarray:
    """The textbook's phi(r), written anew."""
    if isinstance(kernel, Wendland):
        assert kernel.support is not None
        q = r / kernel.support
        return np.where(q < 1.0, (1.0 - q) ** 4 * (4.0 * q + 1.0), 0.0)
    if isinstance(kernel, ThinPlate):
        return np.where(r > 0.0, r**2 * np.log(np.where(r > 0.0, r, 1.0)), 0.0)
    return r**3


def numpy_scores(design: Design, kernel: Kernel, manipulation: str, centers: Tensor) -> tuple[float, float, float]:
    """R, P and V of one setup [m, d] by plain NumPy: SVD, pseudoinverse and matrix rank of a stored U."""
    X, C = design.vertices.numpy(), centers.numpy()
    W = np.sqrt(design.weights.numpy())[:, None]
    g = W * design.gradient.numpy()
    n, m = len(X), len(C)
    cut = max(n, m) * EPS
    Phi = numpy_phi(kernel, cdist(X, C))
    sigma = np.linalg.svd(W * Phi, compute_uv=False)
    rank = int(np.linalg.matrix_rank(W * Phi, tol=cut * sigma[0]))
    A = W * Phi
    potential = 1.0 - float(np.linalg.norm(g - A @ (np.linalg.pinv(A, rcond=cut) @ g))) ** 2
    if rank < m:
        return 0.0, potential, rank / n
    if manipulation == "direct":
        Psi = numpy_phi(kernel, cdist(C, C))
        if (m == 1 and Psi[0, 0] == 0.0) or np.linalg.cond(Psi, 1) > 1.0 / (m * EPS):
            return 0.0, potential, rank / n
        sigma = np.linalg.svd(W * (Phi @ np.linalg.inv(Psi)), compute_uv=False)
    return float(sigma[-1] / sigma[0]), potential, rank / n


def exact_scores(
    design: Design, kernel: Kernel, manipulation: str, centers: Tensor, digits: int = 80
) -> tuple[float, float]:
    """R and P of one setup [m, d] of full rank, from its float64 coordinates on at `digits` digits."""
    with mpmath.workdps(digits):
        X = [[mpmath.mpf(value) for value in row] for row in design.vertices.tolist()]
        C = [[mpmath.mpf(value) for value in row] for row in centers.tolist()]
        W = [mpmath.sqrt(value) for value in design.weights.tolist()]
        Phi = mpmath.matrix([[w * exact_phi(kernel, _distance(x, c)) for c in C] for x, w in zip(X, W, strict=True)])
        g = mpmath.matrix(design.gradient.tolist())
        for i, w in enumerate(W):
            g[i, :] = w * g[i, :]
        G = Phi.T * Phi
        b = Phi.T * g
        solution = mpmath.lu_solve(G, b) if b.cols == 1 else mpmath.inverse(G) * b
        potential = sum(solution[i, q] * b[i, q] for i in range(b.rows) for q in range(b.cols))
        if manipulation == "direct":
            inverse = mpmath.inverse(mpmath.matrix([[exact_phi(kernel, _distance(a, c)) for c in C] for a in C]))
            G = inverse.T * G * inverse
        squares = sorted(mpmath.eigsy(G, eigvals_only=True))
        return float(mpmath.sqrt(squares[0] / squares[-1])), float(potential)


def exact_phi(kernel: Kernel, r: Any) -> Any:
    """phi(r) at the working precision of mpmath."""
    if isinstance(kernel, Wendland):
        q = r / mpmath.mpf(kernel.support)
        return (1 - q) ** 4 * (4 * q + 1) if q < 1 else mpmath.mpf(0)
    if isinstance(kernel, WendlandC0 | WendlandC4):
        q = r / mpmath.mpf(kernel.support)
        whole = (1 - q) ** 2 if isinstance(kernel, WendlandC0) else (1 - q) ** 6 * (35 * q**2 + 18 * q + 3) / 3
        return whole if q < 1 else mpmath.mpf(0)
    if isinstance(kernel, Scaled):
        q = r / mpmath.mpf(kernel.scale)
        if isinstance(kernel, Gaussian):
            return mpmath.exp(-(q**2))
        return mpmath.sqrt(1 + q**2) ** (1 if isinstance(kernel, Multiquadric) else -1)
    if isinstance(kernel, ThinPlate):
        return r**2 * mpmath.log(r) if r > 0 else mpmath.mpf(0)
    return r**3


def _distance(a: list, b: list) -> Any:
    return mpmath.sqrt(sum((s - t) ** 2 for s, t in zip(a, b, strict=True)))


def _within_reach(blocks: list[tuple[list[int], np.ndarray]], shape: tuple[int, ...], u: np.ndarray) -> np.ndarray:
    """A basis [n, k, r] of what blocks of components and columns reach, orthonormal where rows count with u."""
    (n, k), roots, pieces = shape, np.sqrt(u)[:, None], []
    for components, U in blocks:
        left, sigma, _ = np.linalg.svd(roots * U, full_matrices=False)
        left = left[:, sigma > n * EPS * sigma[0]] / roots
        for c in components:
            wide = np.zeros((n, k, left.shape[1]))
            wide[:, c] = left
            pieces.append(wide)
    return np.concatenate(pieces, axis=2)


def certified_potential(
    blocks: list[tuple[list[int], np.ndarray]], gradient: np.ndarray, u: np.ndarray, p: float
) -> tuple[float, float]:
    """Bounds below and above of P_p: blocks of components and their columns of U, g [n, k], u of sum 1.

    Below: a.d / |d|_p of one d in the span, found by damped Newton steps for |d|_p^p / p - a.d. Above: |h|_p* of one h
    that gains what a does for every d in the span. Each holds however well d and h were found.
    """
    a = u[:, None] * gradient
    a, A = a / np.abs(a).max(), _within_reach(blocks, gradient.shape, u)
    b = np.einsum("nkr,nk->r", A, a)
    star = p / (p - 1)

    def loss(z: np.ndarray, q: float) -> float:
        with np.errstate(over="ignore"):  # of a step that is far too long
            return float((u * np.linalg.norm(A @ z, axis=1) ** q).sum() / q - b @ z)

    z = b
    for q in [q for q in (2.0, 4.0, 8.0, 16.0, 24.0, 32.0, 48.0) if q < p] + [p]:
        z = z * ((b @ z) / (u * np.linalg.norm(A @ z, axis=1) ** q).sum()) ** (1 / (q - 1))  # the best on its ray
        for _ in range(200):
            d = A @ z
            lengths = np.linalg.norm(d, axis=1)
            weight = u * lengths ** (q - 2)
            slope = np.einsum("nkr,nk->r", A, weight[:, None] * d) - b
            along = np.einsum("nkr,nk->nr", A, d / np.where(lengths > 0, lengths, 1)[:, None])
            H = np.einsum("nkr,n,nks->rs", A, weight, A, optimize=True) + (q - 2) * (along.T * weight) @ along
            step = np.linalg.solve(H + 1e-14 * np.trace(H) * np.eye(len(z)), -slope)
            share, before, fall = 1.0, loss(z, q), slope @ step
            while share > 1e-9 and not loss(z + share * step, q) <= before + 1e-4 * share * fall + 1e-15 * abs(before):
                share /= 2
            z = z + share * step
            if -fall <= 1e-26 * abs(before):
                break
    d = A @ z
    lengths = np.linalg.norm(d, axis=1)
    below = (b @ z) / (u * lengths**p).sum() ** (1 / p)
    h = (u * lengths ** (p - 2))[:, None] * d
    h = h + u[:, None] * (A @ (b - np.einsum("nkr,nk->r", A, h)))  # the columns of A are orthonormal where u counts
    assert np.abs(np.einsum("nkr,nk->r", A, h) - b).max() <= 1e-12 * np.abs(b).max()
    above, most = ((u * np.linalg.norm(f / u[:, None], axis=1) ** star).sum() ** (1 / star) for f in (h, a))
    return (below / most) ** 2, (above / most) ** 2


def scipy_potential(blocks: list[tuple[list[int], np.ndarray]], gradient: np.ndarray, u: np.ndarray, p: float) -> float:
    """P_p by its formula and SciPy's BFGS: blocks of components and their columns of U, g [n, k], u of sum 1."""
    a, A = u[:, None] * gradient, _within_reach(blocks, gradient.shape, u)
    b = np.einsum("nkr,nk->r", A, a)

    def loss(z: np.ndarray, q: float) -> tuple[float, np.ndarray]:
        d = A @ z
        lengths = np.linalg.norm(d, axis=1)
        size = float((u * lengths**q).sum() ** (1 / q))
        slope = np.einsum("nkr,nk->r", A, (u * lengths ** (q - 2))[:, None] * d) / size**q
        return math.log(size) - math.log(b @ z), slope - b / (b @ z)

    z = b
    for q in (2.0, 4.0, 8.0, p):
        if q <= p:
            z = z / np.linalg.norm(z)
            z = minimize(loss, z, (q,), jac=True, method="BFGS", options={"gtol": 1e-10, "maxiter": 3000}).x
    star = p / (p - 1)
    dual = (u * np.linalg.norm(a / u[:, None], axis=1) ** star).sum() ** (1 / star)
    return math.exp(-2 * loss(z, p)[0]) / dual**2
