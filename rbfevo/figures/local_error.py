"""Where a setup is needed and what it leaves: local errors of the estimated gradient, in plain NumPy from the files."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.distance import cdist

from rbfevo.errors import UserError
from rbfevo.record import Array, Record

BLOCK = 65_536  # vertices at a time


def wendland(r: Array, support: float) -> Array:
    """Wendland C2, (1 - r/s)^4 (4 r/s + 1) for r < s, else 0; distances r of any shape."""
    q = np.minimum(r / support, 1.0)
    return (1.0 - q) ** 4 * (4.0 * q + 1.0)


def triharmonic(r: Array, dimension: int) -> Array:
    """What the paper calls triharmonic: r^2 log r in the plane, r^3 in space; distances r of any shape."""
    return r**2 * np.log(np.where(r > 0, r, 1.0)) if dimension == 2 else r**3


def kernel(record: Record) -> Callable[[Array], Array]:
    """Return the run's kernel, distances -> values.

    Raises:
        UserError: if summary.json names a kernel that is not known here.
    """
    name, support = record.summary.get("kernel"), record.summary.get("support")
    if name == "wendland" and isinstance(support, int | float) and support > 0:
        return lambda r: wendland(r, float(support))
    if name == "triharmonic":
        return lambda r: triharmonic(r, record.vertices.shape[1])
    raise UserError(f"what a setup leaves is not known for kernel={name} with support radius {support}")


def reached(record: Record, index: int) -> Array:
    """Return U U^+ g [n, k], the part of the gradient that setup `index` can follow (paper, eq. 8).

    Rows count with the square root of their weight in the fit, not in the result. Direct and indirect manipulation span
    the same space, so U = Phi serves both. One pass over blocks of vertices keeps the triangular factor of [Phi | g].
    """
    phi, centers = kernel(record), record.centers[index]
    n, m = len(record.vertices), len(centers)
    blocks = [slice(start, start + BLOCK) for start in range(0, n, BLOCK)]
    triangle = np.empty((0, m + record.gradient.shape[1]))
    for rows in blocks:
        columns = np.hstack([phi(cdist(record.vertices[rows], centers)), record.gradient[rows]])
        columns *= np.sqrt(record.weights[rows, None])
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, columns]), mode="r"))
    parameters = np.linalg.lstsq(triangle[:, :m], triangle[:, m:], rcond=max(n, m) * np.finfo(float).eps)[0]
    return np.concatenate([phi(cdist(record.vertices[rows], centers)) @ parameters for rows in blocks])


def local_error(displacement: Array) -> Array:
    """Return the row norms [n] of a displacement [n, k]."""
    return np.linalg.norm(displacement, axis=1)
