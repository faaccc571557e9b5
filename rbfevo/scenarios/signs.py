"""The normals that a sensitivity of one value per vertex refers to, and the way in which it moves a design.

Solvers differ: a value may refer to the normal out of the body, to that out of the fluid (into the body), or to the
normals as the file winds its triangles. Where the winding of the file agrees with the outward normals, these are taken.
Elsewhere `scenario.sensitivity_normal` decides, and without it the run asks; as it does where programs of one name
write either sign.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rbfevo.arrays import Ints, Points, Triangles
from rbfevo.errors import UserError
from rbfevo.geometry import curves, topology
from rbfevo.geometry.planar import Plane
from rbfevo.scenarios.quantities import SCALAR

NORMALS = ("outward", "inward", "as_wound")
SAME = 1e-6  # by which two unit normals may differ, for rounding
AGREE = 0.9  # correlation from which a scalar is taken for the component of a vector along the normal
ACROSS = 0.2  # |cosine| to the normal, below which a move is along the surface

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Sides:
    """The two readings of a surface's normals.

    Attributes:
        outward, wound: [n, 3] unit normals of the vertices, outward and as the file winds the triangles; each zero
            where the normals of a vertex's triangles cancel.
        sided: whether the surface has an outside: it is closed, or encloses a volume once its holes are closed.
        clashes: edges at which the file winds two neighbours against each other.
        one_sided: edges at which they still are once triangles are turned (a Moebius strip).
    """

    outward: Points
    wound: Points
    sided: bool
    clashes: int
    one_sided: int

    @property
    def differ(self) -> NDArray[np.bool_]:
        """[n] True where the file's normal is not the outward one."""
        return np.linalg.norm(self.outward - self.wound, axis=1) > SAME


def sides(
    vertices: Points,
    triangles: Triangles,
    normals_of: Callable[[Points, Triangles], Points] = topology.vertex_normals,
) -> Sides:
    """Find the outward normals of a surface, and those of its file.

    Outward is, of a closed piece, out of the volume that it encloses; of the other pieces, out of the volume that they
    enclose together once their holes are closed towards their middle. A flat sheet has no such volume, and a closed
    piece within another may be a cavity: there the normals of most of its triangles count as outward. Vertices at
    exactly the same place count as one, so that patches that meet without sharing vertices are one piece.

    Args:
        vertices: [n, 3]; triangles: [f, 3] as the file winds them; normals_of: (vertices, triangles) -> [n, 3].
    """
    places, place = np.unique(vertices, axis=0, return_inverse=True)
    merged = place.reshape(-1)[triangles]
    edges = topology.edges_of(len(places), merged)
    turned, _ = topology.oriented(places, merged, edges)
    one_sided = topology.clashes(topology.edges_of(len(places), turned))
    unsettled = _unsettled(edges, len(merged))
    enclosed = topology.enclosed(places, turned[unsettled])
    if enclosed < -topology.FLAT:
        turned = np.where(unsettled[:, None], turned[:, ::-1], turned)
    reversed_ = (turned != merged).any(axis=1)
    outward = normals_of(vertices, np.where(reversed_[:, None], triangles[:, ::-1], triangles))
    sided = bool((~unsettled).any()) or abs(enclosed) > topology.FLAT
    return Sides(outward, normals_of(vertices, triangles), sided, topology.clashes(edges), one_sided)


def sides_of_curve(vertices: Points, segments: Ints, outward: Points, plane: Plane) -> Sides:
    """The sides of a curve in a plane.

    Args:
        vertices: [n, 3]; segments: [s, 2] as the file has them; outward: [n, 3] unit normals; plane: of the curve.
    """
    wound = np.zeros(vertices.shape)
    wound[:, plane.others] = curves.normals(vertices[:, plane.others], segments)
    starts, ends = (np.bincount(segments[:, side], minlength=len(vertices)) for side in (0, 1))
    clashes = int(((starts + ends == 2) & (starts != 1)).sum())
    return Sides(outward, wound, not len(curves.ends(len(vertices), segments)), clashes, 0)


def _unsettled(edges: topology.Edges, f: int) -> NDArray[np.bool_]:
    """[f] True for the triangles of pieces that are not closed, or have edges of more than two triangles."""
    links = coo_array((np.ones(3 * f, bool), (edges.triangle, f + edges.index)), shape=(f + len(edges.uses),) * 2)
    _, piece = connected_components(links, directed=False)
    marked = np.zeros(len(piece), bool)
    marked[piece[edges.triangle[edges.uses[edges.index] != 2]]] = True
    return marked[piece[:f]]


