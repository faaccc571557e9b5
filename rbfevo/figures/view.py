"""The view that all 3-D panels of a picture share: orthographic, the same scale everywhere, mostly from the front."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.figures.local_error import local_error
from rbfevo.recorded.record import Record

FRONT = np.array([0.0, 0.10, 1.0])  # towards the camera: +z is the front, +y is up, from a little above
UP = np.array([0.0, 1.0, 0.0])
FLATTEST = 0.65  # the least height of a panel over its width


class View(NamedTuple):
    """An orthographic camera: unit vectors right, up and towards it, its focus (all [3]), half its side.

    `tall` is half the height of the shown points, at most `half`.
    """

    right: Array
    up: Array
    towards: Array
    focus: Array
    half: float
    tall: float

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return where points [q, 3] stand in the picture [q, 2] and how near they are [q], larger being nearer."""
        moved = points - self.focus
        return np.stack([moved @ self.right, moved @ self.up], axis=1), moved @ self.towards


def view_of(points: Array, margin: float, front: Array = FRONT, upward: Array = UP) -> View:
    """Return the view that shows all of `points` [q, 3] with `margin`, in their unit, around them.

    The camera stands where `front` [3] points, and `upward` [3] is up in the picture.
    """
    towards = front / np.linalg.norm(front)
    right = np.cross(upward, towards)
    right /= np.linalg.norm(right)
    up = np.cross(towards, right)
    axes = np.stack([right, up, towards])
    seen = points @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    wide, tall = ((high - low)[:2] / 2 + margin).tolist()
    half = max(wide, tall)
    return View(right, up, towards, (low + high) / 2 @ axes, half, max(tall, FLATTEST * half))


def standpoint(record: Record) -> tuple[Array, Array]:
    """Where the camera stands, and what is up [3]: before a face, or where most of the wanted displacement shows.

    The run of a mesh names the axis that is up. The camera stands a little above one of its four corners, and straight
    before the plane of a curve.
    """
    if record.summary.get("scenario") != "mesh":
        return FRONT, UP
    plane = record.summary.get("planar")
    if plane is not None and not len(record.faces):
        across = "xyz".index(plane["axis"])
        return np.eye(3)[across], np.eye(3)[(across + 2) % 3]
    axis = "xyz".find(str(record.summary.get("up", "z"))[:1])
    upward = np.eye(3)[axis]
    flat = [other for other in range(3) if other != axis]
    a, b, c = np.moveaxis(record.vertices[record.faces], 1, 0)
    normals = np.cross(b - a, c - a)  # twice the area long
    wanted = local_error(record.gradient)[record.faces].mean(axis=1)
    corners = []
    for x, y in ((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)):
        corner = 0.55 * upward
        corner[flat] = 0.75 * x, 1.0 * y
        corners.append(corner)
    shown = [float((wanted * np.maximum(normals @ corner, 0.0)).sum()) for corner in corners]
    best = max(shown)
    return next(corner for corner, much in zip(corners, shown, strict=True) if much >= best * (1 - 1e-6)), upward


def hidden(points: Array, vertices: Array, faces: Array, view: View) -> Array:
    """Return which of `points` [q, 3] stand behind the surface `vertices` [n, 3], `faces` [f, 3], as [q] bool."""
    flat, near = view.project(vertices)
    corners, depths = flat[faces], near[faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    behind = np.zeros(len(points), dtype=bool)
    for i, (place, nearness) in enumerate(zip(*view.project(points), strict=True)):
        c = place - corners[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):  # a face seen edge-on covers nothing
            s = (c[:, 0] * b[:, 1] - c[:, 1] * b[:, 0]) / area
            t = (a[:, 0] * c[:, 1] - a[:, 1] * c[:, 0]) / area
        over = (s >= 0) & (t >= 0) & (s + t <= 1)
        height = (1 - s[over] - t[over]) * depths[over, 0] + s[over] * depths[over, 1] + t[over] * depths[over, 2]
        behind[i] = bool((height > nearness).any())
    return behind
