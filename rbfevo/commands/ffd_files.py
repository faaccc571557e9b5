"""A box of free-form deformation as other programs read it: plot3d for pyGeo, SU2's settings, PyGeM's parameters, VTS.

All of them hold the whole lattice, mirror images and control points that do not move included, with the first axis
running fastest. pyGeo takes B-splines of order min(4, n) on evenly spaced knots; SU2 places control points evenly, as
Bernstein polynomials have them; PyGeM has Bernstein polynomials alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.moves import spatial
from rbfevo.recorded.setup import Setup
from rbfevo.scoring.representations import FFD
from rbfevo.scoring.representations.lattice import Lattice

TAG = "BOX"
PYGEO = 4  # the highest order of its splines


class Moved(NamedTuple):
    """A whole lattice in space.

    Attributes:
        places, moves: [n_1, n_2, n_3, 3] the control points, and how far they move; n_3 = 1 on the plane.
    """

    places: Array
    moves: Array


def moved(chosen: Setup, weights: Array) -> Moved:
    """The whole lattice of a setup of free-form deformation under weights [m, k] of its columns."""
    representation, genotype = _parts(chosen)
    lattice = representation.lattice
    places = lattice.places(genotype[: lattice.size])
    moves = np.zeros((*lattice.counts, 3))
    index, own = representation.indices(genotype), spatial(weights)
    moves[tuple(index.T)] = own
    if representation.half is not None:
        axis = representation.half.axis
        images, turned = index.copy(), own.copy()
        images[:, axis] = lattice.counts[axis] - 1 - index[:, axis]
        turned[:, axis] *= -1.0
        off = images[:, axis] != index[:, axis]
        moves[tuple(images[off].T)] = turned[off]
    flat = spatial(places.reshape(-1, lattice.dimension))
    shape = (*lattice.counts, *[1] * (3 - lattice.dimension), 3)
    return Moved(flat.reshape(shape), moves.reshape(shape))


def contents(chosen: Setup, weights: Array) -> dict[str, bytes | str]:
    """The text files under weights [m, k], or for each that is left out the reason.

    Raises:
        UserError: if the setup is none of free-form deformation.
    """
    representation, genotype = _parts(chosen)
    lattice = representation.lattice
    if lattice.dimension != 3:
        return dict.fromkeys(("lattice.xyz", "su2.cfg", "parameters.prm"), "it is for boxes in space")
    whole = moved(chosen, weights)
    held = "it has no held regions; deform meshes with python -m rbfevo.apply"
    found: dict[str, bytes | str] = {"lattice.xyz": plot3d(whole.places)}
    bernstein = not sum(lattice.inner)
    for name, make in (("su2.cfg", su2), ("parameters.prm", pygem)):
        if chosen.hold is not None:
            found[name] = held
        elif not bernstein:
            found[name] = "it has Bernstein polynomials, or B-splines whose control points lie elsewhere"
        else:
            found[name] = make(lattice, genotype, whole)
    return found


def alike(lattice: Lattice) -> bool:
    """Whether pyGeo deforms as the lattice does."""
    return not lattice.knots and all(
        degree == min(PYGEO, count) - 1 for count, degree in zip(lattice.counts, lattice.degrees, strict=True)
    )


def plot3d(places: Array) -> bytes:
    """A lattice [n_1, n_2, n_3, 3] as one block of plot3d's text format: all x, all y, all z."""
    lines = ["1", " ".join(map(str, places.shape[:3]))]
    for axis in range(3):
        lines += [repr(number) for number in places[..., axis].ravel(order="F").tolist()]
    return ("\n".join(lines) + "\n").encode()


def corners(places: Array) -> Array:
    """The eight corners [8, 3] of a lattice in SU2's order: around the first face of the third axis, then the last."""
    i, j = [0, -1, -1, 0, 0, -1, -1, 0], [0, 0, -1, -1, 0, 0, -1, -1]
    return places[i, j, [0, 0, 0, 0, -1, -1, -1, -1]]


