"""Read PLY, OBJ, STL, OFF and GLB files with trimesh, so that points keep the file's order and count."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from rbfevo.scenarios.contents import Contents

ENDINGS = (".ply", ".obj", ".stl", ".off", ".glb")

_ANNOUNCED_FACES = {
    ".ply": re.compile(rb"^element\s+face\s+(\d+)\s*$", re.MULTILINE),
    ".off": re.compile(rb"^\s*(?:OFF\s+)?\d+[ \t]+(\d+)[ \t]+\d+\s*$", re.MULTILINE),
}
_CONTINUED = re.compile(rb"\\\r?\n")
_SHAPE_LINES = re.compile(rb"^[ \t]*[vf][ \t][^\r\n#]*", re.MULTILINE)
_SEAMS = re.compile(rb"/[^ \t]*")
_BACKWARDS = re.compile(rb"^f[^\n]* -", re.MULTILINE)


def read_mesh(content: bytes, ending: str) -> Contents:
    """Read the bytes of a file; polygons are cut into triangles, a scene's parts are put together.

    Arrays are the vertex properties of a PLY file beside its coordinates; the other formats have none.

    Raises:
        ValueError: or whatever else trimesh raises on a damaged file.
    """
    import trimesh

    options: dict[str, Any] = {}
    if ending == ".obj":
        # Without its textures, groups and materials, trimesh neither splits nor drops vertices.
        content, options = _shape_of_obj(content), {"skip_materials": True, "maintain_order": True}
    elif ending == ".glb":
        options = {"skip_materials": True}
    elif ending == ".ply":
        options = {"fix_texture": False, "skip_materials": True}  # else vertices are split along the texture's seams
    with _quiet():
        loaded: Any = trimesh.load(io.BytesIO(content), file_type=ending[1:], process=False, **options)
        parts = [loaded]
        if isinstance(loaded, trimesh.Scene):
            parts = []
            for node in loaded.graph.nodes_geometry:
                transform, name = loaded.graph[node]
                parts.append(loaded.geometry[name].copy().apply_transform(transform))

        points, triangles, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
        for part in parts:
            vertices = np.asarray(part.vertices, np.float64).reshape(-1, 3)
            faces = np.asarray(getattr(part, "faces", []), np.int64).reshape(-1, 3)
            if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
                raise ValueError("a face refers to a vertex that is not there")
            points.append(vertices)
            triangles.append(faces + count)
            count += len(vertices)
        joined = np.concatenate(triangles)
        announced = _ANNOUNCED_FACES[ending].search(content) if ending in _ANNOUNCED_FACES else None
        if announced and len(joined) < int(announced[1]):  # a polygon gives at least one triangle
            raise ValueError(f"cut off: it announces {int(announced[1])} faces and has {len(joined)} triangles")
        elements = loaded.metadata.get("_ply_raw", {}) if ending == ".ply" else {}
        arrays = _properties(elements.get("vertex", {}), count)
        cell_arrays = tuple(_columns(elements.get("face", {})))
    return Contents(np.concatenate(points), joined if len(joined) else None, arrays, cell_arrays)


def _shape_of_obj(content: bytes) -> bytes:
    """Only the vertices and faces of an OBJ file, faces by vertices only."""
    lines = [line.strip() for line in _SHAPE_LINES.findall(_CONTINUED.sub(b" ", content))]
    faces = [k for k, line in enumerate(lines) if line[:1] == b"f"]
    text = b"\n".join(lines) + b"\n"
    if faces and any(line[:1] == b"v" for line in lines[faces[0] :]) and _BACKWARDS.search(text):
        raise ValueError("faces count vertices backwards (negative numbers) between the vertices; number them from 1")
    return _SEAMS.sub(b"", text)


def _properties(element: dict[str, Any], n: int) -> dict[str, np.ndarray]:
    """The numeric properties of a PLY element but for the coordinates, [n] or, of a list, [n, c]."""
    arrays = {}
    for name in _columns(element):
        if name in ("x", "y", "z"):
            continue
        values = np.asarray(element["data"][name])
        if values.dtype.kind in "fiub" and len(values) == n and values.size:
            values = values.astype(np.float64).reshape(n, -1)
            arrays[name] = values[:, 0] if values.shape[1] == 1 else values
    return arrays


def _columns(element: dict[str, Any]) -> list[str]:
    """Names of an element's properties that are no lists (as the vertices of a face are)."""
    kinds, values = element.get("properties", {}), element.get("data")
    if values is None:
        return []
    there = values if isinstance(values, dict) else (values.dtype.names or ())
    return [str(name) for name, kind in kinds.items() if name in there and "," not in str(kind)]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep trimesh from warning and logging about a file whose faults are reported in one line."""
    log = logging.getLogger("trimesh")  # its modules' loggers take their level from it
    level = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with np.errstate(all="ignore"):
                yield
    finally:
        log.setLevel(level)
