"""GLB: the parts of the scene in world coordinates, with materials and texture coordinates, through trimesh."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.files import write_whole
from rbfevo.meshes.mesh import Cells, FormatError, Mesh
from rbfevo.meshes.precision import narrowed

KEPT = "GLB is written anew: parts, materials and texture coordinates are kept; the scene's tree and animations are not"


def read_glb(content: bytes) -> Mesh:
    """The parts of a GLB scene one after another: by the number of their node in the file, then of their primitive.

    Patches are the nodes, by name.

    Raises:
        FormatError: if there are no points in it, or not all of its vertices are read. Other faults are trimesh's
            exceptions.
    """
    import trimesh

    scenery, numbered = _numbered(content)
    with _quiet():
        scene: Any = trimesh.load_scene(io.BytesIO(numbered), file_type="glb", process=False)
    order = {name: place for place, name in enumerate(scene.geometry)}
    found = []  # node, place of its primitive, its part in world coordinates
    for name in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[name]
        part = scene.geometry[geometry].copy().apply_transform(transform)
        found.append((int(str(name)[1:].split("_")[0]), order[geometry], geometry, part))
    found.sort(key=lambda entry: entry[:2])
    parts: list[Any] = [entry[3] for entry in found]
    points = [np.asarray(part.vertices, np.float64).reshape(-1, 3) for part in parts]
    starts = np.cumsum([0, *map(len, points)])
    announced = sum(_vertices(scenery, node) for node in sorted({entry[0] for entry in found}))
    if starts[-1] == 0:
        raise FormatError("it holds no points; is it empty or damaged?")
    if starts[-1] != announced:
        raise FormatError(f"only {starts[-1]} of its {announced} vertices can be read (is it compressed?)")

    blocks, patches, count = [], {}, 0
    for (node, *_), part, start in zip(found, parts, starts, strict=False):
        faces = np.asarray(getattr(part, "faces", []), np.int64).reshape(-1, 3)
        if faces.size and (faces.min() < 0 or faces.max() >= len(part.vertices)):
            raise FormatError("a face refers to a vertex that is not there")
        blocks.append((5, faces + start))
        patches.setdefault(_name(scenery, node), []).append(np.arange(count, count + len(faces)))
        count += len(faces)

    def write(moved: Array, _: Array, out: Path) -> list[str]:
        """Write the scene with moved points [n, 3], whole; return no notes."""
        narrowed(moved, np.dtype("f4"))
        deformed, names = trimesh.Scene(), [_name(scenery, entry[0]) for entry in found]
        for number, (node, _, geometry, part) in enumerate(found):
            part.vertices = moved[starts[number] : starts[number + 1]]
            name = _name(scenery, node)
            name = name if names.count(name) == 1 else f"{name}_{number}"
            deformed.add_geometry(part, node_name=name, geom_name=str(geometry))
        written: Any = deformed.export(file_type="glb")
        write_whole(out, written)
        return []

    return Mesh(
        np.concatenate(points),
        write,
        Cells.blocks(blocks),
        patches={name: np.concatenate(own) for name, own in patches.items()} if len(patches) > 1 else {},
        kept=[KEPT],
    )


def _numbered(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON of the file's scene, and the file with its nodes named by their numbers: names need not differ.

    Raises:
        FormatError: if it is no GLB file, or cut off.
    """
    if len(content) < 20 or content[:4] != b"glTF":
        raise FormatError("it does not begin as a GLB file")
    total, length = struct.unpack_from("<II", content, 8)
    if total > len(content):
        raise FormatError(f"cut off: it announces {total} bytes and has {len(content)}")
    scenery = json.loads(content[20 : 20 + length])
    nodes = [{**node, "name": f"n{number}"} for number, node in enumerate(scenery.get("nodes", []))]
    text = json.dumps({**scenery, "nodes": nodes}).encode()
    text += b" " * (-len(text) % 4)
    remaining = content[20 + length : total]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(remaining)) + struct.pack("<I4s", len(text), b"JSON")
    return scenery, head + text + remaining


def _name(scenery: dict[str, Any], node: int) -> str:
    return str(scenery["nodes"][node].get("name", f"node {node}"))


def _vertices(scenery: dict[str, Any], node: int) -> int:
    """How many vertices the primitives of a node's mesh announce."""
    primitives = scenery["meshes"][scenery["nodes"][node]["mesh"]]["primitives"]
    return sum(int(scenery["accessors"][primitive["attributes"]["POSITION"]]["count"]) for primitive in primitives)


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
