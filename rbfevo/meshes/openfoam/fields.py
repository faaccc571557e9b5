"""Fields of a case: values of all points, or of the faces of its patches."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rbfevo.arrays import Array
from rbfevo.meshes.mesh import FormatError
from rbfevo.meshes.openfoam import lists
from rbfevo.meshes.openfoam.lists import File

WIDTHS = {"pointScalarField": 1, "volScalarField": 1, "pointVectorField": 3, "volVectorField": 3}
_LIST = re.compile(rb"nonuniform\s+List<(\w+)>\s*")
_UNIFORM = re.compile(rb"uniform\s+(\([^)]*\)|[^\s;]+)\s*;")


def point_field(path: Path, count: int) -> Array:
    """The values [count] or [count, 3] of a field of the points.

    Raises:
        OSError: if it cannot be read.
        FormatError: if it is damaged or has another number of points.
    """
    file = lists.read(path)
    width = _width(file)
    start = _after(file, file.start, b"internalField")
    values, _ = _values(file, start, width, count)
    return values


def patch_fields(path: Path, sizes: dict[str, int]) -> dict[str, Array]:
    """The values [f] or [f, 3] on the faces of each patch where a volume field has some, by the patch's name.

    Args:
        sizes: faces of each patch.

    Raises:
        OSError: if it cannot be read.
        FormatError: if it is damaged, or does not fit the patches.
    """
    file = lists.read(path)
    width = _width(file)
    at = _after(file, file.start, b"boundaryField")
    found = {}
    for name, size in sizes.items():
        block = re.compile(rb'(?:\A|[\s{};])"?' + re.escape(name.encode()) + rb'"?\s*\{').search(file.content, at)
        if block is None:
            continue
        place = re.compile(rb"\bvalue\s+|\}").search(file.content, block.end())
        if place is None or place[0] == b"}":
            continue
        found[name], at = _values(file, place.end(), width, size)
    return found


def _width(file: File) -> int:
    if file.kind not in WIDTHS:
        raise FormatError(f"{file.name} is of the class {file.kind}; a field of scalars or vectors is expected")
    return WIDTHS[file.kind]


def _after(file: File, at: int, word: bytes) -> int:
    found = re.compile(rb"\b" + word + rb"\b\s*").search(file.content, at)
    if found is None:
        raise FormatError(f"{file.name} has no {word.decode()}")
    return found.end()


def _values(file: File, at: int, width: int, count: int) -> tuple[Array, int]:
    """The values [count] or [count, 3] that begin at a place, and where they end."""
    at = lists.skip(file, at)
    uniform = _UNIFORM.match(file.content, at)
    if uniform is not None:
        entry = np.array(uniform[1].translate(None, b"()").split(), np.float64)
        if len(entry) != width:
            raise FormatError(f"{file.name}: a value has {len(entry)} components, not {width}")
        return np.tile(entry, (count, 1)) if width > 1 else np.repeat(entry, count), uniform.end()
    listed = _LIST.match(file.content, at)
    if listed is None:
        raise FormatError(f"{file.name}: {file.content[at : at + 40].decode('latin-1')!r} is no list of values")
    values, end = lists.reals(file, listed.end(), width)
    if len(values) != count:
        raise FormatError(f"{file.name} has {len(values)} values, but there are {count}: of another mesh?")
    return values, end
