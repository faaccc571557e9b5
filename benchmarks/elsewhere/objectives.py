"""Objectives of a surface with exact derivatives (automatic differentiation): none needs a solver.

All take vertices [n, 3] and triangles [f, 3], outward normals, and return a scalar tensor to be minimized.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

ATTACK = math.radians(20.0)  # angle of attack of the winged body
FRICTION = 0.005  # drag per wetted area, beside an impact pressure of up to 2
FOCUS = 1.5  # height of the focal point of the reflector, whose vertex is at 0


def area_vectors(vertices: Tensor, triangles: Tensor) -> Tensor:
    """Normals [f, 3] of the triangles, as long as their areas."""
    a, b, c = vertices[triangles].unbind(1)
    return torch.linalg.cross(b - a, c - a) / 2.0


def excess_area(vertices: Tensor, triangles: Tensor) -> Tensor:
    """Wetted area over that of a sphere of the same volume, minus 1: wetted area at equal volume."""
    vectors = area_vectors(vertices, triangles)
    volume = (vertices[triangles].mean(1) * vectors).sum() / 3.0
    return vectors.norm(dim=1).sum() / (36.0 * math.pi * volume**2) ** (1.0 / 3.0) - 1.0


def drag_over_lift(vertices: Tensor, triangles: Tensor) -> Tensor:
    """Drag over lift by Newton's impact pressure 2 cos^2 and a constant friction, at an angle of attack."""
    vectors = area_vectors(vertices, triangles)
    areas = vectors.norm(dim=1)
    air = vectors.new_tensor([math.cos(ATTACK), 0.0, math.sin(ATTACK)])
    up = vectors.new_tensor([-math.sin(ATTACK), 0.0, math.cos(ATTACK)])
    pressure = 2.0 * (-(vectors @ air) / areas).clamp_min(0.0) ** 2
    force = -(pressure[:, None] * vectors).sum(0)
    return (force @ air + FRICTION * areas.sum()) / (force @ up)


def focusing_error(vertices: Tensor, triangles: Tensor) -> Tensor:
    """Mean squared distance from the focal point at which rays along -z cross the focal plane after reflection."""
    vectors = area_vectors(vertices, triangles)
    areas = vectors.norm(dim=1)
    normals = vectors / areas[:, None]
    ray = vectors.new_tensor([0.0, 0.0, -1.0])
    reflected = ray - 2.0 * (normals @ ray)[:, None] * normals
    middle = vertices[triangles].mean(1)
    hits = middle + ((FOCUS - middle[:, 2]) / reflected[:, 2])[:, None] * reflected
    light = areas * normals[:, 2]  # what falls on a triangle
    return (light * hits[:, :2].square().sum(1)).sum() / light.sum()
