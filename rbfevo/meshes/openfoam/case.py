"""The directories of an OpenFOAM case: which time is meant, and where its mesh and its fields are."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

from rbfevo.errors import UserError
from rbfevo.meshes.openfoam import lists

MESH = Path("constant/polyMesh")
FIELD = re.compile(r"(?:point|face)Sens(?:NormalVec|Normal|Vec).*|smoothedSurfaceSens.*")


@dataclasses.dataclass(frozen=True)
class Case:
    """A case and the time that is looked at.

    Attributes:
        root: its directory; time: the name of the time's directory, or None: the mesh in `constant`.
        chosen: whether the time was asked for.
    """

    root: Path
    time: str | None
    chosen: bool

    def instance(self, name: str) -> Path:
        """Where a part of the mesh (`points`, `faces`, ...) is: of the newest time up to the case's, or constant."""
        if self.time is not None:
            for time in reversed(times(self.root)):
                path = self.root / time / "polyMesh" / name
                if float(time) <= float(self.time) and lists.exists(path):
                    return path
        return self.root / MESH / name

    def fields(self) -> dict[str, Path]:
        """The sensitivities in the directory of the time, by name."""
        return {} if self.time is None else fields_of(self.root / self.time)


def case_of(path: Path) -> Case | None:
    """The case that a directory is, or a time of which it is, or its `constant`; None where it is none of them.

    Without a time it is the newest one with sensitivities, else the newest with a mesh of its own, else none; so it is
    with CASE/constant.

    Raises:
        UserError: if the case is decomposed and what is needed has not been reconstructed, or there is no such time.
    """
    root, time = path, None
    if path.name == MESH.parent.name and not _is_case(path) and _is_case(path.parent):
        return Case(path.parent, None, chosen=True) if lists.exists(path / MESH.name / "points") else None
    if not _is_case(path) and _seconds(path.name) is not None and _is_case(path.parent):
        root, time = path.parent, path.name
    if not _is_case(root):
        return None
    parts = [one for one in sorted(root.glob("processor*")) if one.is_dir()]
    if not (lists.exists(root / MESH / "points") and lists.exists(root / MESH / "faces")):
        if parts:
            raise UserError(f"{root} is decomposed into {len(parts)} parts; run reconstructParMesh -constant first")
        return None
    if time is not None:
        if not (root / time).is_dir() and _seconds(time) != 0.0:
            raise UserError(f"{root} has no time {time}; there are {', '.join(times(root)) or 'none'}")
        return Case(root, time, chosen=True)
    named = times(root)
    with_fields = [one for one in named if fields_of(root / one)]
    apart = sorted({one for part in parts for one in times(part) if fields_of(part / one)}, key=float)
    if apart and (not with_fields or float(apart[-1]) > float(with_fields[-1])):
        raise UserError(
            f"{root}: the sensitivities of time {apart[-1]} are decomposed; run reconstructPar -time {apart[-1]}"
        )
    with_mesh = [one for one in named if lists.exists(root / one / "polyMesh" / "points")]
    found = with_fields or with_mesh
    return Case(root, found[-1] if found else None, chosen=False)


def times(root: Path) -> list[str]:
    """The names of a case's time directories, by time."""
    try:
        found = [one.name for one in root.iterdir() if _seconds(one.name) is not None and one.is_dir()]
    except OSError:
        return []
    return sorted(found, key=float)


def fields_of(directory: Path) -> dict[str, Path]:
    """The files with sensitivities in a time's directory, by the field's name."""
    found = {}
    for path in sorted(directory.iterdir()) if directory.is_dir() else []:
        name = path.name.removesuffix(".gz")
        if FIELD.fullmatch(name) and path.is_file():
            found[name] = directory / name
    return found


def is_time(path: Path) -> bool:
    """Whether a directory's name is a time."""
    return _seconds(path.name) is not None


def _is_case(path: Path) -> bool:
    if not path.is_dir():
        return False
    return (path / MESH).is_dir() or (path / "processor0").is_dir() or (path / "system" / "controlDict").is_file()


def _seconds(name: str) -> float | None:
    """The time that a directory's name is; None for other names."""
    return float(name) if re.fullmatch(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?", name) else None
