"""The designs: the car, the plane, the face, and three more, whose meshes are made here."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
import torch
from torch import Tensor

from benchmarks.choosing import body
from benchmarks.elsewhere import objectives
from rbfevo.arrays import Array
from rbfevo.fit.objective import residuals
from rbfevo.scenarios import face as face_scenario
from rbfevo.scenarios import plane as plane_scenario
from rbfevo.scenarios.scenario import Scenario

FEW, MANY = 4, 12  # centers


@dataclasses.dataclass(frozen=True)
class Case:
    """A design and its objective.

    Attributes:
        name: of the case; vertices: [n, d]; faces: [f, 3].
        objective: displacements [n, k] -> J, a scalar tensor, minimized.
        radii: support radii, model units.
        overrides: of a run on it; those of a mesh lack the template.
        held: [n] bool, vertices that cannot move, or None.
        target: whether J is the squared distance to a target, so that a setup has a least-squares solution.
        components: k.
        reaches: largest displacement of all iterations together, model units, one for each series of descents.
    """

    name: str
    vertices: Array
    faces: Array
    objective: Callable[[Tensor], Tensor]
    radii: tuple[float, float]
    overrides: tuple[str, ...]
    reaches: dict[str, float]
    held: Array | None = None
    target: bool = False
    components: int = 3

    def sensitivity(self, displacement: Array) -> tuple[float, Array]:
        """J and dJ/dx [n, k] of the displaced design [n, k]."""
        u = torch.from_numpy(displacement).requires_grad_()
        J = self.objective(u)
        (gradient,) = torch.autograd.grad(J, u)
        return J.item(), gradient.numpy()

    @property
    def in_space(self) -> Array:
        """The vertices [n, 3]; those of a plane at z = 0."""
        return np.pad(self.vertices, ((0, 0), (0, 3 - self.vertices.shape[1])))

    @property
    def cell(self) -> float:
        """The median edge."""
        corners = self.in_space[self.faces]
        return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))

    def save(self, path: Path) -> None:
        """Write the template of a run, with its sensitivity and the vertices that are held."""
        surface: Any = pv.PolyData.from_regular_faces(self.in_space, self.faces)
        surface["dJ"] = self.sensitivity(np.zeros((len(self.vertices), self.components)))[1]
        if self.held is not None:
            surface["held"] = self.held.astype(np.float64)
        path.parent.mkdir(parents=True, exist_ok=True)
        surface.save(path)


def _of_surface(
    name: str, surface: Any, J: Callable[[Tensor, Tensor], Tensor], radius: float, *overrides: str, held: Any = None
) -> Case:
    """A case on a surface, with two radii, the second twice the first, and a reach of a quarter of the first."""
    vertices, faces = np.asarray(surface.points, np.float64), np.asarray(surface.regular_faces, np.int64)
    X, triangles = torch.from_numpy(vertices), torch.from_numpy(faces)
    return Case(
        name,
        vertices,
        faces,
        lambda u: J(X + u, triangles),
        (radius, 2.0 * radius),
        ("scenario=mesh", "scenario.sensitivity=dJ", *overrides),
        {"r/4": radius / 4.0},
        held,
    )


def car(spacing: float = 0.08) -> Case:
    """The body of docs/car with its impact drag, held wheel arches, symmetric."""
    made = body()
    surface = made.body(spacing)
    p = np.asarray(surface.points)
    near = [np.hypot(p[:, 0] - x, p[:, 2] - z) < 1.15 * made.RADIUS for x, z in made.WHEELS]
    wheels = np.any(near, axis=0) & (np.abs(p[:, 1]) > 0.5)
    return _of_surface("car", surface, made.drag, 0.4, "scenario.symmetry=y", "scenario.hold=held", held=wheels)


def winged(cells: tuple[int, int, int] = (44, 20, 8)) -> Case:
    """A flat body with wings, all edges sharp: drag over lift in impact flow; symmetric. Its sensitivity is rough."""
    grid: Any = pv.ImageData(dimensions=[count + 1 for count in cells])
    surface: Any = grid.extract_surface(algorithm=None).triangulate()
    i = np.asarray(surface.points, np.float64) / cells  # [0, 1]^3
    x, across, up = 3.0 * i[:, 0], 2.0 * i[:, 1] - 1.0, 2.0 * i[:, 2] - 1.0
    half_width = np.where((x > 1.3) & (x < 2.6), 1.0, 0.2 + 0.25 * np.clip(x, 0.0, 1.0))
    y = half_width * across
    thick = np.where(np.abs(y) < 0.46, 0.06 + 0.2 * np.clip(x, 0.0, 1.0), 0.07)
    surface.points = np.column_stack([x, y, thick * up])
    return _of_surface("winged", surface, objectives.drag_over_lift, 0.35, "scenario.symmetry=y")


def lumpy(subdivisions: int = 4) -> Case:
    """A smooth body with dents and lumps: wetted area at equal volume. Its sensitivity is smooth (mean curvature)."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    p = np.array(ball.vertices, np.float64)
    lumps = ((1.0, 0.2, 0.3, 0.35), (-0.7, 0.6, 0.4, -0.3), (-0.3, -0.9, 0.2, 0.3), (0.3, 0.4, -0.9, -0.25),
             (-0.8, -0.1, -0.6, 0.3), (0.5, -0.7, 0.5, -0.25))  # fmt: skip
    radius = np.ones(len(p))
    for *direction, height in lumps:
        radius += height * np.exp((p @ np.array(direction) / np.linalg.norm(direction) - 1.0) / 0.12)
    surface: Any = pv.PolyData.from_regular_faces(p * radius[:, None] * (1.4, 1.0, 0.8), np.array(ball.faces))
    return _of_surface("lumpy", surface, objectives.excess_area, 0.5)


