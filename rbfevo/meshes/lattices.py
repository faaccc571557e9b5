"""Lattices of free-form deformation in files of other programs: plot3d, SU2's settings and meshes, PyGeM, VTK."""

from __future__ import annotations

import configparser
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.files import refuse_missing
from rbfevo.meshes import ending_of, opened
from rbfevo.meshes.mesh import FormatError
from rbfevo.names import existing_home

ENDINGS = (".xyz", ".cfg", ".su2", ".prm", ".vts")


class LatticeFile(NamedTuple):
    """A lattice as a file has it, in its unit.

    Attributes:
        counts: control points along the axes, or None where the file does not say.
        places: [n_1, n_2, n_3, 3] the control points, or [2, 2, 2, 3] the corners of the box alone; float64, finite. Of
            a VTK file, which does not say how many there are along each axis, [n, 1, 1, 3], the first axis fastest.
    """

    counts: tuple[int, int, int] | None
    places: Array


def read_lattice(path: str | Path) -> LatticeFile:
    """Read the lattice in a file; its ending determines the format.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, or holds no lattice.
    """
    path = existing_home(path)
    refuse_missing(path)
    ending = ending_of(path)
    if ending not in ENDINGS:
        listed = ", ".join(known[1:] for known in ENDINGS)
        raise UserError(f"{path}: unknown ending '{ending}'; a lattice can be {listed}, or an export of rbfevo")
    try:
        if ending == ".vts":
            with opened(path) as mesh:
                found = LatticeFile(None, mesh.points[:, None, None, :])
        else:
            text = path.read_bytes().decode("utf-8", "replace")
            found = {".xyz": plot3d, ".cfg": su2, ".su2": su2_mesh, ".prm": pygem}[ending](text)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    except FormatError as error:
        raise UserError(f"{path}: not a readable lattice ({error})") from None
    if not np.isfinite(found.places).all():
        raise UserError(f"{path}: its lattice has coordinates that are not finite")
    return found


def plot3d(text: str) -> LatticeFile:
    """One block of plot3d's text format: their number, 1, the sizes, and all x, all y, all z, the first axis fastest.

    Raises:
        FormatError: if it is none.
    """
    numbers = _numbers(text.split())
    whole = [int(number) for number in numbers[:4] if number == int(number)]
    if len(whole) < 4 or whole[0] != 1 or min(whole[1:]) < 2:
        raise FormatError("it must begin with 1, for one block, and three sizes of at least 2")
    counts = whole[1], whole[2], whole[3]
    size = counts[0] * counts[1] * counts[2]
    if len(numbers) != 4 + 3 * size:
        raise FormatError(f"it has {len(numbers) - 4} coordinates, but {3 * size} belong to its sizes")
    axes = np.array(numbers[4:]).reshape(3, size)
    return LatticeFile(counts, np.stack([axis.reshape(counts, order="F") for axis in axes], axis=-1))


def su2(text: str) -> LatticeFile:
    """The one box of SU2's settings FFD_DEFINITION, in space, and its degrees.

    Raises:
        FormatError: if there is none, or more than one.
    """
    lines = [line.partition("%")[0] for line in text.splitlines()]
    settings = dict(re.findall(r"^\s*(FFD_\w+)\s*=\s*(.*?)\s*$", "\n".join(lines), re.MULTILINE))
    if "FFD_DEFINITION" not in settings:
        raise FormatError("it has no FFD_DEFINITION")
    _, *fields = re.split(r"[,\s]+", settings["FFD_DEFINITION"].strip("() \t"))
    if ";" in settings["FFD_DEFINITION"] or len(fields) != 24:
        raise FormatError("FFD_DEFINITION must hold one box, its name and the coordinates of eight corners")
    degrees = _numbers(re.split(r"[,\s]+", settings.get("FFD_DEGREE", "").strip("() \t")))
    return LatticeFile(_counts(degrees), _of_corners(np.array(_numbers(fields)).reshape(8, 3)))


def su2_mesh(text: str) -> LatticeFile:
    """The one box of an SU2 mesh, as SU2_DEF stores it: its degrees and corner points.

    Raises:
        FormatError: if there is none, or more than one.
    """
    lines = [line.partition("%")[0].strip() for line in text.splitlines()]
    tags = sum(line.replace(" ", "").startswith("FFD_TAG=") for line in lines)
    if tags != 1:
        raise FormatError(f"it has {tags} FFD boxes, and one is expected")
    degrees = [found[1] for found in re.finditer(r"^FFD_DEGREE_[IJK]\s*=\s*(\S+)$", "\n".join(lines), re.MULTILINE)]
    start = next((row for row, line in enumerate(lines) if re.match(r"FFD_CORNER_POINTS\s*=\s*8$", line)), None)
    if start is None:
        raise FormatError("its FFD box has no eight FFD_CORNER_POINTS")
    rows = [_numbers(line.split()) for line in lines[start + 1 : start + 9]]
    if [len(row) for row in rows] != [3] * 8:
        raise FormatError("each of FFD_CORNER_POINTS needs three coordinates")
    return LatticeFile(_counts(_numbers(degrees)), _of_corners(np.array(rows)))


def pygem(text: str) -> LatticeFile:
    """The box of PyGeM's parameters for free-form deformation; the movements of its control points are left out.

    Raises:
        FormatError: if it has none.
    """
    parser = configparser.RawConfigParser()
    try:
        parser.read_string(text)
        counts, sides, origin, angles = (
            [float(parser.get("Box info", f"{name} {letter}")) for letter in "xyz"]
            for name in ("n control points", "box length", "box origin", "rotation angle")
        )
    except (configparser.NoSectionError, configparser.NoOptionError) as error:
        raise FormatError(f"PyGeM's parameters for free-form deformation have a section [Box info]: {error}") from None
    except (configparser.Error, ValueError) as error:
        raise FormatError(" ".join(str(error).split())[:200]) from None
    turned = np.eye(3)
    for axis in range(3):  # about x first
        c, s = np.cos(np.radians(angles[axis])), np.sin(np.radians(angles[axis]))
        a, b = (axis + 1) % 3, (axis + 2) % 3
        own = np.eye(3)
        own[[a, a, b, b], [a, b, a, b]] = c, -s, s, c
        turned = own @ turned
    unit = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij"), axis=-1)
    return LatticeFile(_counts([count - 1.0 for count in counts]), np.array(origin) + (unit * sides) @ turned.T)


def _of_corners(corners: Array) -> Array:
    """The corners [2, 2, 2, 3] of eight in SU2's order."""
    places = np.empty((2, 2, 2, 3))
    i, j, k = [0, 1, 1, 0, 0, 1, 1, 0], [0, 0, 1, 1, 0, 0, 1, 1], [0, 0, 0, 0, 1, 1, 1, 1]
    places[i, j, k] = corners
    return places


def _counts(degrees: list[float]) -> tuple[int, int, int]:
    """Control points along the axes, of polynomials of three degrees."""
    if len(degrees) != 3 or any(degree != int(degree) or degree < 1 for degree in degrees):
        raise FormatError(f"three whole degrees of at least 1 are expected, not {degrees}")
    return int(degrees[0]) + 1, int(degrees[1]) + 1, int(degrees[2]) + 1


def _numbers(fields: list[str]) -> list[float]:
    try:
        return [float(field) for field in fields if field]
    except ValueError as error:
        raise FormatError(str(error)) from None
