"""Read a user's surface or point cloud from a file; whatever is wrong with it is said in one line."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from rbfevo.errors import UserError
from rbfevo.files import refuse_missing
from rbfevo.names import existing_home
from rbfevo.scenarios import cells, separate, trimesh_files
from rbfevo.scenarios.contents import Contents, Points, Triangles
from rbfevo.scenarios.tables import read_table

_VTK = (".vtk", ".vtp", ".vtu")
_TABLES = (".xyz", ".csv")
ENDINGS = trimesh_files.ENDINGS + _VTK + _TABLES


def read_surface(path: str | Path) -> tuple[Points, Triangles | None]:
    """Read vertices [n, 3] float64 and triangles [f, 3] int64, or None for a bare cloud, in the file's own units.

    The ending says the format: PLY, OBJ, STL, OFF, GLB (a scene's parts are put together), VTK, VTP, VTU and what
    meshio reads (Gmsh, Abaqus, Nastran, SU2 ...) hold meshes (polygons are cut into triangles) or, without faces,
    clouds; XYZ and CSV hold clouds, one point a line, with or without a header, separated by comma, semicolon (then a
    decimal comma is understood) or space. Vertices keep the file's order; STL repeats a vertex for each of its
    triangles.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, or holds no usable surface or cloud.
    """
    path = existing_home(path)
    contents = read_contents(path)
    _check(path, contents.points, contents.triangles)
    return contents.points, contents.triangles


def read_contents(path: Path) -> Contents:
    """Read all that `read_surface` and `templates.read_template` take from a file; its numbers are not yet checked.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, or holds a volume mesh.
    """
    refuse_missing(path)
    if path.is_dir():
        raise UserError(f"{path}: is a directory, not a mesh or scan; give a file ({_listed(ENDINGS)})")
    ending = _ending(path)
    try:
        blank = _is_blank(path)
        content = b"" if ending not in trimesh_files.ENDINGS + _TABLES else path.read_bytes()
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({_first_line(error)})") from None
    if blank:
        raise UserError(f"{path}: the file is empty")

    try:
        if ending in _TABLES:
            return Contents(_cloud(content), None)
        if ending in trimesh_files.ENDINGS:
            return _read_mesh(path, content, ending)
        return _read_apart("vtk_files" if ending in _VTK else "meshio_files", path, ending)
    except UserError:
        raise
    except Exception as error:  # loaders raise whatever they like on a damaged file
        raise UserError(f"{path}: not a readable {ending[1:].upper()} file ({_first_line(error)})") from None


@functools.cache
def meshio_endings() -> tuple[str, ...]:
    """Return the endings of meshio's own table that meshio is asked to read."""
    import meshio

    others = {ending for ending, formats in meshio.extension_to_filetypes.items() if formats != ["svg"]}  # written only
    return tuple(sorted(others - set(ENDINGS)))


def _ending(path: Path) -> str:
    name = path.name.lower()
    if path.suffix.lower() in ENDINGS:
        return path.suffix.lower()
    known = [ending for ending in meshio_endings() if name.endswith(ending)]
    if not known:
        raise UserError(
            f"{path}: unknown ending '{path.suffix.lower()}'; a surface or cloud can be {_listed(ENDINGS)}, "
            f"or, read by meshio, {_listed(meshio_endings())}"
        )
    return max(known, key=len)  # .vol.gz has two dots


def _is_blank(path: Path) -> bool:
    with path.open("rb") as file:
        while block := file.read(1 << 16):
            if block.strip():
                return False
    return True


def _read_mesh(path: Path, content: bytes, ending: str) -> Contents:
    try:
        return trimesh_files.read_mesh(content, ending)
    except Exception as error:
        # trimesh knows no binary PLY with triangles and quads, and no OFF with these and larger polygons.
        if ending == ".ply" and "unexpected length" in str(error):
            return _read_apart("meshio_files", path, ending)
        if ending == ".off" and isinstance(error, TypeError):
            return _read_apart("vtk_files", path, ending)
        raise


def _read_apart(reader: str, path: Path, ending: str) -> Contents:
    found = separate.read(reader, path, ending)
    points = found["points"]
    triangles, notes = cells.triangles(path, len(points), found["kinds"], found["sizes"], found["corners"])
    notes |= {"format": "; ".join(found["notes"])} if found["notes"] else {}
    return Contents(points, triangles if len(triangles) else None, found["arrays"], tuple(found["cell_arrays"]), notes)


def _cloud(content: bytes) -> Points:
    table = read_table(content, looked_at=3, counted=True)
    columns = (0, 1, 2)
    if table.header is not None and {"x", "y", "z"} <= set(table.header):
        columns = (table.header.index("x"), table.header.index("y"), table.header.index("z"))
    return table.numbers(columns)


def _check(path: Path, vertices: Points, triangles: Triangles | None) -> None:
    n = len(vertices)
    if n == 0:
        raise UserError(f"{path}: empty or damaged, there are no vertices in it")
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise UserError(f"{path}: {bad} of {n} vertices have coordinates that are not finite (NaN or infinite)")
    if n == 1:
        raise UserError(f"{path}: there is only one point; a surface or cloud needs more")
    extent = checked_extent(path, vertices)
    if triangles is None:
        return
    if triangles.min() < 0 or triangles.max() >= n:
        wrong = int(triangles.min() if triangles.min() < 0 else triangles.max())
        raise UserError(f"{path}: a face refers to vertex {wrong} (from 0), but there are {n} vertices")
    a, b, c = np.moveaxis((vertices / extent)[triangles], 1, 0)
    if np.abs(np.cross(b - a, c - a)).max() < 1e-14:
        raise UserError(f"{path}: none of its {len(triangles)} triangles has any area")


def checked_extent(path: Path | str, vertices: Points) -> float:
    """Return the longest side of the box of finite vertices [n, 3]; UserError if it is beyond what can be squared."""
    largest = np.abs(vertices).max()
    if largest > 1e100:
        raise UserError(f"{path}: a coordinate is as large as {largest:.1e}; check the file's units")
    extent = float(np.ptp(vertices, axis=0).max())
    if extent < 1e-100:
        raise UserError(f"{path}: all {len(vertices)} points coincide at {tuple(vertices[0].tolist())}")
    return extent


def _listed(endings: tuple[str, ...]) -> str:
    return ", ".join(ending[1:].upper() for ending in endings)


def _first_line(error: BaseException) -> str:
    message = str(error).strip().splitlines()
    return (message[0].strip() if message else "")[:160] or type(error).__name__