def reflector(rings: int = 27) -> Case:
    """A parabolic dish with dents, open at its rim: focusing error. Its sensitivity is smooth but for the rim."""
    from scipy.spatial import Delaunay

    polar = [(0.0, 0.0), *((k / rings, j / (6 * k)) for k in range(1, rings + 1) for j in range(6 * k))]
    radius, turn = np.array(polar).T
    x, y = radius * np.cos(2.0 * np.pi * turn), radius * np.sin(2.0 * np.pi * turn)
    z = radius**2 / (4.0 * objectives.FOCUS)
    for at, height in (((0.45, 0.1), 0.08), ((-0.4, 0.35), -0.07), ((-0.2, -0.5), 0.06), ((0.5, -0.55), -0.05)):
        z += height * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * 0.22**2))
    faces = Delaunay(np.column_stack([x, y])).simplices.astype(np.int64)
    surface = pv.PolyData.from_regular_faces(np.column_stack([x, y, z]), faces)
    made = _of_surface("reflector", surface, objectives.focusing_error, 0.3)
    return dataclasses.replace(made, reaches={**made.reaches, "r/16": made.radii[0] / 16.0})


def _of_scenario(made: Scenario, radii: tuple[float, float], *overrides: str) -> Case:
    """The plane or the face: near, a quarter of the smaller radius; far, as far as the target is anywhere."""
    wanted = made.gradient.norm(dim=1).max().item() * made.gradient_norm
    return Case(
        made.name,
        made.vertices.numpy(),
        made.faces.numpy(),
        lambda u: residuals_anew(made, u).square().sum(),
        radii,
        (f"scenario={made.name}", *overrides),
        {"r/4": radii[0] / 4.0, "far": wanted},
        target=True,
        components=made.gradient.shape[1],
    )


def residuals_anew(made: Scenario, u: Tensor) -> Tensor:
    """The residuals [n, k] of displacements u with closest points of their own.

    The derivative of a squared distance is that with the closest point kept, which is a constant for autograd here.
    """
    at = residuals(made, u.detach())
    return at + (u - u.detach())


def plane(resolution: int = 50) -> Case:
    """The paper's height field, squared distance."""
    made = plane_scenario(resolution=(resolution, resolution))
    return _of_scenario(made, (0.25, 0.5), f"scenario.resolution=[{resolution},{resolution}]")


def face(subdivisions: int = 4) -> Case:
    """The paper's sphere that should become a face: squared distance to the closest points, looked up anew."""
    return _of_scenario(face_scenario(subdivisions=subdivisions), (0.5, 1.0), f"scenario.subdivisions={subdivisions}")


CASES: dict[str, Callable[[], Case]] = {
    "car": car, "plane": plane, "face": face, "winged": winged, "lumpy": lumpy, "reflector": reflector,
}  # fmt: skip
