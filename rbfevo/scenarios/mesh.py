"""A user's mesh that should become a target shape, or follow an adjoint solver's sensitivities."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry import placement, topology
from rbfevo.geometry.correspondence import Points, Triangles
from rbfevo.geometry.lengths import length
from rbfevo.geometry.pairing import REJECTIONS, Pairing, pair
from rbfevo.scenarios import fixing, sensitivities, signs, smoothing
from rbfevo.scenarios import symmetry as symmetry_plane
from rbfevo.scenarios.reading import checked_extent, read_surface
from rbfevo.scenarios.sampling import open_faces, surface_sampler
from rbfevo.scenarios.scenario import Scenario, times_power_of_two, unit_gradient
from rbfevo.scenarios.templates import Template, read_template
from rbfevo.scenarios.units import nearest_unit

WEIGHTS = ("uniform", "area")
MIXED_UNITS = 20.0  # ratio of sizes: metres and millimetres, or inches and millimetres


def mesh(
    template: str | None = None,
    patches: Any = None,
    target: str | None = None,
    sensitivity: str | None = None,
    sensitivity_kind: str | None = None,
    sensitivity_normal: str | None = None,
    sensitivity_match: str = "exact",
    objective: str = "minimize",
    target_scale: float | None = None,
    reject: str = "boundary",
    margin: float = 0.05,
    fixed: Any = None,
    hold: Any = None,
    hold_width: Any = "5%",
    keep_out: bool | None = None,
    weights: str = "uniform",
    smooth: Any = None,
    symmetry: str | None = None,
    symmetry_at: float | None = None,
    support: Any = "15%",
    search_vertices: int | None = None,
    up: str = "z",
) -> Scenario:
    """Build the design of a mesh of any position and size, with exactly one of a target and a sensitivity.

    Args:
        template: a surface mesh as `read_template` takes it.
        patches: names of the template's patches (markers, physical groups, element sets) to take; None for all.
        target: a mesh or cloud as `read_surface` takes it: vertices should move to their closest points on it.
        sensitivity: the name of a point or cell array of the template, or a CSV, NPY or NPZ file: one value a vertex,
            taken along its normal, or three.
        sensitivity_kind: `nodal` (integrated over a vertex's share of the surface) or `density` (per area); None is
            nodal, but doubts are refused.
        sensitivity_normal: `outward` or `as_wound` (by the file): the normal that one value per vertex refers to; None
            where both are the same.
        sensitivity_match: `exact`: a table's rows are those of the template's points, in any order; `nearest` or
            `interpolate`: of another mesh of the same surface, values per area then.
        objective: `minimize`: the design wants to move against the sensitivity; `maximize`: along it.
        target_scale: factor by which the target is multiplied; None is 1, but mixed units are refused.
        reject: as for `face`.
        margin: by which the box is larger than the template's on each side, as a fraction of the diagonal.
        fixed: vertices that should not move, as `fixing.marked` takes it: their rows of g are 0.
        hold: vertices that cannot move, as `fixing.marked` takes it: U is multiplied by a blend, 0 there, and their
            rows of g are 0.
        hold_width: where the blend reaches 1: model units, or a percentage of the box's diagonal.
        keep_out: whether centers may not sit among the fixed and held vertices; None: only with `hold`.
        weights: `uniform`, each vertex counts the same (the paper), or `area`.
        smooth: length over which g is smoothed, model units or a percentage of the box's diagonal; None leaves it.
        symmetry: x, y or z: setups stay symmetric about the plane across that axis, at `symmetry_at` or, where that is
            None, in the middle of the template.
        support: default support radius of compact kernels: model units, or a percentage of the box's diagonal.
        search_vertices: weighted vertices that searches look at; None for all.
        up: the axis that is up in pictures, x, y or z.

    Raises:
        UserError: on a setting out of range, an unusable file, or if no vertex is left that should move.
    """
    _check(template, reject, margin, weights, search_vertices, up)
    choices = sensitivities.Choices(sensitivity_kind, sensitivity_normal, sensitivity_match, objective)
    read = read_template(str(template), _names(patches))
    notes = {"template": f"{template}: {len(read.vertices)} vertices, {len(read.triangles)} triangles"} | read.notes
    if (target is None) == (sensitivity is None):
        raise UserError(_which(read, target is not None))
    design, oddities = _Design.of(read, weights)
    notes |= oddities
    if topology.flat(read.vertices):
        notes["flat"] = (
            "all vertices lie in one plane: sensitivities along the normal and targets outside the plane move them out "
            "of it; vectors within the plane keep it flat"
        )
    lower, upper = _box(read.vertices, margin)
    mirror = symmetry_plane.mirror_of(symmetry, symmetry_at, read.vertices, design.triangles, lower, upper)
    if target is not None:
        choices.refuse_with_target()
        pairing, more, warnings = _paired(design, target, target_scale, reject)
        exponent, sides = 0, None
        wanted, stays = pairing.displacement, pairing.rejected
    else:
        pairing = None
        given = str(sensitivity), choices, read, str(template), design.areas, design.mass
        wanted, exponent, sides, more, warnings = sensitivities.descent(*given)
        stays = np.zeros(len(wanted), bool)
    notes |= more
    still = fixing.fixing(fixed, hold, hold_width, keep_out, read, (lower, upper), mirror)
    stays, wanted = stays | still.stays, np.where(still.stays[:, None], 0.0, wanted)
    notes |= still.notes
    if not wanted.any():
        raise UserError(
            f"{target or sensitivity}: no vertex is left that should move; check scenario.fixed, hold and reject"
        )

    diagonal = float((upper - lower).norm())
    over = None if smooth is None else length("scenario.smooth", smooth, diagonal)
    raw = wanted
    if over is not None:
        found = smoothing.smoothed(wanted, read.vertices, design.triangles, design.mass, stays, over, target is None)
        wanted, notes["smooth"] = found.wanted, smoothing.note(found, read.vertices, design.triangles, over)
    if sides is not None:
        notes["largest move"] = signs.way(wanted, read.vertices, sides, objective)
    vertices, faces, mass = (torch.from_numpy(part) for part in (read.vertices, design.triangles, design.mass))
    gradient, norm = unit_gradient(torch.from_numpy(wanted), mass)
    gradient_raw = None if over is None else torch.from_numpy(raw) / norm
    norm = times_power_of_two(norm, exponent)
    if mirror is not None:
        of_symmetry = mirror, read.vertices, design.triangles, gradient.numpy(), design.mass
        more, doubts = symmetry_plane.notes_and_warnings(*of_symmetry)
        notes, warnings = notes | more, warnings + doubts
    return Scenario(
        name="mesh",
        vertices=vertices,
        faces=faces,
        gradient=gradient,
        weights=mass,
        lower=lower,
        upper=upper,
        support=length("scenario.support", support, diagonal),
        sample=surface_sampler(vertices, open_faces(vertices, faces, still.region)),
        gradient_norm=norm,
        notes=notes,
        warnings=warnings,
        closest=None if pairing is None else lambda points: pairing.query(points)[0],
        stays=torch.from_numpy(stays),
        direction_only=pairing is None,
        mirror=mirror,
        keep_out=still.region,
        search_vertices=search_vertices,
        up=up,
        rows=torch.from_numpy(read.rows),
        hold=still.hold,
        blend=None if still.blend is None else torch.from_numpy(still.blend),
        objective=None if target is not None else objective,
        smooth=over,
        gradient_raw=gradient_raw,
    )


@dataclasses.dataclass(frozen=True)
class _Design:
    """A template's consistently wound triangles, and the normals [n, 3], areas and mass [n] of its vertices."""

    vertices: Points
    triangles: Triangles
    normals: Points
    areas: NDArray[np.float64]
    mass: NDArray[np.float64]

    @staticmethod
    def of(template: Template, weights: str) -> tuple[_Design, dict[str, str]]:
        """The design of a template, and notes on the oddities of its surface."""
        vertices, edges = template.vertices, topology.edges_of(len(template.vertices), template.triangles)
        notes = topology.oddities(vertices, template.triangles, edges)
        triangles, turned = topology.oriented(vertices, template.triangles, edges)
        if turned:
            notes["winding"] = f"{turned} triangles were turned, so that all normals point to the same side"
        areas = topology.vertex_areas(vertices, triangles)
        mass = areas / areas.mean() if weights == "area" else np.ones(len(areas))
        return _Design(vertices, triangles, topology.vertex_normals(vertices, triangles), areas, mass), notes


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


def _paired(
    design: _Design, target: str, scale: float | None, reject: str
) -> tuple[Pairing, dict[str, str], list[str]]:
    """Pairs of the design's vertices with the target, after a check of its unit; notes and warnings."""
    points, triangles = read_surface(target)
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise UserError(f"scenario.target_scale={scale}: give a positive number")
    if scale is not None:
        with np.errstate(over="ignore"):
            points = points * scale
        checked_extent(f"{target} times scenario.target_scale={scale:g}", points)
    mine, its = (float(np.linalg.norm(np.ptp(part, axis=0))) for part in (design.vertices, points))
    if scale is None and not 1.0 / MIXED_UNITS < its / mine < MIXED_UNITS:
        raise UserError(
            f"{target}: the target's diagonal is {its:.4g}, the template's {mine:.4g}: are their units different? Set "
            f"scenario.target_scale={nearest_unit(mine / its):g} to scale the target, or 1 to keep its size"
        )
    points, triangles = placement.merge_coincident(points, triangles)
    if triangles is not None and len(triangles) == 0:
        raise UserError(f"{target}: merging coincident vertices leaves no triangle; check the file")
    found = pair(design.vertices, design.normals, points, triangles, reject)
    kind = "a cloud" if triangles is None else f"{len(triangles)} triangles"
    notes = {"target": f"{target}: {len(points)} distinct vertices, {kind}"} | found.notes
    if found.rejected.all():
        raise UserError(
            f"{target}: all pairs of template and target are rejected; check that both are in the same place, or set "
            "scenario.reject=none"
        )
    apart = np.maximum(
        points.min(axis=0) - design.vertices.max(axis=0), design.vertices.min(axis=0) - points.max(axis=0)
    )
    warnings = []
    if apart.max() > mine:
        warnings.append(
            f"the target lies {apart.max():.3g} away from the template: do both have the same coordinate system?"
        )
    return found, notes, warnings
