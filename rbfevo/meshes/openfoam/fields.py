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
_UNIFORM = re.compile(rb"uniform\s+(\([^)]*\)|[^\s;]+)")
_KEY = re.compile(rb'"[^"]*"|[^\s{}();"]+')
_COMPONENTS = {b"vector": 3, b"symmTensor": 6, b"tensor": 9}


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
    at = _opened(file, _after(file, file.start, b"boundaryField"))
    found: dict[str, Array] = {}
    while not _closes(file, at):
        key = _KEY.match(file.content, lists.skip(file, at))
        if key is None:
            raise FormatError(f"{file.name} is cut off: boundaryField does not end")
        at = _opened(file, key.end())
        name = key[0].decode("utf-8", "replace")
        fitting = _patches(name, sizes)
        while not _closes(file, at):
            at = _entry(file, at, width, fitting, sizes, found)
        at = lists.skip(file, at) + 1
    return found


def _patches(key: str, sizes: dict[str, int]) -> list[str]:
    """The patches that a key of boundaryField is for: in quotes it is a pattern."""
    if not key.startswith('"'):
        return [key] if key in sizes else []
    try:
        return [name for name in sizes if re.fullmatch(key[1:-1], name)]
    except re.error:
        return []


def _entry(file: File, at: int, width: int, patches: list[str], sizes: dict[str, int], found: dict[str, Array]) -> int:
    """Take an entry of a patch, and return where it ends: its values, where it has that name."""
    key = _KEY.match(file.content, lists.skip(file, at))
    if key is None:
        raise FormatError(f"{file.name} is cut off: a patch of boundaryField does not end")
    at = lists.skip(file, key.end())
    if key[0] == b"value":
        end = _past(file, at)
        for name in patches:
            found[name], end = _values(file, at, width, sizes[name])
        at = end
    else:
        at = _past(file, at)
    at = lists.skip(file, at)
    if file.content[at : at + 1] != b";":
        raise FormatError(f"{file.name}: an entry does not end with a semicolon")
    return at + 1


def _past(file: File, at: int) -> int:
    """Where the value of an entry ends that is not needed."""
    listed = _LIST.match(file.content, at)
    if listed is not None:
        return lists.reals(file, listed.end(), _COMPONENTS.get(listed[1], 1))[1]
    end = file.content.find(b";", at)
    return len(file.content) if end < 0 else end


def _opened(file: File, at: int) -> int:
    at = lists.skip(file, at)
    if file.content[at : at + 1] != b"{":
        raise FormatError(f"{file.name}: a bracket is expected, not {file.content[at : at + 40].decode('latin-1')!r}")
    return at + 1


def _closes(file: File, at: int) -> bool:
    at = lists.skip(file, at)
    return file.content[at : at + 1] == b"}"


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