def su2(lattice: Lattice, genotype: Array, whole: Moved) -> bytes:
    """Settings of SU2_DEF: the box, first for FFD_SETTING, and its control points as design variables with values."""
    points = ", ".join(repr(number) for number in corners(whole.places).ravel().tolist())
    degrees = ", ".join(str(count - 1) for count in lattice.counts)
    kinds, parameters, values = [], [], []
    for index in np.ndindex(*lattice.counts):
        for axis in range(3):
            value = float(whole.moves[(*index, axis)])
            if value != 0.0:
                way = ", ".join("1.0" if axis == other else "0.0" for other in range(3))
                kinds.append("FFD_CONTROL_POINT")
                parameters.append(f"( {TAG}, {', '.join(map(str, index))}, {way} )")
                values.append(repr(value))
    lines = [
        "% A box of free-form deformation for SU2, written by rbfevo.",
        "% First SU2_DEF with DV_KIND= FFD_SETTING and DV_PARAM= ( 1.0 ), which stores the box in the mesh; then with",
        "% the design variables below. Set DV_MARKER to the markers of the design.",
        f"FFD_DEFINITION= ( {TAG}, {points} )",
        f"FFD_DEGREE= ( {degrees} )",
        "FFD_BLENDING= BEZIER",
        "% Control points move as listed; none is kept still where the surface leaves the box.",
        "FFD_CONTINUITY= USER_INPUT",
        f"DV_KIND= {', '.join(kinds) or 'FFD_SETTING'}",
        f"DV_PARAM= {'; '.join(parameters) or '( 1.0 )'}",
        f"DV_VALUE= {', '.join(values) or '0.0'}",
    ]
    return ("\n".join(lines) + "\n").encode()


def pygem(lattice: Lattice, genotype: Array, whole: Moved) -> bytes:
    """PyGeM's parameters for free-form deformation: moves along the sides of the box, relative to their lengths."""
    origin, counts = whole.places[0, 0, 0], lattice.counts
    sides = 2.0 * genotype[3:6]
    axes = np.stack([whole.places[-1, 0, 0], whole.places[0, -1, 0], whole.places[0, 0, -1]]) - origin
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.zeros(3)
    if lattice.turn is not None:
        angles[lattice.turn] = np.degrees(genotype[6])
    lines = ["# Parameters of free-form deformation for PyGeM, written by rbfevo.", "", "[Box info]"]
    lines += [f"n control points {letter}: {count}" for letter, count in zip("xyz", counts, strict=True)]
    for name, values in (("box length", sides), ("box origin", origin), ("rotation angle", angles)):
        lines += [f"{name} {letter}: {value!r}" for letter, value in zip("xyz", values.tolist(), strict=True)]
    lines += ["", "[Parameters weights]"]
    relative = (whole.moves @ axes.T) / sides
    for axis, letter in enumerate("xyz"):
        rows = [f"{i} {j} {k} {float(relative[i, j, k, axis])!r}" for i, j, k in np.ndindex(*counts)]
        lines += [f"parameter {letter}: " + "\n    ".join(rows), ""]
    return "\n".join(lines).encode()


def grid(chosen: Setup, weights: Array) -> Any:
    """A vtkStructuredGrid of the whole lattice, with the displacements of its control points and whether they move."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkStructuredGrid

    from rbfevo.meshes.vtk_datasets import add_array

    whole = moved(chosen, weights)
    made, places = vtkStructuredGrid(), vtkPoints()
    made.SetDimensions(*whole.places.shape[:3])
    places.SetData(numpy_to_vtk(np.ascontiguousarray(_fastest_first(whole.places)), deep=True))
    made.SetPoints(places)
    add_array(made.GetPointData(), "displacement", _fastest_first(whole.moves))
    return made


def _fastest_first(values: Array) -> Array:
    """Values [n_1, n_2, n_3, 3] of a lattice as rows [n, 3], the first axis running fastest."""
    return values.transpose(2, 1, 0, 3).reshape(-1, 3)


def _parts(chosen: Setup) -> tuple[FFD, Array]:
    """The representation and the genotype of a setup of free-form deformation."""
    if not isinstance(chosen.representation, FFD) or chosen.genotype is None:
        raise UserError("a setup of free-form deformation is expected")
    return chosen.representation, chosen.genotype
