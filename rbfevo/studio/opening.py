"""A mesh file, a run directory or what the studio has kept, as a state to begin with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import setup
from rbfevo.scenarios.templates import Template, read_template
from rbfevo.studio.choices import AXES, KERNELS, LENGTHS, Choices
from rbfevo.studio.keeping import State, kept
from rbfevo.studio.painting import Painting
from rbfevo.studio.shape import refuse_others

FAR = 0.05  # of the diagonal: how far a sensitivity moves the farthest vertex, which has no length of its own


def opened(path: Path, patches: Sequence[str] | None = None) -> tuple[State, Template | None]:
    """The state of a mesh, of a run or of a saved directory; and the template, of a mesh, with its point arrays.

    Raises:
        UserError: if it is none of these, or cannot be painted here.
    """
    if path.is_dir() and not (path / "constant" / "polyMesh").is_dir():  # that would be a case of OpenFOAM
        if patches:
            raise UserError(f"{path}: --patch is for a mesh, and this is a directory of rbfevo; leave it out")
        state = kept(path)
        return (of_run(read(path), str(path)) if state is None else state), None
    template = read_template(path, patches)
    triangles = wound(template)
    nothing = np.zeros_like(template.vertices), np.zeros(len(template.vertices), bool)
    return State(str(path), template.vertices, triangles, *nothing, Choices()), template


def wound(template: Template) -> np.ndarray:
    """Its triangles wound alike, and outwards where it encloses a volume."""
    vertices = template.vertices
    triangles = topology.oriented(vertices, template.triangles)[0]
    return triangles[:, ::-1].copy() if topology.inward(vertices, triangles) else triangles


def of_run(record: Record, source: str) -> State:
    """The state of a run: its wanted displacement, what its search looked at, and its front.

    Raises:
        UserError: if its setups cannot be painted for and pulled here.
    """
    refuse_others(record)
    diagonal = float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    size = record.gradient_norm
    if size is None:
        size = FAR * diagonal / float(np.linalg.norm(record.gradient, axis=1).max())
    held = np.zeros(len(record.vertices), bool) if record.blend is None else record.blend == 0.0
    rows = record.front
    chosen = setup(record, int(rows[0] if len(rows) else 0))
    symmetry = record.summary.get("symmetry")
    name = str(record.summary.get("kernel"))
    if name not in KERNELS:
        raise UserError(f"{source}: its kernel {name} is none of {', '.join(KERNELS)}")
    radius = None if chosen.kernel is None else chosen.kernel.numbers().get(LENGTHS.get(name, ""))
    up = record.summary.get("up")
    choices = Choices(
        kernel=name,
        radius=radius,
        manipulation=chosen.manipulation,
        centers=len(chosen.centers),
        symmetry=symmetry.get("axis") if isinstance(symmetry, dict) else None,
        up=up if up in AXES else "z",
    )
    triangles = np.asarray(record.faces, np.int64)
    return State(source, record.vertices, triangles, record.gradient * size, held, choices, record.centers[rows])


def displacements(values: np.ndarray, painting: Painting) -> np.ndarray:
    """The displacement [n, 3] that a point array means: vectors as they are, one value along the outward normal.

    Raises:
        UserError: if it has values that are not finite, or only zeros.
    """
    n = len(painting.vertices)
    rows = values.reshape(n, -1)
    if not np.isfinite(rows).all() or not rows.any():
        raise UserError("this point array is 0 everywhere or has values that are not finite; choose another one")
    return rows.copy() if rows.shape[1] == 3 else rows * painting.normals


def example() -> tuple[State, Template | None]:
    """A body to try the brush on, where no mesh was named: an ellipsoid of 10,242 vertices, 2 long."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5)
    vertices = np.asarray(ball.vertices, np.float64) * (1.0, 0.5, 0.35)
    nothing = np.zeros_like(vertices), np.zeros(len(vertices), bool)
    return State("example", vertices, np.asarray(ball.faces, np.int64), *nothing, Choices(symmetry="y")), None
