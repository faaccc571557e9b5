"""Control points that somebody has placed, as centers of a setup of a scenario: none is moved, and none made up.

What does not fit the scenario is refused in one line. What fits but is worth knowing (centers outside the box, in a
region that is kept free, or in one place) is scored as it is, with a note.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.geometry.mirror import ON_PLANE, Mirror
from rbfevo.geometry.planar import LAYER
from rbfevo.meshes.control_points import EXPORTED, ControlPoints, read_control_points
from rbfevo.names import existing_home, natural
from rbfevo.scenarios.scenario import Scenario

SAME = 1e-6  # of the box's diagonal: a mirror image that close to a control point is its own; spreadsheets round


class Placed(NamedTuple):
    """Centers [m, d] of a setup, and notes, a line each."""

    centers: Array
    notes: list[str]


def read_centers(path: str, scenario: Scenario) -> Placed:
    """The control points in a file, as `read_control_points` takes it, as centers of a setup of a scenario.

    With a plane of symmetry they are one half of the points, which may come with their mirror images or without. In a
    planar design they lie in its mid-plane; the coordinate across it can be missing.

    Raises:
        UserError: if the file cannot be read, or its points are no centers of a setup of the scenario.
    """
    found = read_control_points(path)
    try:
        return placed(found, scenario)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def files_in(path: str) -> tuple[str, ...]:
    """The files of setups that a path stands for: of a directory that is no export its CSV files, by their names.

    Any other path stands for itself, also where there is nothing.

    Raises:
        UserError: if the directory has no such file.
    """
    directory = existing_home(path)
    if not directory.is_dir() or any((directory / name).exists() for name in (*EXPORTED, "setup.npz", "setups.npz")):
        return (path,)
    found = [file for file in directory.iterdir() if file.is_file() and file.suffix.lower() == ".csv"]
    if not found:
        raise UserError(f"{path}: this directory has neither {EXPORTED[0]} of an export nor other CSV files")
    return tuple(str(Path(path) / file.name) for file in sorted(found, key=lambda file: natural(file.name)))


def placed(found: ControlPoints, scenario: Scenario) -> Placed:
    """`read_centers` of control points that have been read.

    Raises:
        UserError: if they are no centers of a setup of the scenario.
    """
    points, notes = _coordinates(found, scenario)
    notes = [*found.notes, *notes]
    if scenario.mirror is not None:
        kept, note = _half(points, found.mirrored, scenario.mirror, scenario)
        points = points[kept]
        notes.append(note)
    elif found.mirrored is not None and found.mirrored.any():
        notes.append(
            f"the file calls {int(found.mirrored.sum())} of them mirror images of others; without scenario.symmetry "
            "they are control points of their own"
        )
    return Placed(points, [*notes, *_remarks(points, scenario)])


def _count(number: int, total: int | None = None) -> str:
    """`1 of 12 points is`, `3 points are`."""
    of = "" if total is None else f" of {total}"
    return f"{number}{of} point{'s' * ((total or number) != 1)} {'is' if number == 1 else 'are'}"


def _listed(rows: Sequence[int]) -> str:
    """The first rows, counted from 0."""
    shown = ", ".join(str(row) for row in rows[:5])
    return f"row{'s' * (len(rows) != 1)} {shown}{', ...' if len(rows) > 5 else ''}"


def _coordinates(found: ControlPoints, scenario: Scenario) -> tuple[Array, list[str]]:
    """Points [q, d] in the dimension of the scenario, in its mid-plane if it has one."""
    d, planar = scenario.vertices.shape[1], scenario.planar
    names = " and ".join("xyz"[axis] for axis in found.axes)
    if d == 2:
        if not set(found.axes) >= {0, 1}:
            raise UserError(f"its points have coordinates {names}, but scenario {scenario.name} has x and y")
        height = found.points[:, 2] if len(found.axes) == 3 else np.zeros(len(found.points))
        if height.any():
            raise UserError(
                f"its points have three coordinates, and z is up to {np.abs(height).max():g}; scenario {scenario.name} "
                "has two dimensions"
            )
        return found.points[:, :2], []
    if len(found.axes) == 3:
        points, notes = found.points, []
    elif planar is not None and set(found.axes) == set(planar.others):
        points = np.full((len(found.points), 3), planar.at)
        points[:, list(found.axes)] = found.points
        return points, [
            f"the points have no {planar.name}, and are taken in the mid-plane {planar.name} = {planar.at:g}"
        ]
    else:
        raise UserError(
            f"its points have two coordinates, {names}; scenario {scenario.name} has three dimensions: give x, y and z"
        )
    if planar is None:
        return points, notes
    off = np.abs(points[:, planar.axis] - planar.at)
    wrong = np.flatnonzero(off > LAYER * scenario.diagonal)
    if wrong.size:
        raise UserError(
            f"{_count(wrong.size, len(points))} off the mid-plane {planar.name} = {planar.at:.17g} of the planar "
            f"design, by up to {off.max():g} ({_listed(wrong.tolist())}); put them on it, or leave "
            f"the column {planar.name} out"
        )
    if off.any():
        notes = [
            f"{_count(int((off > 0).sum()))} off the mid-plane by up to {off.max():.1e}, which is rounding: taken on it"
        ]
    return planar.pinned(points), notes


def _half(
    points: Array, flagged: NDArray[np.bool_] | None, mirror: Mirror, scenario: Scenario
) -> tuple[NDArray[np.int64], str]:
    """Which rows of symmetric points [q, d] are the centers, images left out, and a note.

    Raises:
        UserError: if points on both sides are not images of each other.
    """
    axis, near = "xyz"[mirror.axis], SAME * scenario.diagonal
    plane = f"{axis} = {mirror.at:g}"
    height = points[:, mirror.axis] - mirror.at
    on = np.asarray(mirror.on_plane(points), bool)
    above, below = np.flatnonzero(~on & (height > 0)), np.flatnonzero(~on & (height < 0))
    if not (len(above) and len(below)):
        note = f"{_count(len(points) - int(on.sum()))} on one side of {plane}: mirror images are added"
        if on.any():
            note += f"; {_count(int(on.sum()))} on the plane"
        almost = np.flatnonzero(~on & (np.abs(height) <= near))
        if almost.size:
            note += (
                f"; {_listed(almost.tolist())} all but on the plane, and their images almost in the same place: R is "
                f"near 0 unless {axis} is exactly {mirror.at:.17g}"
            )
        return np.arange(len(points)), note
    partner = _partners(points[above], np.asarray(mirror.image(points[below])), near)
    lost = np.concatenate([above[partner < 0], np.setdiff1d(below, below[partner[partner >= 0]])])
    if lost.size:
        lost = np.sort(lost)
        almost = int((np.abs(height[lost]) <= near).sum())
        hint = f"; {_count(almost)} almost on the plane: give {axis} = {mirror.at:.17g} there" if almost else ""
        raise UserError(
            f"it is not symmetric: {lost.size} of {len(points)} points ({_listed(lost.tolist())}) have no mirror image "
            f"about {plane} in it; give all images, or the points on one side alone{hint}"
        )
    others = below if scenario.side > 0 else above
    if flagged is not None and not flagged[on].any() and (flagged[above] != flagged[below[partner]]).all():
        others = np.flatnonzero(flagged)
    kept = np.setdiff1d(np.arange(len(points)), others)
    return kept, (
        f"{len(others)} of {len(points)} points left out, mirror images of others about {plane}: {len(kept)} centers"
        + (f", {int(on.sum())} of them on the plane" if on.any() else "")
    )


def _partners(points: Array, others: Array, near: float) -> NDArray[np.int64]:
    """For each of points [p, d] the closest of others [q, d] within a distance that is not taken yet, or -1."""
    free, found = np.ones(len(others), bool), np.full(len(points), -1)
    for row, close in enumerate(KDTree(others).query_ball_point(points, near)):
        candidates = np.array([other for other in sorted(close) if free[other]], dtype=int)
        if candidates.size:
            distance = np.linalg.norm(others[candidates] - points[row], axis=1)
            found[row] = candidates[np.argmin(distance)]
            free[found[row]] = False
    return found


def _remarks(centers: Array, scenario: Scenario) -> list[str]:
    """What is worth knowing of centers [m, d] that are scored as they are."""
    rounding, notes = ON_PLANE * scenario.diagonal, []
    lower, upper = scenario.lower.numpy() - rounding, scenario.upper.numpy() + rounding

    def within(points: Array) -> NDArray[np.bool_]:
        return np.all((points >= lower) & (points <= upper), axis=1)

    outside = ~within(centers)
    if scenario.mirror is not None:
        outside &= ~within(scenario.mirror.image(centers))
    if outside.any():
        rows = np.flatnonzero(outside).tolist()
        notes.append(f"{_count(len(rows), len(centers))} outside the box of the search (center {_rows(rows)})")
    if scenario.keep_out is not None:
        rows = np.flatnonzero(scenario.keep_out.contains(torch.from_numpy(centers)).numpy()).tolist()
        if rows:
            notes.append(
                f"{_count(len(rows), len(centers))} in the region where searches place none (center {_rows(rows)})"
            )
    pairs = KDTree(centers).query_pairs(rounding)
    if pairs:
        rows = sorted({row for pair in pairs for row in pair})
        notes.append(f"{_count(len(rows), len(centers))} in the same place as another (center {_rows(rows)}): R = 0")
    return notes


def _rows(rows: Sequence[int]) -> str:
    return ", ".join(str(row) for row in rows[:8]) + (", ..." if len(rows) > 8 else "")
