"""Meshes of every common format: the one reader and the one writer of each.

Templates, targets, scans, sensitivities, `rbfevo.apply` and `rbfevo.export` all read and write through `opened` and
`write`. Points and cells keep the file's order. Text formats, PLY and STL are written with the coordinates put in
place, so that every other byte of the file stays; VTK and meshio write the rest. A directory is an OpenFOAM case.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.files import refuse_missing, write_whole
from rbfevo.meshes import cells, foreign, vtk_datasets
from rbfevo.meshes.abaqus import read_abaqus
from rbfevo.meshes.clouds import read_cloud
from rbfevo.meshes.glb import read_glb
from rbfevo.meshes.gmsh import read_gmsh
from rbfevo.meshes.kratos import read_kratos
from rbfevo.meshes.mesh import FormatError, Mesh
from rbfevo.meshes.nastran import read_nastran
from rbfevo.meshes.npy import read_npy
from rbfevo.meshes.obj import read_obj
from rbfevo.meshes.off import read_off
from rbfevo.meshes.openfoam import POINT_DISPLACEMENT, case_of, is_time, read_case
from rbfevo.meshes.ply import read_ply
from rbfevo.meshes.stl import read_stl
from rbfevo.meshes.su2 import read_su2, surface_positions
from rbfevo.names import existing_home

__all__ = [
    "CONVERSIONS",
    "ENDINGS",
    "FormatError",
    "Mesh",
    "cells",
    "is_case",
    "only_surface",
    "opened",
    "refuse_ending",
    "write",
]

OWN: dict[str, Callable[[bytes], Mesh]] = {
    ".obj": read_obj,
    ".off": read_off,
    ".ply": read_ply,
    ".stl": read_stl,
    ".glb": read_glb,
    ".su2": read_su2,
    **dict.fromkeys((".bdf", ".nas", ".fem", ".dat"), read_nastran),
    ".inp": read_abaqus,
    ".mdpa": read_kratos,
    ".xyz": read_cloud,
    ".csv": read_cloud,
    ".npy": read_npy,
}
VTK = (".vtk", ".vtp", ".vtu", ".vts", ".vti", ".vtr", ".vtm", ".pvtp", ".pvtu", ".case", ".encas", ".cgns")
MESHIO = (  # those that meshio reads, and that have no reader of their own
    *(".mesh", ".meshb", ".med", ".xdmf", ".xmf", ".vol", ".ugrid"),
    *(".avs", ".f3grid", ".dato", ".post", ".tec", ".e", ".exo", ".ex2", ".h5m", ".hmf"),
    *(".xml", ".ele", ".node", ".wkt", ".vol.gz", ".dato.gz", ".post.gz"),
)
ENDINGS = (*OWN, ".msh", *VTK, *MESHIO)
CONVERSIONS = (".vtp", ".vtu", ".vtk")


@contextlib.contextmanager
def opened(path: str | Path) -> Iterator[Mesh]:
    """The mesh or cloud in a file, by its ending, or of an OpenFOAM case; it can be written until the end of the block.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, or holds no usable points, or cells that
            cannot be.
    """
    path = existing_home(path)
    if is_case(path):
        yield _case(path)
        return
    refuse_missing(path)
    ending = ending_of(path)
    if ending not in ENDINGS:
        raise UserError(f"{path}: unknown ending '{ending}'; a mesh or cloud can be {_listed()}")
    with contextlib.ExitStack() as stack:
        try:
            if _is_blank(path):
                raise UserError(f"{path}: the file is empty")
            own = _own(path, ending)
            if own is not None:
                mesh = own(path.read_bytes())
            else:
                kind = "vtk" if ending in VTK else "meshio"
                mesh = stack.enter_context(foreign.foreign(kind, path.resolve()))
            cells.check(mesh.cells, len(mesh.points))
            if mesh.dimension == 2:
                mesh.notes["two coordinates"] = "its points have two coordinates; the third is taken as 0"
        except UserError:
            raise
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
        except FormatError as error:
            raise UserError(f"{path}: not a readable {ending[1:].upper()} file ({error})") from None
        except Exception as error:  # loaders raise whatever they like on a damaged file
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise UserError(f"{path}: damaged: not a readable {ending[1:].upper()} file ({reason})") from None
        yield mesh


def is_case(path: Path) -> bool:
    """Whether a path is a directory, as a case is, or stands for time 0 of a case without a directory of it."""
    return path.is_dir() or (not path.exists() and case_of(path) is not None)


def _case(path: Path) -> Mesh:
    """The mesh of an OpenFOAM case.

    Raises:
        UserError: if the directory is none, or the case cannot be read.
    """
    case = case_of(path)
    if case is None:
        raise UserError(f"{path}: is a directory, and no OpenFOAM case; give a case or a file ({_listed()})")
    try:
        mesh = read_case(case)
        cells.check(mesh.cells, len(mesh.points))
    except OSError as error:
        raise UserError(f"{path}: {error.filename or 'the case'} cannot be read ({error.strerror or error})") from None
    except (FormatError, ValueError, IndexError) as error:
        raise UserError(f"{path}: not a readable OpenFOAM case ({error})") from None
    return mesh


def ending_of(path: Path) -> str:
    """The ending of a file's name, in lower case, which decides its format, as `.ply` or `.vol.gz`."""
    double = "".join(path.suffixes[-2:]).lower()
    return double if double in ENDINGS else path.suffix.lower()


