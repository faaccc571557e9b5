"""A user's mesh that should become a target shape, or follow an adjoint solver's sensitivities."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.arrays import Ints
from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.geometry.correspondence import Points, Triangles
from rbfevo.geometry.lengths import length
from rbfevo.geometry.pairing import REJECTIONS
from rbfevo.geometry.parameterization import Region
from rbfevo.geometry.rims import Rim, rim_of, rim_of_curve
from rbfevo.scenarios import fixing, sensitivities
from rbfevo.scenarios import symmetry as symmetry_plane
from rbfevo.scenarios.matching import MATCHES
from rbfevo.scenarios.outline import outline
from rbfevo.scenarios.planar import Planar
from rbfevo.scenarios.sampling import curve_sampler, open_parts, surface_sampler
from rbfevo.scenarios.scenario import Sampler, Scenario, near_one, times_power_of_two, unit_gradient
from rbfevo.scenarios.targets import paired
from rbfevo.scenarios.templates import Template, read_template
from rbfevo.scenarios.vertex_arrays import vertex_array

WEIGHTS = ("uniform", "area")


def mesh(
    template: str | None = None,
    patches: Any = None,
    target: str | None = None,
    sensitivity: str | None = None,
    sensitivity_kind: str = "nodal",
    sensitivity_match: str = "exact",
    objective: str = "minimize",
    target_scale: float | None = None,
    reject: str = "boundary",
    margin: float = 0.05,
    fixed: Any = None,
    keep_out: bool = False,
    weights: str = "uniform",
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
        sensitivity: the name of a point or cell array of the template, or a CSV, NPY or NPZ file: one value a vertex,
            taken along its normal, or three.
        sensitivity_kind: `nodal` (integrated over a vertex's share of the surface) or `density` (per area).
        sensitivity_match: `exact`: a table's rows are those of the template's points, in any order; `nearest` or
            `interpolate`: of another mesh of the same surface, values per area then.
        objective: `minimize`: the design wants to move against the sensitivity; `maximize`: along it.
        target_scale: factor by which the target is multiplied; None is 1, but mixed units are refused.
        reject: as for `face`.
        margin: by which the box is larger than the template's on each side, as a fraction of the diagonal.
        fixed: vertices that should not move, as `fixing.fixing` takes it: their rows of g are 0.
        keep_out: whether centers may not sit among the fixed vertices.
        weights: `uniform`, each vertex counts the same (the paper), or `area`.
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
    sensitivities.check(sensitivity_kind, objective)
    if sensitivity_match not in MATCHES:
        raise UserError(f"scenario.sensitivity_match={sensitivity_match}: choose one of {', '.join(MATCHES)}")
    read = read_template(str(template), _names(patches), planar is not None)
    parts = f"{len(read.segments)} segments" if read.curve else f"{len(read.triangles)} triangles"
    notes = {"template": f"{template}: {len(read.vertices)} vertices, {parts}"} | read.notes
    if (target is None) == (sensitivity is None):
        raise UserError(_which(read, target is not None))
    flat = Planar.of(planar, read.vertices, read.curve)
    design, oddities = _Design.of(read, weights, flat)
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
    if target is not None:
        if objective != "minimize" or sensitivity_kind != "nodal":
            raise UserError("scenario.objective and scenario.sensitivity_kind belong to a sensitivity, not to a target")
        pairing, more, warnings = paired(read.vertices, design.normals, target, target_scale, reject, flat)
        exponent = 0
        wanted, stays = pairing.displacement, pairing.rejected
    else:
        pairing = None
        given = vertex_array(str(sensitivity), read, "sensitivity", sensitivity_match, sensitivity_kind)
        values = given.values
        if given.other_mesh and sensitivity_kind == "nodal":
            raise UserError(
                f"scenario.sensitivity_match={sensitivity_match}: integrated values depend on the cells of their own "
                "mesh; give values per area, and set scenario.sensitivity_kind=density"
            )
        if not np.any(values):
            raise UserError(f"scenario.sensitivity={sensitivity}: it is zero at every vertex, so nothing should move")
        values, exponent = near_one(values)  # in the units of an adjoint solver values may be huge or tiny
        wanted = sensitivities.wanted(values, design.normals, design.areas, design.mass, sensitivity_kind, objective)
        stays = np.zeros(len(wanted), bool)
        warnings = _sensitivity_warnings(design, str(template), str(sensitivity), read, values)
        more = {"sensitivity": _convention(str(sensitivity), values, sensitivity_kind, objective)}
        more["sensitivity rows"] = given.note
    notes |= more
    region: Region | None = None
    if fixed is not None:
        held = fixing.fixing(fixed, read, lower, upper, mirror, flat)
        stays, wanted = stays | held.fixed, np.where(held.fixed[:, None], 0.0, wanted)
        region = held.region if keep_out else None
        notes["fixed"] = held.note + (", and centers are kept out of their region" if keep_out else "")
    elif keep_out:
        raise UserError("scenario.keep_out=true needs scenario.fixed, the vertices that centers are kept away from")
    if flat is not None:
        stays = flat.either(stays)
        wanted = np.where(stays[:, None], 0.0, wanted)
    if not wanted.any():
        raise UserError(f"{target or sensitivity}: no vertex is left that should move; check scenario.fixed and reject")
    if flat is not None:
        wanted, more = flat.wanted(wanted, design.mass)
        notes |= more

    vertices, faces, mass = (torch.from_numpy(part) for part in (read.vertices, design.triangles, design.mass))
    gradient, norm = unit_gradient(torch.from_numpy(wanted), mass)
    norm = times_power_of_two(norm, exponent)
    if mirror is not None:
        of_symmetry = mirror, read.vertices, design.surface, gradient.numpy(), design.mass
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
        support=_support(support, lower, upper, flat),
        sample=design.sampler(region),
        gradient_norm=norm,
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
        planar=None if flat is None else flat.plane,
    )


@dataclasses.dataclass(frozen=True)
class _Design:
    """A template's consistently wound triangles or segments; normals [n, 3], areas and mass [n] of its vertices.

    Of a curve areas are lengths. `surface` is what the closest points lie on: of a curve the strip that it sweeps.
    """

    vertices: Points
    triangles: Triangles
    segments: Ints
    normals: Points
    areas: NDArray[np.float64]
    mass: NDArray[np.float64]
    surface: tuple[Points, Triangles]

    @staticmethod
    def of(template: Template, weights: str, flat: Planar | None = None) -> tuple[_Design, dict[str, str]]:
        """The design of a template, and notes on the oddities of its surface or curve."""
        vertices, triangles, segments = template.vertices, template.triangles, template.segments
        if template.curve and flat is not None:
            segments, turned, normals, areas, surface, notes = outline(vertices, segments, flat.plane)
        else:
            edges = topology.edges_of(len(vertices), triangles)
            notes = topology.oddities(vertices, triangles, edges)
            triangles, turned = topology.oriented(vertices, triangles, edges)
            surface, areas = (vertices, triangles), topology.vertex_areas(vertices, triangles)
            areas = areas if flat is None else flat.averaged(areas)
            normals = (topology.vertex_normals if flat is None else flat.normals)(vertices, triangles)
        if turned:
            parts = "segments" if template.curve else "triangles"
            notes["winding"] = f"{turned} {parts} were turned, so that all normals point to the same side"
        mass = areas / areas.mean() if weights == "area" else np.ones(len(areas))
        return _Design(vertices, triangles, segments, normals, areas, mass, surface), notes

    def rim(self, flat: Planar | None) -> Rim:
        """Its open boundary: of a slab without front and back, of a curve its ends."""
        if len(self.segments):
            return rim_of_curve(self.vertices, self.segments)
        return rim_of(self.vertices, self.triangles, None if flat is None else flat.plane.axis)

    def sampler(self, region: Region | None) -> Sampler:
        """Centers uniform on the surface or the curve, outside a region."""
        vertices, curve = torch.from_numpy(self.vertices), len(self.segments) > 0
        parts = open_parts(vertices, torch.from_numpy(self.segments if curve else self.triangles), region)
        return (curve_sampler if curve else surface_sampler)(vertices, parts)


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


def _sensitivity_warnings(
    design: _Design, template: str, source: str, read: Template, values: NDArray[np.float64]
) -> list[str]:
    """Warnings about a sensitivity whose side or order of rows the files leave open."""
    found = []
    if values.ndim == 1 and topology.inward(design.vertices, design.triangles):
        found.append(
            f"{template}: the surface is open, and its normals seem to point inwards, but the sensitivity is taken "
            "along outward normals: turn the triangles, or set scenario.objective=maximize"
        )
    if template.lower().endswith(".stl") and source not in read.arrays:
        found.append(
            f"{source}: an STL file has no order of vertices, so rows are taken in the order in which vertices first "
            "appear in it; to be certain, use a VTP file that contains the array"
        )
    return found


def _convention(source: str, values: NDArray[np.float64], kind: str, objective: str) -> str:
    form = "one value per vertex, along its normal" if values.ndim == 1 else "three components per vertex"
    way = "against" if objective == "minimize" else "along"
    return f"{source}: {form}, {kind}; to {objective} the objective, the design should move {way} it"
