"""A car-like body with objectives of its own: `python docs/car/body.py car.vtp` makes it, with `--drag` measures it.

The body is the zero level of a smooth union of rounded boxes with wheel arches cut out (metres, nose towards -x, up z).
Its drag is that of Newton's impact theory, which knows nothing but the surface: a face of area A whose outward normal n
meets the oncoming air with cos t = max(0, -n_x) feels the pressure 2 cos^2 t, so J = sum of 2 A cos^3 t. That stands in
for a flow solver, and its exact derivative in every vertex, by automatic differentiation, for the adjoint solver's.
The vertical part of the same pressure is the lift, which is negative where the air presses the body down.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
import torch
from numpy.typing import NDArray

LENGTH, WIDTH, HEIGHT = 4.2, 1.8, 1.4
WHEELS = ((-1.25, 0.33), (1.3, 0.33))  # x and z of the axles
RADIUS = 0.42  # of the wheel arches


def body(spacing: float = 0.04) -> pv.PolyData:
    """The closed surface, symmetric about y = 0, with grid cells of `spacing` (metres)."""
    x, z = np.arange(-2.513, 2.5, spacing), np.arange(-0.217, 1.7, spacing)  # no grid plane on a side of the body
    grid = pv.RectilinearGrid(x, np.arange(0.0, 1.2, spacing), z)
    grid["level"] = level(np.asarray(grid.points))
    contour: Any = grid.contour([0.0], scalars="level")
    half: Any = contour.clean(tolerance=0.05 * spacing, absolute=True)
    points, triangles = np.asarray(half.points, np.float64), np.asarray(half.regular_faces)
    points[np.abs(points[:, 1]) < 0.05 * spacing, 1] = 0.0
    both = np.concatenate([points, points * (1.0, -1.0, 1.0)])
    joined = np.concatenate([triangles[:, ::-1], triangles + len(points)])  # normals outwards
    whole: Any = pv.PolyData.from_regular_faces(both, joined).clean(tolerance=1e-9, absolute=True)
    whole.clear_data()
    return whole.smooth_taubin(n_iter=40, pass_band=0.05)


def level(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A function of points [q, 3] that is negative inside the body and about a distance near it."""
    p = points.copy()
    p[:, 1] = np.abs(p[:, 1])
    nose = np.clip((-p[:, 0] - 0.9) / 1.2, 0.0, 1.0)  # the hood falls towards the nose
    lower = rounded_box(p, (0.0, 0.0, 0.50), (1.95, 0.78, 0.30), 0.22)
    lower = np.maximum(lower, p[:, 2] - 0.86 + 0.28 * nose**2)
    cabin = p.copy()
    rise = np.clip((p[:, 2] - 0.7) / 0.7, 0.0, 1.2)
    cabin[:, 0] = (p[:, 0] - 0.35) / (1.0 - 0.42 * rise)
    cabin[:, 1] = p[:, 1] / (1.0 - 0.22 * rise)
    upper = rounded_box(cabin, (0.0, 0.0, 0.95), (1.25, 0.66, 0.38), 0.25)
    whole = smooth_union(lower, upper, 0.30)
    for along, high in WHEELS:
        arch = np.hypot(p[:, 0] - along, p[:, 2] - high) - RADIUS
        arch = np.maximum(arch, 0.55 - p[:, 1])
        whole = -smooth_union(-whole, arch, 0.06)
    return whole


def rounded_box(p: NDArray[np.float64], middle: tuple, half: tuple, radius: float) -> NDArray[np.float64]:
    """Signed distance to a box with rounded edges."""
    q = np.abs(p - np.array(middle)) - (np.array(half) - radius)
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0) - radius


def smooth_union(a: NDArray[np.float64], b: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """The smaller of two levels, blended where they are within `width` of each other."""
    mix = np.clip(0.5 + 0.5 * (b - a) / width, 0.0, 1.0)
    return b + mix * (a - b) - width * mix * (1.0 - mix)


def drag(vertices: torch.Tensor, triangles: torch.Tensor) -> torch.Tensor:
    """J of vertices [n, 3] and triangles [f, 3], in square metres, air along +x."""
    a, b, c = vertices[triangles].unbind(1)
    twice = torch.linalg.cross(b - a, c - a)
    area = twice.norm(dim=1) / 2.0
    cosine = (-twice[:, 0] / (2.0 * area)).clamp_min(0.0)
    return (2.0 * area * cosine**3).sum()


def lift(vertices: torch.Tensor, triangles: torch.Tensor) -> torch.Tensor:
    """The vertical force that goes with `drag`, upwards, in square metres: the sum of -2 A cos^2 t n_z."""
    a, b, c = vertices[triangles].unbind(1)
    twice = torch.linalg.cross(b - a, c - a)
    area = twice.norm(dim=1) / 2.0
    cosine = (-twice[:, 0] / (2.0 * area)).clamp_min(0.0)
    return -(cosine**2 * twice[:, 2]).sum()


def of_surface(surface: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and triangles of a surface."""
    return (
        torch.from_numpy(np.asarray(surface.points, np.float64)),
        torch.from_numpy(np.asarray(surface.regular_faces, np.int64)),
    )


def main() -> None:
    """Make the body, or measure the drag of one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--drag", action="store_true", help="measure drag and lift of FILE instead of making it")
    parser.add_argument("--spacing", type=float, default=0.04, help="of the grid, metres (0.04)")
    options = parser.parse_args()
    if options.drag:
        measured = of_surface(pv.read(options.file))
        print(f"{options.file}: J = {drag(*measured).item():.5f} m^2, lift {lift(*measured).item():.5f} m^2")
        return
    surface = body(options.spacing)
    vertices, triangles = of_surface(surface)
    vertices.requires_grad_()
    value, upwards = drag(vertices, triangles), lift(vertices, triangles)
    surface.clear_data()
    surface["drag_sensitivity"] = torch.autograd.grad(value, vertices)[0].numpy()
    surface["lift_sensitivity"] = torch.autograd.grad(upwards, vertices)[0].numpy()
    near = [np.hypot(surface.points[:, 0] - x, surface.points[:, 2] - z) < 1.15 * RADIUS for x, z in WHEELS]
    surface["wheels"] = (np.any(near, axis=0) & (np.abs(surface.points[:, 1]) > 0.5)).astype(np.float64)
    options.file.parent.mkdir(parents=True, exist_ok=True)
    surface.save(options.file)
    print(f"{options.file}: {surface.n_points} vertices, {surface.n_cells} triangles, J = {value.item():.5f} m^2, "
          f"lift {upwards.item():.5f} m^2")  # fmt: skip


if __name__ == "__main__":
    main()
