"""R and P of a setup at 90 digits, in fixed-point arithmetic: Python integers in units of 2^-BITS.

They are several times as fast as mpmath's numbers, as setups of 200 centers require; tests/test_numbers.py compares
the two on small setups. The factorization is G = Phi^T Phi = L L^T instead of that of Phi, which squares the condition
number: of 90 digits, 60 remain at 1e15. Phi has the singular values of L, and U = Phi Psi^-1 those of Psi^-1 L.
"""

from __future__ import annotations

import functools
import math
import operator
from typing import Any, NamedTuple

import mpmath
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.scoring.kernels import Kernel, ThinPlate, Wendland

BITS = 300  # after the binary point
Integers = NDArray[Any]  # Python integers in units of 2^-BITS
Point = tuple[int, ...]  # in units of 2^-BITS


class Design(NamedTuple):
    """Vertices [n, d] of the plane or the sphere and a smooth gradient [n, k] of unit norm."""

    vertices: Tensor
    gradient: Tensor


def integer(x: float) -> int:
    """A float64 number in units of 2^-BITS; exact for 0 and from 2^-248 on."""
    numerator, denominator = x.as_integer_ratio()
    return (numerator << BITS) // denominator


def phi(kernel: Kernel, a: Point, b: Point) -> int:
    """phi(|a - b|) of two points in units of 2^-BITS."""
    square = sum((s - t) ** 2 for s, t in zip(a, b, strict=True))  # in units of 2^(-2 BITS)
    if isinstance(kernel, ThinPlate):
        if square == 0:
            return 0
        with mpmath.workprec(BITS + 40):
            logarithm = mpmath.log(mpmath.ldexp(square, -2 * BITS))
            return (square * int(mpmath.ldexp(logarithm, BITS))) >> (2 * BITS + 1)
    r = math.isqrt(square)
    if isinstance(kernel, Wendland):
        q = (r << BITS) // integer(kernel.support or 0.0)
        one = 1 << BITS
        return ((one - q) ** 4 * (4 * q + one)) >> (4 * BITS) if q < one else 0
    return (square * r) >> (2 * BITS)


@functools.cache
def column(kernel: Kernel, center: Point, some: Design) -> list[int]:
    """A column of Phi [n]; cached, since setups share most of their centers."""
    return [phi(kernel, x, center) for x in integers(some.vertices)]


@functools.cache
def product(kernel: Kernel, a: Point, b: Point, some: Design) -> int:
    """The inner product of two columns."""
    return sum(map(operator.mul, column(kernel, a, some), column(kernel, b, some))) >> BITS


def integers(some: Tensor) -> list[Point]:
    """The rows of a matrix in units of 2^-BITS."""
    return [tuple(map(integer, row)) for row in some.tolist()]


def cholesky(G: Integers) -> Integers:
    """L with G = L L^T."""
    L = np.zeros_like(G)
    for j in range(len(G)):
        reduced = (G[j:, j] << BITS) - L[j:, :j] @ L[j, :j] if j else G[:, 0] << BITS
        L[j:, j] = reduced // math.isqrt(reduced[0])
    return L


def forward(L: Integers, B: Integers) -> Integers:
    """L^-1 B by forward substitution."""
    X = B.copy()
    for i in range(len(L)):
        X[i] = ((B[i] << BITS) - (L[i, :i] @ X[:i] if i else 0)) // L[i, i]
    return X


def solve(A: Integers, B: Integers) -> Integers | None:
    """A^-1 B by Gaussian elimination with row pivoting; None if A is singular."""
    M, m = np.concatenate([A, B], axis=1), len(A)
    for j in range(m):
        pivot = j + max(range(m - j), key=lambda i: abs(M[j + i, j]))
        if M[pivot, j] == 0:
            return None
        M[[j, pivot]] = M[[pivot, j]]
        M[j, j + 1 :] = (M[j, j + 1 :] << BITS) // M[j, j]
        M[j + 1 :, j + 1 :] -= (M[j + 1 :, j, None] * M[j, None, j + 1 :]) >> BITS
    for j in range(m - 1, 0, -1):
        M[:j, m:] -= (M[:j, j, None] * M[j, None, m:]) >> BITS
    return M[:, m:]


def norm(A: Integers) -> Any:
    """The largest singular value: the Rayleigh quotient at the float64 singular vector, which squares its error."""
    size = max(int(abs(A).max()).bit_length() - 900, 0)
    v = np.linalg.svd((A >> size).astype(np.float64))[2][0]
    w = np.array([integer(x) for x in v.tolist()], dtype=object)
    return mpmath.sqrt(mpmath.mpf(int(((A @ w) ** 2).sum())) / int((w * w).sum())) / mpmath.ldexp(1, BITS)


class Exact(NamedTuple):
    """Condition numbers of Phi and Psi (infinite where singular), R for each manipulation, and P."""

    of_phi: float
    of_psi: float
    indirect: float
    direct: float
    potential: float


def exact(kernel: Kernel, centers: Tensor, some: Design) -> Exact:
    """Scores of a setup [m, d] at 90 digits; centers that coincide count once for P."""
    C = list(dict.fromkeys(integers(centers)))
    G, Psi = (
        np.array([[entry(*sorted((a, b))) for a in C] for b in C], dtype=object)
        for entry in (lambda a, b: product(kernel, a, b, some), lambda a, b: phi(kernel, a, b))
    )
    columns = np.array([column(kernel, c, some) for c in C], dtype=object)
    g = np.array(integers(some.gradient), dtype=object)
    with mpmath.workprec(BITS):
        L = cholesky(G)
        size = mpmath.ldexp(1, 2 * BITS)
        potential = float(mpmath.mpf(int((forward(L, (columns @ g) >> BITS) ** 2).sum())) / size)
        one = np.diag([1 << BITS] * len(C)).astype(object)
        if len(C) < len(centers):
            return Exact(math.inf, math.inf, 0.0, 0.0, potential)
        of_phi = norm(L) * norm(forward(L, one))
        inverse = solve(Psi, np.concatenate([one, L], axis=1))
        if inverse is None:
            return Exact(float(of_phi), math.inf, float(1 / of_phi), 0.0, potential)
        of_psi = norm(Psi) * norm(inverse[:, : len(C)])
        of_u = norm(inverse[:, len(C) :]) * norm(forward(L, Psi))
        return Exact(float(of_phi), float(of_psi), float(1 / of_phi), float(1 / of_u), potential)
