"""Read a user's surface or point cloud from a file; whatever is wrong with it is said in one line."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rbfevo.errors import UserError
from rbfevo.scenarios.vtk_files import read_vtk

Points = NDArray[np.float64]
Triangles = NDArray[np.int64]

_MESHES = (".ply", ".obj", ".stl", ".off", ".glb")
_VTK = (".vtk", ".vtp")
_TABLES = (".xyz", ".csv")
_ANNOUNCED_FACES = {
    ".ply": re.compile(rb"^element\s+face\s+(\d+)\s*$", re.MULTILINE),
    ".off": re.compile(rb"^\s*(?:OFF\s+)?\d+[ \t]+(\d+)[ \t]+\d+\s*$", re.MULTILINE),
}
ENDINGS = _MESHES + _VTK + _TABLES


def read_surface(path: str | Path) -> tuple[Points, Triangles | None]:
    """Read vertices [n, 3] float64 and triangles [f, 3] int64, or None for a bare cloud, in the file's own units.

    The ending says the format: PLY, OBJ, STL, OFF, GLB (a scene's parts are put together), VTK and VTP hold meshes
    (polygons are cut into triangles) or, without faces, clouds; XYZ and CSV hold clouds, one point a line, with or
    without a header, separated by comma, semicolon (then a decimal comma is understood) or space. Vertices keep the
    file's order where it has one; STL repeats a vertex for each of its triangles.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, or holds no usable surface or cloud.
    """
    path = Path(path).expanduser()
    ending = path.suffix.lower()
    if path.is_dir():
        raise UserError(f"{path}: is a directory, not a scan; give a file ({_listed()})")
    if ending not in ENDINGS:
        raise UserError(f"{path}: unknown ending '{ending}'; a surface or cloud can be {_listed()}")
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({_first_line(error)})") from None
    if not content.strip():
        raise UserError(f"{path}: the file is empty")

    try:
        with _quiet():
            if ending in _VTK:
                vertices, triangles = read_vtk(content, ending)
            elif ending in _TABLES:
                vertices, triangles = _read_table(content), None
            else:
                vertices, triangles = _read_mesh(content, ending)
    except Exception as error:  # loaders raise whatever they like on a damaged file
        raise UserError(f"{path}: not a readable {ending[1:].upper()} file ({_first_line(error)})") from None
    _check(path, vertices, triangles)
    return vertices, triangles


def _check(path: Path, vertices: Points, triangles: Triangles | None) -> None:
    n = len(vertices)
    if n == 0:
        raise UserError(f"{path}: empty or damaged, there are no vertices in it")
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise UserError(f"{path}: {bad} of {n} vertices have coordinates that are not finite (NaN or infinite)")
    if n == 1:
        raise UserError(f"{path}: there is only one point; a surface or cloud needs more")
    if np.abs(vertices).max() > 1e100:
        raise UserError(f"{path}: a coordinate is as large as {np.abs(vertices).max():.1e}; check the file's units")
    extent = np.ptp(vertices, axis=0).max()
    if extent < 1e-100:
        raise UserError(f"{path}: all {n} points coincide at {tuple(vertices[0].tolist())}")
    if triangles is None:
        return
    if triangles.min() < 0 or triangles.max() >= n:
        wrong = int(triangles.min() if triangles.min() < 0 else triangles.max())
        raise UserError(f"{path}: a face refers to vertex {wrong} (from 0), but there are {n} vertices")
    a, b, c = np.moveaxis((vertices / extent)[triangles], 1, 0)
    if np.abs(np.cross(b - a, c - a)).max() < 1e-14:
        raise UserError(f"{path}: none of its {len(triangles)} triangles has any area")


def _read_mesh(content: bytes, ending: str) -> tuple[Points, Triangles | None]:
    import trimesh

    options: dict[str, Any] = {"skip_materials": True} if ending in (".obj", ".glb") else {}
    if ending == ".obj":
        options["maintain_order"] = True  # else vertices are split along the seams of the texture
    loaded: Any = trimesh.load(io.BytesIO(content), file_type=ending[1:], process=False, **options)
    parts = []
    if isinstance(loaded, trimesh.Scene):
        for node in loaded.graph.nodes_geometry:
            transform, name = loaded.graph[node]
            part = loaded.geometry[name].copy()
            parts.append(part.apply_transform(transform))
    else:
        parts.append(loaded)

    vertices, triangles, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for part in parts:
        points = np.asarray(part.vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(getattr(part, "faces", []), np.int64).reshape(-1, 3)
        if faces.size and (faces.min() < 0 or faces.max() >= len(points)):
            raise ValueError("a face refers to a vertex that is not there")
        vertices.append(points)
        triangles.append(faces + count)
        count += len(points)
    joined = np.concatenate(triangles)
    announced = _ANNOUNCED_FACES[ending].search(content) if ending in _ANNOUNCED_FACES else None
    if announced and len(joined) < int(announced[1]):  # a polygon gives at least one triangle
        raise ValueError(f"cut off: it announces {int(announced[1])} faces and has {len(joined)} triangles")
    return np.concatenate(vertices), joined if len(joined) else None


def _read_table(content: bytes) -> Points:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    rows = [row.strip() for row in text.splitlines()]
    rows = [row for row in rows if row and not row.startswith(("#", "//"))]
    if rows and rows[0].isdigit():  # some writers begin with the number of points
        rows = rows[1:]
    if not rows:
        raise ValueError("no lines with points in it")
    delimiter = ";" if ";" in rows[0] else "," if "," in rows[0] else None
    if delimiter == ";":
        rows = [row.replace(",", ".") for row in rows]

    columns, first = (0, 1, 2), [field.strip().strip("\"'").lower() for field in rows[0].split(delimiter)]
    if not all(_is_number(field) for field in first[:3]):
        if {"x", "y", "z"} <= set(first):
            columns = (first.index("x"), first.index("y"), first.index("z"))
        rows = rows[1:]
        if not rows:
            raise ValueError("a header, but no lines with points")
    return np.loadtxt(
        rows, dtype=np.float64, delimiter=delimiter, usecols=columns, ndmin=2, comments=None, quotechar='"'
    )


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _listed() -> str:
    return ", ".join(ending[1:].upper() for ending in ENDINGS)


def _first_line(error: BaseException) -> str:
    message = str(error).strip().splitlines()
    return (message[0].strip() if message else "")[:160] or type(error).__name__


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep loaders from warning and logging about a file whose faults are reported as a UserError."""
    log = logging.getLogger("trimesh")
    disabled, log.disabled = log.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with np.errstate(all="ignore"):
                yield
    finally:
        log.disabled = disabled
