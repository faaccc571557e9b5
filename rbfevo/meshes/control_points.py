"""Control points from a file: CSV and other tables, VTK, PyGeM's RBF parameters, or what `rbfevo.export` has written.

PyGeM is the package of mathLab for morphing (pygem.readthedocs.io); PyPI's `pygem` is a model of glaciers.
"""

from __future__ import annotations

import configparser
import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.files import refuse_missing
from rbfevo.meshes import ending_of, opened, refuse_bad_points
from rbfevo.meshes.columns import recognized
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.text_table import TextTable, read_table
from rbfevo.names import existing_home

TABLES = (".csv", ".txt", ".tsv", ".xyz")
POINTS = (".vtp", ".vtk", ".vtu", ".ply")
PARAMETERS = ".prm"
EXPORTED = ("centers.csv", "centers.vtp")  # of `rbfevo.export`, the first that is there is read
SECTION, ORIGINAL = "Control points", "original control points"


@dataclasses.dataclass(frozen=True)
class ControlPoints:
    """Control points as a file has them, in its order and unit.

    Attributes:
        points: [q, a] float64, finite; axes: which coordinate (0, 1, 2) each column is, ascending.
        mirrored: [q] bool, those that the file calls mirror images of others; None where it does not say.
        notes: a line each for what was accepted but is worth knowing.
    """

    points: Array
    axes: tuple[int, ...]
    mirrored: NDArray[np.bool_] | None = None
    notes: tuple[str, ...] = ()


def read_control_points(path: str | Path) -> ControlPoints:
    """Read the control points in a file, or in a directory that `rbfevo.export` has written.

    The ending determines the format. A table has columns x, y and z, or two of them, by its header or else in this
    order; its column `mirrored`, and the array of this name of a VTK file, is 1 for mirror images. Of PyGeM's
    parameters the undeformed control points are taken.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, has no points, or some are not finite.
    """
    path = existing_home(path)
    if path.is_dir():
        path = _exported(path)
    refuse_missing(path)
    ending = ending_of(path)
    if ending in POINTS:
        found = _of_mesh(path)
    elif ending in (*TABLES, PARAMETERS):
        found = _of_text(path, ending)
    else:
        endings = ", ".join(known[1:].upper() for known in (*TABLES, *POINTS, PARAMETERS))
        raise UserError(f"{path}: unknown ending '{ending}'; control points can be {endings}, or an export of rbfevo")
    if not len(found.points):
        raise UserError(f"{path}: there are no control points in it")
    refuse_bad_points(path, found.points)
    return found


def _exported(directory: Path) -> Path:
    """The file with the control points of an export.

    Raises:
        UserError: if the directory is none.
    """
    for name in EXPORTED:
        if (directory / name).is_file():
            return directory / name
    if (directory / "setups.npz").is_file():
        raise UserError(
            f"{directory}: this is a run, with many setups; export one: python -m rbfevo.export {directory} --pick knee"
        )
    raise UserError(f"{directory}: this directory has no {EXPORTED[0]}, so it is no export of rbfevo; give a file")


def _of_mesh(path: Path) -> ControlPoints:
    with opened(path) as mesh:
        flags = mesh.arrays.get("mirrored")
        flags = None if flags is None or flags.ndim != 1 else flags != 0
        return ControlPoints(mesh.points, (0, 1, 2), flags)


def _of_text(path: Path, ending: str) -> ControlPoints:
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if not content.strip():
        raise UserError(f"{path}: the file is empty")
    try:
        return parameters(content) if ending == PARAMETERS else of_table(read_table(content))
    except FormatError as error:
        kind = "parameter file of PyGeM" if ending == PARAMETERS else "table of control points"
        raise UserError(f"{path}: not a readable {kind} ({error})") from None


def of_table(table: TextTable) -> ControlPoints:
    """The control points of a table.

    Raises:
        FormatError: if it is not clear which columns are coordinates, or a field of these is no number.
    """
    if table.header is None:
        if table.width not in (2, 3):
            raise FormatError(
                f"it has {table.width} columns and no header; give it two or three, or a header such as center,x,y,z"
            )
        return ControlPoints(table.numbers(), tuple(range(table.width)), None, tuple(table.notes))
    names = [name.strip().lower() for name in table.header]
    coordinates = recognized(table.header).coordinates
    if len(coordinates) < 2:
        raise FormatError(f"its header, {', '.join(table.header)[:80]}, does not name x, y and z, or two of them")
    axes = tuple(sorted(coordinates))
    flags = table.numbers([names.index("mirrored")])[:, 0] if "mirrored" in names else None
    if flags is not None and not np.isin(flags, (0.0, 1.0)).all():
        raise FormatError("its column mirrored must hold 0 or 1")
    points = table.numbers([coordinates[axis] for axis in axes])
    return ControlPoints(points, axes, None if flags is None else flags == 1.0, tuple(table.notes))


def parameters(content: bytes) -> ControlPoints:
    """The undeformed control points of PyGeM's parameters for RBFs (.prm).

    Raises:
        FormatError: if the text is none, or a point has no three coordinates.
    """
    parser = configparser.RawConfigParser()
    try:
        parser.read_string(content.decode())
        text = parser.get(SECTION, ORIGINAL)
    except (configparser.NoSectionError, configparser.NoOptionError):
        raise FormatError(
            f"it has no '{ORIGINAL}' in a section [{SECTION}], as PyGeM's parameters for RBFs have; those for "
            "free-form deformation have none"
        ) from None
    except (configparser.Error, UnicodeDecodeError) as error:
        raise FormatError(" ".join(str(error).split())[:200]) from None
    rows = [line.split() for line in text.splitlines() if line.strip()]
    wrong = next((row for row in rows if len(row) != 3), None)
    if wrong is not None:
        raise FormatError(f"a point needs three coordinates, not '{' '.join(wrong)[:60]}'")
    try:
        points = np.array([[float(number) for number in row] for row in rows]).reshape(-1, 3)
    except ValueError as error:
        raise FormatError(str(error)) from None
    return ControlPoints(points, (0, 1, 2))
