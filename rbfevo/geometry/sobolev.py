"""The Sobolev filter of a triangle mesh: it smooths a field on the surface over a length l.

Of a density d (a value per area, or any function of the surface) it makes the g that minimizes

    integral of (g - d)^2 + l^2 |grad g|^2,    that is    (M + l^2 K) g = M d,

with linear elements: M are the vertex areas (the lumped mass matrix), K is the stiffness matrix of the surface
(cotangents). Constants stay as they are, the integral of the field is conserved, and a wave of wave number k is
divided by 1 + l^2 k^2. Nothing flows over an open boundary (natural conditions). At an edge of more than two triangles
the sums go over all of them; pieces that share no vertex do not influence each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from rbfevo.arrays import Points, Triangles
from rbfevo.geometry.curves import segment_lengths, vertex_lengths
from rbfevo.geometry.topology import vertex_areas

Array = NDArray[np.float64]

THINNEST = 1e-8  # height over longest edge: flatter triangles have no usable cotangents


def mass(vertices: Points, triangles: Triangles) -> Array:
    """The lumped mass matrix as its diagonal [n]: a third of the area of each vertex's triangles, squared units.

    Args:
        vertices: [n, 3]; triangles: [f, 3], or of a curve segments [s, 2]: then half the length of each.
    """
    curve = triangles.shape[1] == 2
    return vertex_lengths(vertices, triangles) if curve else vertex_areas(vertices, triangles)


def stiffness(vertices: Points, triangles: Triangles) -> csr_array:
    """The stiffness matrix K [n, n] of linear elements, K_ij = integral of grad phi_i . grad phi_j, without unit.

    Symmetric and positive semidefinite, with rows that sum to 0. Triangles whose height is below 1e-8 of their longest
    edge are left out: they have no area to speak of, and their gradients are not finite.

    Args:
        vertices: [n, 3]; triangles: [f, 3], or of a curve segments [s, 2], whose K has the unit 1 / length.
    """
    n = len(vertices)
    if triangles.shape[1] == 2:
        i, j = triangles.T
        inverse = 1.0 / segment_lengths(vertices, triangles)
        entries = np.concatenate([inverse, inverse, -inverse, -inverse])
        places = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
        return csr_array(coo_array((entries, places), shape=(n, n)))
    corners = vertices[triangles]
    edges = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)  # edge i is opposite to corner i
    longest = np.sqrt((edges**2).sum(axis=2).max(axis=1, initial=0.0))
    sound = longest > 0.0
    edges[sound] /= longest[sound, None, None]  # K does not depend on the size of a triangle
    doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    sound &= doubled > THINNEST
    edges, doubled, triangles = edges[sound], doubled[sound], triangles[sound]
    local = np.einsum("fid,fjd->fij", edges, edges) / (2.0 * doubled)[:, None, None]
    rows, columns = np.repeat(triangles, 3, axis=1).reshape(-1), np.tile(triangles, (1, 3)).reshape(-1)
    return csr_array(coo_array((local.reshape(-1), (rows, columns)), shape=(n, n)))


def smoothed(density: Array, mass: Array, stiffness: csr_array, length: float) -> Array:
    """The smoothed density [n, k] that solves (M + l^2 K) g = M density, all columns with one factorization.

    Args:
        density: [n, k], a value per area in any unit; mass: [n] as `mass` makes it, 0 where a vertex is left out.
        stiffness: [n, n] as `stiffness` makes it; length: l, in the unit of the mesh; 0 changes nothing.

    Vertices without mass are left out: their rows are 0, and they influence no other.
    """
    kept = np.flatnonzero(mass > 0.0)
    found = np.zeros_like(density, np.float64)
    if length == 0.0 or not len(kept):
        found[kept] = density[kept]
        return found
    part = csr_array(stiffness)[kept][:, kept]
    unit = float(mass[kept].mean())  # so that numbers are near 1 whatever the unit of the mesh
    weights = mass[kept] / unit
    operator = csc_array(diags_array(weights) + (length**2 / unit) * part)
    factors = splu(operator, permc_spec="COLAMD", diag_pivot_thresh=0.0)  # MMD_AT_PLUS_A: 30 times as long
    found[kept] = factors.solve(weights[:, None] * density[kept])
    return found