def _own(path: Path, ending: str) -> Callable[[bytes], Mesh] | None:
    """The reader of a file that is read here, or None where VTK or meshio reads it."""
    if ending == ".dat":  # Nastran's, or else Tecplot's
        with path.open("rb") as file:
            return read_nastran if re.search(rb"^(?:GRID|BEGIN +BULK)\b", file.read(1 << 16), re.I | re.M) else None
    if ending == ".msh":  # Gmsh's, or else Ansys Fluent's
        with path.open("rb") as file:
            return read_gmsh if file.read(200).lstrip().startswith(b"$") else None
    return OWN.get(ending)


def _listed() -> str:
    return ", ".join(ending[1:].upper() for ending in ENDINGS)


def _is_blank(path: Path) -> bool:
    with path.open("rb") as file:
        while block := file.read(1 << 16):
            if block.strip():
                return False
    return True


def refuse_bad_points(path: Path, points: Array) -> None:
    """Raise UserError if a file's points [n, 3] are not all finite, or too large to be squared."""
    bad = int((~np.isfinite(points)).any(axis=1).sum())
    if bad:
        raise UserError(f"{path}: {bad} of {len(points)} points have coordinates that are not finite (NaN or infinite)")
    refuse_huge(path, points)


def refuse_huge(path: Path | str, points: Array) -> None:
    """Raise UserError if finite points [n, 3] are too large to be squared."""
    largest = float(np.abs(points).max())
    if largest > 1e100:
        raise UserError(f"{path}: a coordinate is as large as {largest:.1e}; check the file's units")


def refuse_ending(mesh: Path, out: Path) -> None:
    """Raise UserError if a mesh of the ending of `mesh` cannot be written with that of `out`."""
    if is_case(mesh):
        if not is_time(out.parent if out.name == POINT_DISPLACEMENT else out):
            raise UserError(f"--out {out}: for a case give a directory with a time as its name, such as {mesh}/1")
        return
    given, wanted = ending_of(mesh), ending_of(out)
    if wanted != given and wanted not in CONVERSIONS and not only_surface(mesh, out):
        positions = ", or .dat for surface positions" if given == ".su2" else ""
        raise UserError(
            f"--out {out}: choose the ending of the mesh, {given}, or one of {', '.join(CONVERSIONS)}{positions}"
        )


def only_surface(mesh: Path, out: Path) -> bool:
    """Whether `out` is to hold the positions of an SU2 mesh's surface, and not its volume."""
    return (ending_of(mesh), ending_of(out)) == (".su2", ".dat")


def write(
    mesh: Mesh, source: Path, moved: Array, displacement: Array, out: Path, patches: Sequence[str] | None = None
) -> list[str]:
    """Write a mesh with moved points [n, 3], whole, in the format of the ending of `out`; return notes.

    Of a mesh of SU2 and an `out` that ends in .dat, write surface positions, of all markers or of `patches`.

    Raises:
        UserError: if it cannot be written.
    """
    given, wanted = ending_of(source), ending_of(out)
    if only_surface(source, out):
        try:
            content, notes = surface_positions(mesh, moved, patches)
        except UserError as error:
            raise UserError(f"{source}: {error}") from None
        write_whole(out, content)
        return notes
    if is_case(source) or wanted == given or _own(source, given) is None:
        try:
            return [*([] if wanted != given else mesh.kept), *mesh.write(moved, displacement, out)]
        except FormatError as error:
            raise UserError(f"{out} cannot be written: {error}") from None
        except OSError as error:
            raise UserError(f"{out} cannot be written: {error.strerror or error}") from None
    arrays = {**mesh.arrays, "displacement": displacement}
    if wanted == ".vtp" and cells.solids(mesh.cells):
        raise UserError(f"--out {out}: the mesh fills a volume; choose an ending of .vtu or .vtk")
    if wanted == ".vtp":
        triangles = cells.surface(mesh.points, mesh.cells).triangles
        dataset = vtk_datasets.polydata(moved, triangles if len(triangles) else None, arrays)
        foreign.write_dataset(dataset, out)
        return [f"converted to {wanted}: points, triangles, point arrays and the displacement; nothing else is kept"]
    own = mesh.cells
    dataset = vtk_datasets.grid(moved, own.kinds, own.sizes, own.corners, arrays, mesh.cell_arrays)
    foreign.write_dataset(dataset, out)
    return [f"converted to {wanted}: points, cells, arrays and the displacement; names and groups are not kept"]
