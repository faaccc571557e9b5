"""GLB: every part of the scene in world coordinates, with its materials and texture coordinates, through trimesh."""

from __future__ import annotations

import io
import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.exchange.mesh import FormatError, Mesh, narrowed, sound
from rbfevo.files import write_whole
from rbfevo.record import Array

NOTE = "GLB is written anew: parts, materials and texture coordinates are kept; the scene's tree and animations are not"


def read_glb(content: bytes) -> Mesh:
    """The parts of a GLB scene one after another.

    Raises:
        FormatError: if there are no points in it. What else is wrong, trimesh says with any exception.
    """
    import trimesh

    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene: Any = trimesh.load_scene(io.BytesIO(content), file_type="glb", process=False)
    parts: list[Any] = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        parts.append(scene.geometry[name].copy().apply_transform(transform))
    points = [np.asarray(part.vertices, np.float64).reshape(-1, 3) for part in parts]
    starts = np.cumsum([0, *map(len, points)])
    if starts[-1] == 0:
        raise FormatError("there are no points in it: empty or damaged")
    corners = [np.empty((0, 3), np.int64)]
    for part, start in zip(parts, starts, strict=False):
        faces = sound(np.asarray(getattr(part, "faces", []), np.int64).reshape(-1, 3), len(part.vertices))
        corners += [] if faces is None else [faces + start]
    triangles = np.concatenate(corners)

    def write(moved: Array, _: Array, out: Path) -> list[str]:
        narrowed(moved, np.dtype("f4"))
        deformed = trimesh.Scene()
        for number, (part, node) in enumerate(zip(parts, scene.graph.nodes_geometry, strict=True)):
            part.vertices = moved[starts[number] : starts[number + 1]]
            deformed.add_geometry(part, node_name=node, geom_name=f"{scene.graph[node][1]}")
        content: Any = deformed.export(file_type="glb")
        write_whole(out, content)
        return []

    return Mesh(np.concatenate(points), triangles if len(triangles) else None, None, 3, [NOTE], write)
