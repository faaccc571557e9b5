"""From an adjoint solver's sensitivities to the wanted displacement of a design.

The solver gives dJ/dx at every vertex, either integrated over the vertex's share of the surface (nodal, what a discrete
adjoint returns) or per area (density). The estimated fitness gradient is the direction of steepest descent of J in the
inner product that the vertex weights define, <u, v> = sum_i w_i u_i.v_i: g_i = -s_i / w_i with nodal values s_i. So a
density is multiplied by the vertex's area with uniform weights, and used unchanged with area weights, for which g is
the same on every mesh of a shape, up to the discretization.

One value per vertex is taken along a normal (`signs`); whether values are integrated is asked where it is in doubt
(`kinds`).
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rbfevo.errors import UserError
from rbfevo.scenarios import kinds, signs
from rbfevo.scenarios.kinds import DEFAULT, KINDS
from rbfevo.scenarios.matching import MATCHES
from rbfevo.scenarios.scenario import near_one
from rbfevo.scenarios.signs import NORMALS, Sides
from rbfevo.scenarios.templates import Template
from rbfevo.scenarios.vertex_arrays import vertex_array

OBJECTIVES = ("minimize", "maximize")

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Choices:
    """What `scenario` sets about a sensitivity: `sensitivity_kind`, `_normal` and `_match`, and `objective`.

    Raises:
        UserError: for an unknown choice, naming the key and the valid ones.
    """

    kind: str | None
    normal: str | None
    match: str
    objective: str

    def __post_init__(self) -> None:
        for key, value, choices in (
            ("sensitivity_kind", self.kind or DEFAULT, KINDS),
            ("sensitivity_normal", self.normal or NORMALS[0], NORMALS),
            ("sensitivity_match", self.match, MATCHES),
            ("objective", self.objective, OBJECTIVES),
        ):
            if value not in choices:
                raise UserError(f"scenario.{key}={value}: choose one of {', '.join(choices)}")

    def refuse_with_target(self) -> None:
        """Raise UserError if something is set that only a sensitivity has."""
        if self.objective != "minimize" or self.kind is not None or self.normal is not None:
            raise UserError(
                "scenario.objective, scenario.sensitivity_kind and scenario.sensitivity_normal belong to a "
                "sensitivity, not to a target; remove them"
            )


class Descent(NamedTuple):
    """The wanted displacement [n, 3] times 2^-exponent, and notes and warnings."""

    wanted: Array
    exponent: int
    notes: dict[str, str]
    warnings: list[str]


def descent(
    source: str, choices: Choices, template: Template, title: str, sides: Sides, areas: Array, weights: Array
) -> Descent:
    """Read `scenario.sensitivity=source` and turn it into the wanted displacement.

    Args:
        source: as `vertex_array` takes it; choices: the settings that belong to it.
        template: the surface; title: its file's name; sides: its normals; areas: [n] of its vertices.
        weights: [n] positive.

    Raises:
        UserError: for values that cannot be read or are all 0, and where it is in doubt what they mean.
    """
    choices, known = _known(source, choices, template)
    kind = choices.kind or DEFAULT
    given = vertex_array(source, template, "sensitivity", choices.match, kind)
    values = given.values
    if given.other_mesh and kind == "nodal":
        raise UserError(
            f"scenario.sensitivity_match={choices.match}: integrated values depend on the cells of their own "
            "mesh; give values per area, and set scenario.sensitivity_kind=density"
        )
    if not np.any(values):
        raise UserError(f"scenario.sensitivity={source}: it is zero at every vertex, so nothing should move")
    normals = sides.outward
    if values.ndim == 1:
        if choices.normal is None:
            signs.refuse_either_sign(given.names, source)
        normals = signs.normals(sides, choices.normal, values, template.vertices, source, choices.objective)
    elif choices.normal is not None:
        raise UserError(
            f"scenario.sensitivity_normal={choices.normal}: {source} has three components per vertex and needs no "
            "normal; remove the setting"
        )
    scaled, exponent = near_one(values)  # in the units of an adjoint solver values may be huge or tiny
    if choices.kind is None and not known:
        kinds.ask(given.names, scaled, areas, template.triangles, source)
    notes = {"sensitivity": _convention(source, values, kind, choices), "sensitivity rows": given.note}
    if given.beside is not None and values.ndim == 2:
        notes["scalar sensitivity"] = signs.scalar_beside(near_one(given.beside)[0], scaled, sides.outward)
    return Descent(
        wanted(scaled, normals, areas, weights, kind, choices.objective),
        exponent,
        notes,
        _warnings(source, values, template, title, sides),
    )


def _known(source: str, choices: Choices, template: Template) -> tuple[Choices, bool]:
    """The choices filled up by what the file says of this sensitivity, and whether it says what kind it is.

    Raises:
        UserError: if a setting contradicts the file.
    """
    meaning = template.meanings.get(source)
    if meaning is None:
        return choices, False
    for key, asked, stated in (("kind", choices.kind, meaning.kind), ("normal", choices.normal, meaning.normal)):
        if asked is not None and stated is not None and asked != stated:
            raise UserError(
                f"scenario.sensitivity_{key}={asked}: {source} is {stated} ({meaning.note}); remove the setting"
            )
    filled = {"kind": choices.kind or meaning.kind, "normal": choices.normal or meaning.normal}
    return dataclasses.replace(choices, **filled), meaning.kind is not None


def wanted(values: Array, normals: Array, areas: Array, weights: Array, kind: str, objective: str) -> Array:
    """The wanted displacement [n, 3], up to a positive factor: downhill of an objective to be minimized, else uphill.

    Args:
        values: [n], taken along the normals, or [n, 3].
        normals: [n, 3] unit; areas: [n], a third of the adjacent triangles; weights: [n] positive.
        kind: `nodal` (integrated) or `density` (per area); objective: `minimize` or `maximize`.
    """
    vectors = values[:, None] * normals if values.ndim == 1 else values
    nodal = vectors if kind == "nodal" else vectors * areas[:, None]
    return (1.0 if objective == "maximize" else -1.0) * nodal / weights[:, None]


class Convention(NamedTuple):
    """What the values of a sensitivity mean.

    Attributes:
        kind: `nodal` or `density`; normal: that of scalars, as `scenario.sensitivity_normal`.
    """

    kind: str
    normal: str | None


ALONG = {
    None: "its normal",
    "outward": "its outward normal",
    "inward": "its inward normal",
    "as_wound": "its normal as wound in the file",
}
FORMS = {"nodal": "nodal (integrated)", "density": "density (per area)"}


def _convention(source: str, values: Array, kind: str, choices: Choices) -> str:
    form = f"one value per vertex, along {ALONG[choices.normal]}" if values.ndim == 1 else "three components per vertex"
    way = "against" if choices.objective == "minimize" else "along"
    return f"{source}: {form}, {FORMS[kind]}; to {choices.objective} the objective, the design should move {way} it"


def convention_in(note: str) -> Convention:
    """The convention that a run settled on, from its note on the sensitivity.

    Raises:
        UserError: for another note.
    """
    kinds = [kind for kind, form in FORMS.items() if f", {form}; to m" in note]
    if len(kinds) != 1:
        raise UserError(f"summary.json does not say what the sensitivity of this run means: {note!r}")
    listed = (normal for normal, line in ALONG.items() if f"one value per vertex, along {line}, " in note)
    return Convention(kinds[0], next(listed, None))


def nodal(source: str, then: Convention, match: str, template: Template, sides: Sides, areas: Array) -> Array:
    """The sensitivity dJ/dx [n, 3] of a template, integrated, in the convention in which a run read its own.

    What the file itself says of its values comes first, as it does in a run. Nothing else is asked about again.

    Args:
        source: as `vertex_array` takes it; match: `scenario.sensitivity_match`; sides, areas: of the template.

    Raises:
        UserError: for values that cannot be read.
    """
    meaning = template.meanings.get(source)
    kind = (meaning and meaning.kind) or then.kind
    given = vertex_array(source, template, "sensitivity", match, kind)
    if given.other_mesh and kind == "nodal":
        raise UserError(f"{source}: integrated values depend on the cells of their own mesh; give values per area")
    normals, normal = sides.outward, (meaning and meaning.normal) or then.normal or NORMALS[0]
    if given.values.ndim == 1:
        normals = signs.normals(sides, normal, given.values, template.vertices, source, OBJECTIVES[0])
    return -wanted(given.values, normals, areas, np.ones(len(areas)), kind, OBJECTIVES[0])


def _warnings(source: str, values: Array, template: Template, title: str, sides: Sides) -> list[str]:
    """Warnings about a sensitivity whose side or order of rows the files leave open."""
    found = []
    if values.ndim == 1 and sides.one_sided:
        found.append(
            f"{title}: at {sides.one_sided} edges the surface is one-sided, so that its normals have no consistent "
            "side there; give a sensitivity of three components"
        )
    if title.lower().endswith(".stl") and source not in template.arrays:
        found.append(
            f"{source}: an STL file has no order of vertices, so rows are taken in the order in which vertices first "
            "appear in it; to be certain, use a VTP file that contains the array"
        )
    return found
