"""What the boundary conditions of a solver's case say about a design: its plane of symmetry, two dimensions, and which
of the case's sensitivities to take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Points
from rbfevo.errors import UserError
from rbfevo.scenarios.templates import Template

FLAT = 1e-5  # of the patch's extent: a coordinate that varies by less is that of a plane
PLANES, TWO_DIMENSIONS, TURNED = ("symmetryPlane", "symmetry"), "empty", "wedge"


class Boundaries(NamedTuple):
    """`scenario.symmetry`, `symmetry_at` and `planar` as set, or else as the case has them, and notes."""

    symmetry: str | None
    symmetry_at: float | None
    planar: str | None
    notes: dict[str, str]


def boundaries(template: Template, symmetry: str | None, symmetry_at: float | None, planar: str | None) -> Boundaries:
    """What is set, filled up by the types of the case's patches.

    A patch counts as a plane of symmetry where it meets the template.

    Raises:
        UserError: for a wedge, and for planes of symmetry that cannot be kept: inclined ones, or several.
    """
    notes: dict[str, str] = {}
    touching = {name for name, kind in template.patch_types.items() if kind in (*PLANES, TURNED)}
    touching = {name for name in touching if _meets(template, name)}
    turned = sorted(name for name in touching if template.patch_types[name] == TURNED)
    if turned:
        raise UserError(f"the patch {turned[0]} is a wedge: designs of axisymmetric cases are not supported")
    if planar is None:
        empty = [name for name, kind in template.patch_types.items() if kind == TWO_DIMENSIONS]
        points = [own for own in (_points(template, name) for name in empty) if len(own)]
        planar = None if not points else _thin_axis(np.concatenate(points), empty)
        if planar is not None:
            notes["two dimensions"] = f"two dimensions, since {', '.join(empty)} is empty: scenario.planar={planar}"
    if symmetry is not None or not touching:
        return Boundaries(symmetry, symmetry_at, planar, notes)
    found = {}
    for name in sorted(touching):
        plane = _plane(_points(template, name))
        if plane is None:
            raise UserError(
                f"the patch {name} is a plane of symmetry that is not across x, y or z, and designs cannot be kept "
                "symmetric about it; turn the case"
            )
        found[plane[0]] = (plane[1], name)
    if len(found) > 1:
        listed = ", ".join(f"{name} ({axis} = {at:g})" for axis, (at, name) in found.items())
        raise UserError(
            f"the template meets several planes of symmetry: {listed}; set scenario.symmetry to the one to keep, and "
            "hold the vertices of the other by scenario.hold"
        )
    axis, (at, name) = next(iter(found.items()))
    notes["symmetry of the case"] = (
        f"{name} is a plane of symmetry: scenario.symmetry={axis} scenario.symmetry_at={at:g}"
    )
    return Boundaries(axis, at if symmetry_at is None else symmetry_at, planar, notes)


def sensitivity_of(template: Template) -> str | None:
    """The sensitivity of a case to take where none is named: vectors of points first, then of faces, then scalars.

    Raises:
        UserError: if several are as good, with their names.
    """
    if not template.meanings:
        return None
    best = min(meaning.rank for meaning in template.meanings.values())
    names = sorted(name for name, meaning in template.meanings.items() if meaning.rank == best)
    if len(names) > 1:
        raise UserError(
            f"the case has the sensitivities {', '.join(names)}: set scenario.sensitivity to one of them, or to a list "
            "of several objectives, such as [A,B]"
        )
    return names[0]


def field_of(template: Template, source: str) -> str:
    """The sensitivity that a name means: where it is that of a case's adjoint solver, the best array of that solver.

    Raises:
        UserError: if the solver has several that are as good, with their names.
    """
    own = {name: meaning.rank for name, meaning in template.meanings.items() if meaning.solver == source}
    if not own or source in template.arrays or source in template.cell_arrays:
        return source
    names = sorted(name for name, rank in own.items() if rank == min(own.values()))
    if len(names) > 1:
        raise UserError(f"scenario.sensitivity={source}: this adjoint solver has {', '.join(names)}; name one of them")
    return names[0]


def refuse_whole_boundary(template: Template, patches: object) -> None:
    """Raise UserError where a case is to be designed as a whole, with inlet and outlet."""
    if template.patch_types and patches is None:
        listed = ", ".join(f"{name} ({kind})" for name, kind in template.patch_types.items())
        raise UserError(f"scenario.patches: name the patches of the case to design, such as [NAME]; there are {listed}")


def _points(template: Template, name: str) -> Points:
    return template.patch_points("scenario.patches", [name])


def _meets(template: Template, name: str) -> bool:
    """Whether a patch has a point in common with the template."""
    own = {tuple(point) for point in _points(template, name).tolist()}
    return any(tuple(point) in own for point in template.vertices.tolist())


def _plane(points: Points) -> tuple[str, float] | None:
    """The axis across which points lie in a plane, and where; None where they do not."""
    spread = np.ptp(points, axis=0)
    axis = int(np.argmin(spread))
    if spread[axis] > FLAT * float(spread.max()):
        return None
    return "xyz"[axis], float(np.median(points[:, axis]))


def _thin_axis(points: Points, names: list[str]) -> str:
    """The axis across which points lie in two layers."""
    for axis in range(3):
        low, high = points[:, axis].min(), points[:, axis].max()
        away = np.minimum(points[:, axis] - low, high - points[:, axis])
        if away.max() <= FLAT * float(np.ptp(points, axis=0).max()):
            return "xyz"[axis]
    raise UserError(f"the empty patches {', '.join(names)} are not in two planes across x, y or z; turn the case")
