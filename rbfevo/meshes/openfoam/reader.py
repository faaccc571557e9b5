"""A case as a mesh: polyhedra, the faces of its patches, and the sensitivities of a time."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.mesh import Cells, Faces, FormatError, Meaning, Mesh
from rbfevo.meshes.openfoam import lists, meaning, writing
from rbfevo.meshes.openfoam.case import Case
from rbfevo.meshes.openfoam.dictionary import entries_of
from rbfevo.meshes.openfoam.fields import patch_fields, point_field
from rbfevo.meshes.openfoam.writing import Patch

POLYHEDRON, TRIANGLE, QUAD, POLYGON = 42, 5, 9, 7
RANKS = ("pointSensVec", "faceSensVec", "pointSensNormal", "faceSensNormal")  # the best first


class Topology(NamedTuple):
    """polyMesh: points [n, 3], faces by sizes [f] and corners, owners [f], neighbours [i] of inner faces, patches."""

    points: Array
    sizes: Ints
    corners: Ints
    owner: Ints
    neighbour: Ints
    patches: dict[str, Patch]


def read_case(case: Case) -> Mesh:
    """The mesh of a case at its time, with its sensitivities.

    Points and faces keep the case's order. Cells are the polyhedra, and behind them the faces of the patches, wound out
    of the fluid. Sensitivities of points are given integrated (nodal) where optimisationDict says what they are; those
    of faces are cell arrays, 0 away from the patches. `patch_types` has OpenFOAM's type of each patch, `meanings` what
    is known of each sensitivity.

    Raises:
        OSError: if a file is missing or cannot be read.
        FormatError: if a file is damaged, or files do not fit each other.
    """
    mesh = topology(case)
    inner = len(mesh.neighbour)
    cells, polyhedra = _cells(mesh)
    patches = {
        name: np.arange(polyhedra + patch.start - inner, polyhedra + patch.start - inner + patch.size)
        for name, patch in mesh.patches.items()
    }
    arrays, cell_arrays, meanings = _sensitivities(case, mesh, polyhedra)
    source = case.instance("points")
    notes = {"case": f"points of {source}"}
    if meanings:
        notes["sensitivities"] = f"{', '.join(meanings)} of time {case.time}"
    if any(lists.modified(path) < lists.modified(source) for path in case.fields().values()):
        notes["older sensitivities"] = f"{source} is newer than the sensitivities: are they those of this mesh?"
    return Mesh(
        mesh.points,
        writing.writer(mesh.patches, mesh.sizes, mesh.corners),
        cells,
        arrays,
        cell_arrays,
        patches,
        notes=notes,
        patch_types={name: patch.kind for name, patch in mesh.patches.items()},
        meanings=meanings,
    )


def topology(case: Case) -> Topology:
    """The files of polyMesh, checked against each other. Raises as `read_case`."""
    points_file, faces_file = lists.read(case.instance("points")), lists.read(case.instance("faces"))
    points, _ = lists.reals(points_file, points_file.start, 3)
    sizes, corners = lists.polygons(faces_file)
    owner, neighbour = (_labels(case.instance(name)) for name in ("owner", "neighbour"))
    if len(owner) != len(sizes) or len(neighbour) > len(owner):
        raise FormatError(f"faces, owner and neighbour have {len(sizes)}, {len(owner)} and {len(neighbour)} entries")
    if (sizes < 3).any() or (corners < 0).any() or corners.max(initial=-1) >= len(points):
        bad = int(((corners < 0) | (corners >= len(points))).sum())
        raise FormatError(
            f"{bad} corners of its faces are not among its {len(points)} points, or faces have fewer than 3"
        )
    if min(owner.min(initial=0), neighbour.min(initial=0)) < 0:
        raise FormatError("owner or neighbour has cells below 0")
    patches = read_boundary(case.instance("boundary"))
    place = len(neighbour)
    for name, patch in patches.items():
        if patch.start != place:
            raise FormatError(f"the patch {name} begins at face {patch.start}; {place} is expected")
        place += patch.size
    if place != len(sizes):
        raise FormatError(f"the patches end at face {place}, but there are {len(sizes)} faces")
    return Topology(points, sizes, corners, owner, neighbour, patches)


def read_boundary(path: Path) -> dict[str, Patch]:
    """The patches of polyMesh/boundary, in its order.

    Raises:
        OSError, FormatError: if it cannot be read.
    """
    file = lists.read(path)
    count, at = lists.count_at(file, file.start)
    at = lists.skip(file, at)
    end = file.content.rindex(b")")
    if file.content[at : at + 1] != b"(":
        raise FormatError(f"{file.name}: a list of patches is expected")
    found: dict[str, Any] = entries_of(file.content[at + 1 : end].decode("utf-8", "replace"), path)
    if len(found) != count:
        raise FormatError(f"{file.name} announces {count} patches, but holds {len(found)}")
    try:
        return {name: Patch(str(e["type"]), int(e["startFace"]), int(e["nFaces"])) for name, e in found.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{file.name}: a patch without type, startFace or nFaces ({error})") from None


def _labels(path: Path) -> Ints:
    file = lists.read(path)
    return lists.labels(file, file.start)[0]


def _cells(mesh: Topology) -> tuple[Cells, int]:
    """The polyhedra and, behind them, the faces of the patches; and how many polyhedra there are."""
    inner = len(mesh.neighbour)
    count = int(max(mesh.owner.max(initial=-1), mesh.neighbour.max(initial=-1))) + 1
    starts = np.cumsum(mesh.sizes) - mesh.sizes
    cell = np.concatenate([mesh.owner, mesh.neighbour])
    face = np.concatenate([np.arange(len(mesh.owner)), np.arange(inner)])
    order = np.argsort(cell, kind="stable")
    cell, face = cell[order], face[order]
    sizes = mesh.sizes[face]
    place = np.repeat(starts[face] - (np.cumsum(sizes) - sizes), sizes) + np.arange(int(sizes.sum()))
    corners = mesh.corners[place]
    pairs = np.unique(np.repeat(cell, sizes) * len(mesh.points) + corners)
    owner, own = pairs // len(mesh.points), pairs % len(mesh.points)
    outer = mesh.sizes[inner:]
    flat = np.full(len(outer), POLYGON, np.uint8)
    flat[outer == 3], flat[outer == 4] = TRIANGLE, QUAD
    cells = Cells(
        np.concatenate([np.full(count, POLYHEDRON, np.uint8), flat]),
        np.concatenate([np.bincount(owner, minlength=count), outer]).astype(np.int64),
        np.concatenate([own, mesh.corners[int(mesh.sizes[:inner].sum()) :]]),
        Faces(cell, sizes, corners),
    )
    return cells, count


def _sensitivities(
    case: Case, mesh: Topology, polyhedra: int
) -> tuple[dict[str, Array], dict[str, Array], dict[str, Meaning]]:
    """Arrays of points, of cells, and what each means."""
    arrays, cell_arrays, meanings = {}, {}, {}
    known, inner = meaning.entries(case), len(mesh.neighbour)
    for name, path in case.fields().items():
        entry = meaning.entry_of(known, name)
        rank = next((i for i, front in enumerate(RANKS) if re.match(rf"{front}(?!Vec)", name)), len(RANKS))
        normal = "as_wound" if name.startswith(("pointSensNormal", "faceSensNormal")) else None
        if name.startswith("pointSens"):
            values = point_field(path, len(mesh.points))
            normal = None if values.ndim > 1 else normal
            arrays[name], kind, note = _integrated(values, entry, mesh)
        else:
            of_patches = patch_fields(path, {key: patch.size for key, patch in mesh.patches.items()})
            width = max((values.ndim for values in of_patches.values()), default=1)
            total = polyhedra + len(mesh.sizes) - inner
            values = np.zeros((total, 3) if width > 1 else total)
            for key, own in of_patches.items():
                start = polyhedra + mesh.patches[key].start - inner
                values[start : start + len(own)] = own
            cell_arrays[name], normal = values, None if width > 1 else normal
            kind, note = _of_faces(entry)
        meanings[name] = Meaning(kind, normal, note, rank, solver_of(name))
    return arrays, cell_arrays, meanings


def solver_of(name: str) -> str:
    """The adjoint solver in the name of a field: `losses` of pointSensVeclossesESI; empty where there is none."""
    found = re.fullmatch(r"(?:point|face)Sens(?:Vec|Normal)(?!Vec)(.+?)(?:ESI)?", name)
    return "" if found is None else found[1]


def _integrated(values: Array, entry: meaning.Entry | None, mesh: Topology) -> tuple[Array, str | None, str]:
    """Sensitivities of points, integrated, with their kind and a note; as they are where it is not known what they
    are."""
    if entry is None:
        return values, None, f"{meaning.DICTIONARY} does not say whether they are integrated"
    area = bool(entry.area)  # not set: false
    if area:
        return values, "nodal", "includeSurfaceArea true: integrated"
    if not entry.newer:
        chosen = _matching(entry.patches, mesh.patches)
    else:
        chosen = [name for name, patch in mesh.patches.items() if patch.kind not in meaning.UNCOUPLED]
    if not chosen:
        return values, None, "the patches of its sensitivities are not known"
    ends = np.cumsum(mesh.sizes)
    total = np.zeros(len(mesh.points))
    for name in chosen:
        patch = mesh.patches[name]
        faces = slice(patch.start, patch.start + patch.size)
        first = int(ends[patch.start] - mesh.sizes[patch.start]) if patch.size else 0
        last = int(ends[patch.start + patch.size - 1]) if patch.size else 0
        total += meaning.areas_about(mesh.points, mesh.sizes[faces], mesh.corners[first:last], len(mesh.points))
    factor = total if values.ndim == 1 else total[:, None]
    return values * factor, "nodal", "includeSurfaceArea false: multiplied by the areas of the faces about each point"


def _of_faces(entry: meaning.Entry | None) -> tuple[str | None, str]:
    if entry is None:
        return None, f"{meaning.DICTIONARY} does not say whether they are integrated"
    if entry.newer:
        if entry.area:
            return "density", "includeSurfaceArea true: per area of a face"
        return None, "of this version and includeSurfaceArea false they are divided by the areas twice"
    if entry.area is False:
        return "density", "includeSurfaceArea false: per area"
    return "nodal", "integrated over each face"


def _matching(patterns: tuple[str, ...], patches: dict[str, Patch]) -> list[str]:
    """The patches that names or regular expressions choose."""
    found = []
    for name in patches:
        for pattern in patterns:
            try:
                fits = name == pattern or re.fullmatch(pattern, name) is not None
            except re.error:
                fits = False
            if fits:
                found.append(name)
                break
    return found
