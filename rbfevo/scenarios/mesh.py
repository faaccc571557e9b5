"""The engineer's own mesh, and where it should move: a target shape, or the sensitivities of one or more objectives."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.geometry.correspondence import Points
from rbfevo.geometry.lengths import length
from rbfevo.geometry.pairing import REJECTIONS
from rbfevo.scenarios import boundaries, fixing, limits, packaging, sensitivities
from rbfevo.scenarios import symmetry as symmetry_plane
from rbfevo.scenarios.asked import Asked
from rbfevo.scenarios.design import Design
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scenarios.targets import paired
from rbfevo.scenarios.templates import Template, read_template
from rbfevo.scenarios.wanted import Readiness, Wish, stacked, titled

WEIGHTS = ("uniform", "area")


def mesh(
    template: str | None = None,
    patches: Any = None,
    target: str | None = None,
    sensitivity: Any = None,
    sensitivity_kind: Any = None,
    sensitivity_normal: Any = None,
    sensitivity_match: Any = "exact",
    objective: Any = "minimize",
    objective_weights: Any = None,
    objective_names: Any = None,
    combine: str = "mean",
    target_scale: float | None = None,
    reject: str = "boundary",
    margin: float = 0.05,
    fixed: Any = None,
    hold: Any = None,
    hold_width: Any = "5%",
    keep_out: bool | None = None,
    inside: Any = None,
    outside: Any = None,
    max_displacement: Any = None,
    weights: str = "uniform",
    smooth: Any = None,
    symmetry: str | None = None,
    symmetry_at: float | None = None,
    planar: str | None = None,
    support: Any = "15%",
    search_vertices: int | None = None,
    up: str = "z",
) -> Scenario:
    """Build the design of a mesh of any position and size, with exactly one of a target and a sensitivity.

    Args:
        template: a surface mesh as `read_template` takes it.
        patches: names of the template's patches (markers, physical groups, element sets) to take; None for all.
        target: a mesh or cloud as `read_surface` takes it: vertices should move to their closest points on it.
        sensitivity: the name of a point or cell array of the template, or a CSV, NPY, NPZ or VTK file: one value a
            vertex, taken along its normal, or three. None: of a solver's case, its own. Or a list of them, of several
            objectives or of the load cases of one; the next four are then one value for all, or a list with one each.
        sensitivity_kind: `nodal` (integrated over a vertex's share of the surface) or `density` (per area); None is
            nodal, but doubts are refused.
        sensitivity_normal: `outward`, `inward` or `as_wound` (by the file): the normal that one value per vertex refers
            to; None is outward, but doubts are refused.
        sensitivity_match: `exact`: a table's rows are those of the template's points, in any order; `nearest` or
            `interpolate`: of another mesh of the same surface, values per area then.
        objective: `minimize`: the design wants to move against the sensitivity; `maximize`: along it.
        objective_weights: of several objectives, positive: of the mean of their potentials; None: equal ones.
        objective_names: of several objectives; None: those of their arrays or files.
        combine: of several objectives what is searched: the weighted `mean` of their potentials, or the `worst`.
        target_scale: factor by which the target is multiplied; None is 1, but mixed units are refused.
        reject: as for `face`.
        margin: by which the box is larger than the template's on each side, as a fraction of the diagonal.
        fixed: vertices that should not move, as `fixing.marked` takes it: their rows of g are 0.
        hold: vertices that cannot move, as `fixing.marked` takes it: U is multiplied by a blend, 0 there, and their
            rows of g are 0.
        hold_width: where the blend reaches 1: model units, or a percentage of the box's diagonal.
        keep_out: whether centers may not sit among the fixed and held vertices; None: only with `hold`.
        inside, outside: boxes and closed surfaces in which centers sit, or do not, as `packaging.packaging` takes them.
        max_displacement: how far vertices may move at most, as `limits.limits` takes it, or None.
        weights: `uniform`, each vertex counts the same (the paper), or `area`.
        smooth: length over which g is smoothed, model units or a percentage of the box's diagonal; None leaves it.
        symmetry: x, y or z: setups stay symmetric about the plane across that axis, at `symmetry_at` or, where that is
            None, in the middle of the template.
        planar: x, y or z: a design of two dimensions, the axis across its plane: a slab one cell thick, whose front and
            back move alike, or a curve.
        support: default support radius of compact kernels: model units, or a percentage of the box's diagonal.
        search_vertices: weighted vertices that searches look at; None for all.
        up: the axis that is up in pictures, x, y or z.

    Raises:
        UserError: on a setting out of range, an unusable file, or if no vertex is left that should move.
    """
    _check(template, reject, margin, weights, search_vertices, up)
    how = sensitivity_kind, sensitivity_normal, sensitivity_match, objective
    asked = Asked.of(sensitivity, *how, objective_weights, objective_names, combine)
    read = read_template(str(template), _names(patches), planar is not None)
    parts = f"{len(read.segments)} segments" if read.curve else f"{len(read.triangles)} triangles"
    notes = {"template": f"{template}: {len(read.vertices)} vertices, {parts}"} | read.notes
    boundaries.refuse_whole_boundary(read, patches)
    symmetry, symmetry_at, planar, more = boundaries.boundaries(read, symmetry, symmetry_at, planar)
    notes |= more
    if target is None and sensitivity is None:
        sensitivity = boundaries.sensitivity_of(read)
        asked = dataclasses.replace(asked, sources=() if sensitivity is None else (sensitivity,))
    if (target is None) == (sensitivity is None):
        raise UserError(_which(read, target is not None))
    flat = Planar.of(planar, read.vertices, read.curve)
    design, oddities = Design.of(read, weights, flat)
    notes |= oddities
    if flat is not None:
        notes["planar"] = flat.note
    elif topology.flat(read.vertices):
        notes["flat"] = (
            "all vertices lie in one plane: sensitivities along the normal and targets outside the plane move them out "
            "of it; vectors within the plane keep it flat"
        )
    lower, upper = _box(read.vertices, margin)
    if flat is not None and symmetry == planar:
        raise UserError(f"scenario.symmetry={symmetry} and scenario.planar={planar}: choose two different axes")
    rim = design.rim(flat)
    mirror, more = symmetry_plane.mirror_of(symmetry, symmetry_at, read.vertices, design.surface, rim, lower, upper)
    if mirror is None:
        more = symmetry_plane.proposal(read.vertices, rim, None if flat is None else flat.plane.axis)
    notes |= more
    sides, pairing, warnings = None, None, []
    names, stays = asked.titles(read), np.zeros(len(read.vertices), bool)
    if target is not None:
        asked.choices[0].refuse_with_target()
        pairing, more, warnings = paired(read.vertices, design.normals, target, target_scale, reject, flat)
        wishes, stays = [Wish(target, pairing.displacement)], pairing.rejected
        notes |= more
    else:
        sides, wishes = design.sides(read, flat), []
        for source, choices, name in zip(asked.fields(read), asked.choices, names, strict=True):
            found = sensitivities.descent(source, choices, read, str(template), sides, design.areas, design.mass)
            wishes.append(Wish(source, found.wanted, found.exponent, choices.objective))
            notes |= titled(found.notes, name, source)
            warnings += [warning for warning in found.warnings if warning not in warnings]
    still = fixing.fixing(fixed, hold, hold_width, keep_out, read, (lower, upper), mirror, flat)
    stays, notes = stays | still.stays, notes | still.notes
    of_design = (lower, upper), mirror, None if flat is None else flat.plane
    packed, more = packaging.packaging(inside, outside, *of_design, still.region)
    region, notes = packed or still.region, notes | more
    stays = stays if flat is None else flat.either(stays)
    diagonal, most = float((upper - lower).norm()), None
    if max_displacement is not None:
        held = np.zeros(len(read.vertices), bool) if still.blend is None else still.blend == 0.0
        most, notes["max displacement"] = limits.limits(max_displacement, read, diagonal, held)
    over = None if smooth is None else length("scenario.smooth", smooth, diagonal)
    ready = Readiness(design, flat, stays, over, sides)
    wanted = [ready.of(wish) for wish in wishes]
    for one, name in zip(wanted, names, strict=True):
        notes |= titled(one.notes, name)
    objectives = asked.objectives(read, [one.norm for one in wanted])
    if objectives is not None:
        notes["objectives"] = objectives.note
    if mirror is not None:
        surface, fields = (read.vertices, design.surface), [one.gradient.numpy() for one in wanted]
        named = dict(zip(names, fields, strict=True))
        more, doubts = symmetry_plane.notes_and_warnings(mirror, *surface, named, design.mass)
        notes, warnings = notes | more, warnings + doubts
    whole = wanted[0] if objectives is None else stacked(objectives, wanted)
    vertices, faces, mass = (torch.from_numpy(part) for part in (read.vertices, design.triangles, design.mass))
    return Scenario(
        name="mesh",
        vertices=vertices,
        faces=faces,
        gradient=whole.gradient,
        weights=mass,
        lower=lower,
        upper=upper,
        support=_support(support, lower, upper, flat),
        sample=design.sampler(still.region) if packed is None else packed.sampler(design.sampler),
        gradient_norm=whole.norm,
        notes=notes,
        warnings=warnings,
        closest=None if pairing is None else lambda points: pairing.query(points)[0],
        stays=torch.from_numpy(stays),
        direction_only=pairing is None,
        mirror=mirror,
        keep_out=region,
        search_vertices=search_vertices,
        up=up,
        rows=torch.from_numpy(read.rows),
        hold=still.hold,
        blend=None if still.blend is None else torch.from_numpy(still.blend),
        objective=wishes[0].direction if objectives is None else None,
        smooth=over,
        gradient_raw=whole.raw,
        planar=None if flat is None else flat.plane,
        max_displacement=None if most is None else torch.from_numpy(most),
        objectives=objectives,
    )


def _names(patches: Any) -> tuple[str, ...] | None:
    """The names that `scenario.patches` gives, one or a list."""
    if patches is None:
        return None
    listed = [patches] if isinstance(patches, str | int) else list(patches)
    if not listed:
        raise UserError("scenario.patches=[]: name at least one patch")
    return tuple(str(name) for name in listed)


def _check(template: object, reject: str, margin: float, weights: str, search_vertices: int | None, up: str) -> None:
    if not isinstance(template, str) or not template:
        raise UserError("scenario=mesh needs scenario.template=FILE, the surface mesh to deform")
    if reject not in REJECTIONS:
        raise UserError(f"scenario.reject={reject}: choose one of {', '.join(REJECTIONS)}")
    if weights not in WEIGHTS:
        raise UserError(f"scenario.weights={weights}: choose one of {', '.join(WEIGHTS)}")
    if up not in ("x", "y", "z"):
        raise UserError(f"scenario.up={up}: choose x, y or z, the axis that points up in pictures")
    if not 0.0 <= margin < 100.0:
        raise UserError(f"scenario.margin={margin}: give a fraction of the diagonal, 0 or larger")
    if search_vertices is not None and search_vertices < 100:
        raise UserError(f"scenario.search_vertices={search_vertices}: give at least 100, or null for all")


def _which(template: Template, both: bool) -> str:
    if both:
        return "scenario.target and scenario.sensitivity are both set: give only one of them"
    arrays = ", ".join(sorted(template.arrays)) or "none"
    return (
        "scenario=mesh needs either scenario.target=FILE or scenario.sensitivity=NAME_OR_FILE "
        f"(point arrays in the template: {arrays})"
    )


def _box(vertices: Points, margin: float) -> tuple[Tensor, Tensor]:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    around = margin * float(np.linalg.norm(high - low))
    if around == 0.0 and (high == low).any():
        raise UserError("scenario.margin=0: the template is flat, so its box has no volume; choose a margin above 0")
    return torch.from_numpy(low - around), torch.from_numpy(high + around)


def _support(value: Any, lower: Tensor, upper: Tensor, flat: Planar | None) -> float:
    """The default support radius, model units: a percentage is of the diagonal of the box, or of its planar cut."""
    if flat is None:
        return length("scenario.support", value, float((upper - lower).norm()))
    return flat.support(value, float((upper - lower)[flat.plane.others].norm()))
