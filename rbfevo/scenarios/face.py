"""The sphere and the face: the paper's template fitting scenario (section 5.2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry import placement
from rbfevo.geometry.pairing import REJECTIONS, pair
from rbfevo.scenarios.reading import read_surface
from rbfevo.scenarios.scenario import Scenario, unit_gradient


def face(
    subdivisions: int = 5,
    scan: str | Path | None = None,
    up: str | None = None,
    front: str | None = None,
    reject: str = "boundary",
    support: float = 1.0,
) -> Scenario:
    """Build the unit sphere that is to become a face: the built-in one, or the user's own `scan`.

    The design is an icosphere of 10 * 4^subdivisions + 2 vertices. The scan is turned so that its axis `up` is +y and
    its axis `front` is +z, and fitted into the box [-1,1]^3 (`placement.fit_box`). Defaults are up y and front z for
    a scan; the built-in one brings its own. Row i of the gradient [n, 3] is the displacement of vertex i to the
    closest point on the scan's surface, or to the closest point of a cloud, zero where the pair is rejected.

    Args:
        subdivisions: of the icosphere, 1 to 8; 5 gives 10,242 vertices.
        scan: a file as `read_surface` takes it; none is the front half of the scalp surface of an average MRI head.
        up, front: axes of the scan, such as "y", "-z".
        reject: "boundary" rejects pairs that end on the scan's open boundary, or reach beyond a cloud's rim; "none".
        support: default support radius of compact kernels, in radii of the sphere.

    Raises:
        UserError: on a setting out of range, an unusable scan, or if every pair is rejected.
    """
    if isinstance(subdivisions, bool) or not isinstance(subdivisions, int) or not 1 <= subdivisions <= 8:
        raise UserError(f"scenario.subdivisions={subdivisions}: give a whole number from 1 to 8")
    if reject not in REJECTIONS:  # before anything is read
        raise UserError(f"scenario.reject={reject}: choose one of {', '.join(REJECTIONS)}")

    if scan is None:
        vertices, triangles = average_face()
        up, front = up or "z", front or "y"
        notes = {"scan": "built-in: front half of fsaverage, the scalp surface of an average MRI head (no real person)"}
    else:
        vertices, triangles = read_surface(scan)
        up, front = up or "y", front or "z"
        notes = {"scan": str(scan)}
    vertices, triangles = placement.merge_coincident(placement.turn(vertices, up, front), triangles)
    vertices, triangles, strays = placement.drop_strays(vertices, triangles)
    if triangles is not None and len(triangles) == 0:
        raise UserError(f"{notes['scan']}: merging coincident vertices leaves no triangle; check the file")
    vertices, scale = placement.fit_box(vertices)
    kind = "a cloud" if triangles is None else f"{len(triangles)} triangles"
    notes["scan size"] = f"scan: {len(vertices)} distinct vertices, {kind}; {strays} stray vertices dropped"
    notes["scan frame"] = (
        f"scan turned (up {up} to +y, front {front} to +z), scaled by {scale:.6g}, its front put at z = 1"
    )

    sphere, faces = _icosphere(subdivisions)
    displacement, rejected, facts, query = pair(sphere, sphere, vertices, triangles, reject)
    notes |= facts
    if rejected.all():
        raise UserError(
            f"{notes['scan']}: all pairs of sphere and scan are rejected; check scenario.up and scenario.front, or set "
            "scenario.reject=none"
        )

    weights = torch.ones(len(sphere), dtype=torch.float64)
    gradient, norm = unit_gradient(torch.from_numpy(displacement), weights)
    return Scenario(
        name="face",
        vertices=torch.from_numpy(sphere),
        faces=torch.from_numpy(faces),
        gradient=gradient,
        weights=weights,
        lower=-torch.ones(3, dtype=torch.float64),
        upper=torch.ones(3, dtype=torch.float64),
        support=support,
        sample=_sample_sphere,
        gradient_norm=norm,
        notes=notes,
        closest=lambda points: query(points)[0],
        stays=torch.from_numpy(rejected),
    )


def average_face() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices [n, 3] (metres, face towards +y, up +z) and triangles [f, 3] of the built-in face.

    It is the scalp surface of FreeSurfer's average MRI head, `fsaverage-head.fif` of the `mne` package, cut at the
    plane y = 0 of its own coordinates: the half with y > 0 stays, from crown to chin, open behind.
    """
    import mne
    import pyvista

    path = Path(mne.__file__).parent / "data" / "fsaverage" / "fsaverage-head.fif"
    (head,) = mne.read_bem_surfaces(path, verbose="error")
    surface = pyvista.PolyData.from_regular_faces(
        np.asarray(head["rr"], np.float64), np.asarray(head["tris"], np.int64)
    )
    half = surface.clip("y", origin=(0.0, 0.0, 0.0), invert=False).triangulate()
    return np.asarray(half.points, np.float64), np.asarray(half.regular_faces, np.int64)


def _icosphere(subdivisions: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    return np.array(sphere.vertices, np.float64), np.array(sphere.faces, np.int64)


def _sample_sphere(count: int, m: int, generator: torch.Generator) -> Tensor:
    """Draw [count, m, 3] centers uniformly on the unit sphere."""
    draws = torch.randn(count, m, 3, generator=generator, dtype=torch.float64, device=generator.device)
    return draws / draws.norm(dim=-1, keepdim=True)