def normals(found: Sides, choice: str | None, values: Array, vertices: Points, source: str, objective: str) -> Points:
    """The normals [n, 3] that a sensitivity of one value per vertex is taken along.

    Args:
        found: the surface's sides; choice: `scenario.sensitivity_normal`; values: [n], not all 0.
        vertices: [n, 3]; source: the sensitivity's name; objective: `minimize` or `maximize`: all for messages.

    Raises:
        UserError: without a choice, where the two readings differ at a vertex with a value; for `as_wound`, where the
            file winds neighbours against each other.
    """
    sign = -1.0 if objective == "minimize" else 1.0
    if choice == "as_wound":
        if found.clashes:
            raise UserError(
                f"scenario.sensitivity_normal=as_wound: at {found.clashes} edges the file winds the two triangles "
                "against each other, so its normals jump from side to side; set outward or inward, or mend the file"
            )
        return found.wound
    if choice == "inward":
        return -found.outward
    differ = found.differ & (values != 0.0)
    if choice is None and differ.any():
        opposite = differ & ((found.outward * found.wound).sum(axis=1) < 0.0)
        most = int(np.where(opposite if opposite.any() else differ, np.abs(values), -1.0).argmax())
        outward, wound = (
            _side(sign * values[most] * side[most], found.outward[most]) for side in (found.outward, found.wound)
        )
        other = (
            f"as_wound (along the file's normals: {wound} there)"
            if not found.clashes
            else f"mend the file (as_wound is out: at {found.clashes} edges it winds two triangles against each other)"
        )
        raise UserError(
            f"scenario.sensitivity={source}: one value per vertex refers to a normal, but at {int(differ.sum())} of "
            f"{len(values)} vertices the normal as wound in the file is not the outward one: set "
            f"scenario.sensitivity_normal=outward (at {_numbers(vertices[most])}, where it is {values[most]:.3g}, the "
            f"design then moves {outward}) or {other}; your solver's manual names its normal, OpenFOAM's points out of "
            "the fluid: into a body, or outwards from a duct"
        )
    return found.outward


def refuse_either_sign(names: Iterable[str], source: str) -> None:
    """Raise UserError for a scalar of SU2 without its vector: its programs write it with different signs.

    Args:
        names: of the array or the columns; source: the sensitivity's name, for the message.
    """
    if any(name.strip().lower() == SCALAR for name in names):
        raise UserError(
            f"scenario.sensitivity={source}: the sign of SU2's Surface_Sensitivity depends on the program, and its "
            "vector (Sensitivity_x, Sensitivity_y, ...) is not there. SU2_CFD_AD writes the component along the normal "
            "out of the fluid (of a body: scenario.sensitivity_normal=inward; of a duct: outward), SU2_DOT along the "
            "one into the fluid (of a body: scenario.sensitivity_normal=outward; of a duct: inward); set it, or give "
            "the vector"
        )


def scalar_beside(scalar: Array, vectors: Points, outward: Points) -> str:
    """One line on SU2's scalar [n] beside vectors [n, 3]: along which normal it is their component."""
    along = (vectors * outward).sum(axis=1)
    length = float(np.linalg.norm(scalar) * np.linalg.norm(along))
    agreement = float(scalar @ along) / length if length > 0.0 else 0.0
    if abs(agreement) >= AGREE:
        side, body, duct = (
            ("outward", "SU2_DOT", "SU2_CFD_AD") if agreement > 0.0 else ("inward", "SU2_CFD_AD", "SU2_DOT")
        )
        return (
            f"Surface_Sensitivity beside the vector is its component along the {side} normal (correlation "
            f"{abs(agreement):.3f}), as {body} writes it of a body and {duct} of a duct; the vector is taken"
        )
    return (
        "Surface_Sensitivity beside the vector is not its component along the normals (correlation "
        f"{agreement:.2f}); the vector is taken: are both of one objective, and is this the surface they belong to?"
    )


def way(wanted: Array, vertices: Points, found: Sides, objective: str) -> str:
    """One line on where a design moves most, and which way.

    Args:
        wanted: [n, 3], not all 0; vertices: [n, 3]; found: the surface's sides; objective: `minimize` or `maximize`.
    """
    most = int((wanted**2).sum(axis=1).argmax())
    direction = wanted[most] / np.linalg.norm(wanted[most])
    place = np.where(np.abs(vertices[most]) < 1e-9 * np.abs(vertices).max(), 0.0, vertices[most])
    side = f"{_side(direction, found.outward[most])}, " if found.sided else ""
    against = "against" if objective == "minimize" else "along"
    return (
        f"it wants to move most at {_numbers(place)}: {side}along {_numbers(direction.round(2) + 0.0)}, "
        f"{against} the sensitivity (scenario.objective={objective})"
    )


def _side(move: Array, normal: Array) -> str:
    """Whether a displacement [3] points outwards, inwards or along the surface, given the outward normal [3]."""
    length = float(np.linalg.norm(move))
    cosine = float(move @ normal) / length if length > 0.0 else 0.0
    if abs(cosine) < ACROSS:
        return "along the surface"
    return "outwards" if cosine > 0.0 else "inwards"


def _numbers(point: Array) -> str:
    return f"({', '.join(f'{number:.3g}' for number in point)})"
