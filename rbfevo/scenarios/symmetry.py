"""The symmetry plane of a design, and how symmetric its mesh and its wanted displacement are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.correspondence import Points, Triangles, closest_on_surface
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.rims import Rim

LOOKED_AT = 20_000  # vertices: enough to measure how symmetric a mesh is
LOPSIDED = 0.01  # of the box's diagonal
MOST_OF_RIM, PROPOSED, PART_OF_RIM = 0.8, 0.5, 0.05  # of the open boundary's length
CLEARLY_MORE = 4.0  # times the length at the other end
WIDE = 0.5  # of the template's extent, over which half a model is cut
HOPELESS = 0.999  # of |g|^2
ONE_SIDED = 0.02  # fewer vertices than this on one side, over those on the other: half a model


def mirror_of(
    axis: str | None,
    at: float | None,
    vertices: Points,
    surface: tuple[Points, Triangles],
    rim: Rim,
    lower: Tensor,
    upper: Tensor,
) -> tuple[Mirror | None, dict[str, str]]:
    """The plane that `scenario.symmetry` and `scenario.symmetry_at` ask for, and notes on how it was found.

    Where `at` is null it is the plane of `found_plane`.

    Args:
        vertices: [n, 3]; surface: what their mirror images should lie on; rim: its open boundary.
        lower, upper: corners of the scenario's box.

    Raises:
        UserError: for another axis, `at` without an axis, a plane that does not cross the box, one that holds the whole
            template, or where it stays open whether the template is half a model.
    """
    if axis is None:
        if at is not None:
            raise UserError("scenario.symmetry_at needs scenario.symmetry, the axis across the plane: x, y or z")
        return None, {}
    if axis not in ("x", "y", "z"):
        raise UserError(f"scenario.symmetry={axis}: choose x, y or z, the axis across the plane, or null")
    number, notes = "xyz".index(axis), {}
    low, high = float(vertices[:, number].min()), float(vertices[:, number].max())
    if at is None:
        at, notes = found_plane(number, vertices, surface, rim)
    mirror = Mirror.across(number, at, lower, upper)
    if max(high - at, at - low) <= mirror.tolerance:
        raise UserError(
            f"scenario.symmetry={axis}: the whole template lies in the plane {axis} = {at:g}; choose another"
        )
    return mirror, notes


def found_plane(
    axis: int, vertices: Points, surface: tuple[Points, Triangles], rim: Rim
) -> tuple[float, dict[str, str]]:
    """Where a template is symmetric: at an end where half a model is cut, or in the middle; and notes.

    It is the end at which the surface is cut off along 80 % of the length of its rim or more. Other openings, as inlet
    and outlet of a duct, may hide that: then it is the one end with at least 5 % of the rim whose cut reaches over half
    of the template in both other directions, if the template is not symmetric about its middle. One that is symmetric
    and cut so at both ends, as an open tube, or only in a small opening, is a whole one.

    Raises:
        UserError: if it stays open whether the template is half a model, naming the planes.
    """
    name = "xyz"[axis]
    low, high = float(vertices[:, axis].min()), float(vertices[:, axis].max())
    middle, shares = (low + high) / 2.0, {end: rim.share(axis, end) for end in (low, high)}
    cut = sorted((end for end in shares if shares[end] >= PART_OF_RIM), key=lambda end: -shares[end])
    if not cut:
        return middle, {}
    if shares[cut[0]] >= MOST_OF_RIM:
        return cut[0], {}
    wide = [end for end in cut if rim.reach(axis, end) >= WIDE]
    clear = len(wide) == 1 or (len(wide) == 2 and shares[wide[0]] >= CLEARLY_MORE * shares[wide[1]])
    whole = off_surface(Mirror(axis, middle), vertices, surface)[0] <= LOPSIDED * _diagonal(vertices)
    if clear and not whole:
        return wide[0], {
            "half model": f"{shares[wide[0]]:.0%} of the open boundary lies in the plane {name} = {wide[0]:g}, where "
            f"the template is taken to be cut in half; of a whole one, set scenario.symmetry_at={middle:g}"
        }
    where = " and ".join(f"{name} = {end:g}" for end in sorted(cut))
    half = " or ".join(f"scenario.symmetry_at={end:g}" for end in sorted(cut))
    if whole and not clear:
        return middle, {
            "half model": f"the template is open at {where} but symmetric about its middle {name} = {middle:g}, and "
            f"taken as a whole one; of half a model, set {half}"
        }
    raise UserError(
        f"scenario.symmetry={name}: the template is open at {where}, which may cut it in half, or be another opening: "
        f"set {half} for half a model, or scenario.symmetry_at={middle:g}, its middle, for a whole one"
    )


def proposal(vertices: Points, rim: Rim, without: int | None = None) -> dict[str, str]:
    """A note if the template looks like half a model: most of its rim lies in one plane at its end.

    It does not where another end has nearly as much of the rim, as an open tube has.

    Args:
        without: an axis that is not looked at, that of a planar design.
    """
    ends = {
        (axis, float(side)): rim.share(axis, float(side))
        for axis in range(3)
        if axis != without
        for side in (vertices[:, axis].min(), vertices[:, axis].max())
    }
    (axis, end), share = max(ends.items(), key=lambda item: item[1])
    name, opposite = (
        "xyz"[axis],
        max((ends[other] for other in ends if other[0] == axis and other[1] != end), default=0),
    )
    second = max((ends[other] for other in ends if other != (axis, end)), default=0.0)
    if share <= PROPOSED or opposite * CLEARLY_MORE > share or (share < MOST_OF_RIM and 2.0 * second > share):
        return {}
    return {
        "half model": f"{share:.0%} of the open boundary lies in the plane {name} = {end:g}: half a model? "
        f"scenario.symmetry={name} scenario.symmetry_at={end:g} keeps it symmetric"
    }


def off_surface(
    mirror: Mirror, vertices: Points, surface: tuple[Points, Triangles]
) -> tuple[float, NDArray[np.int64], Points]:
    """How far mirror images of vertices [n, 3] lie from a surface at most; of which vertices, and their images."""
    some = np.linspace(0, len(vertices) - 1, min(len(vertices), LOOKED_AT)).astype(np.int64)
    images = mirror.image(vertices[some])
    closest, _ = closest_on_surface(images, *surface)
    return float(np.linalg.norm(closest - images, axis=1).max()), some, images


def _diagonal(vertices: Points) -> float:
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def notes_and_warnings(
    mirror: Mirror,
    vertices: Points,
    surface: tuple[Points, Triangles],
    gradients: Mapping[str, NDArray[np.float64]],
    weights: NDArray[np.float64],
) -> tuple[dict[str, str], list[str]]:
    """Notes and warnings: how far mirror images lie from the surface, and how much of g is not symmetric.

    Args:
        gradients: g [n, 3] of each objective by its name, which is empty where there is only one.

    Raises:
        UserError: if a g is antisymmetric.
    """
    name = f"{'xyz'[mirror.axis]} = {mirror.at:g}"
    heights = vertices[:, mirror.axis] - mirror.at
    beyond = np.sort([(heights > mirror.tolerance).sum(), (heights < -mirror.tolerance).sum()])
    if beyond[0] <= ONE_SIDED * beyond[1]:
        return {"symmetry": f"symmetry about {name}; the template is one half, and the other half is not scored"}, []
    distance, some, images = off_surface(mirror, vertices, surface)
    _, partner = KDTree(vertices).query(images)
    shares = []
    for objective, gradient in gradients.items():
        turned = gradient[partner].copy()
        turned[:, mirror.axis] *= -1.0
        odd = (weights[some, None] * ((gradient[some] - turned) / 2.0) ** 2).sum()
        share = float(odd / max((weights[some, None] * gradient[some] ** 2).sum(), np.finfo(float).tiny))
        if share > HOPELESS:
            raise UserError(
                f"symmetry about {name}: the wanted displacement{objective and f' of {objective}'} is antisymmetric, "
                "so no symmetric setup can follow it; check scenario.symmetry and scenario.symmetry_at"
            )
        shares.append(f"{share:.1%} of |g|^2{objective and f' of {objective}'}")
    are = "is" if len(shares) == 1 else "are"
    notes = {
        "symmetry": f"symmetry about {name}: mirror images lie within {distance:.3g} of the surface; "
        f"{', '.join(shares)} {are} not symmetric, and out of reach"
    }
    if distance > LOPSIDED * _diagonal(vertices):
        return notes, [
            f"symmetry about {name}: the template is not symmetric (mirror images lie up to {distance:.3g} from its "
            "surface); check scenario.symmetry and scenario.symmetry_at"
        ]
    return notes, []
