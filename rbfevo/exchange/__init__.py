"""Meshes of every common format: read, deformed, and written back with all else that their file holds."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rbfevo.errors import UserError
from rbfevo.exchange import foreign, lines, program
from rbfevo.exchange.glb import read_glb
from rbfevo.exchange.mesh import Mesh
from rbfevo.exchange.npy import read_npy
from rbfevo.exchange.ply import read_ply
from rbfevo.exchange.stl import read_stl
from rbfevo.exchange.su2 import read_su2
from rbfevo.record import Array

__all__ = ["CONVERSIONS", "ENDINGS", "Mesh", "opened", "refuse_ending", "write"]

OWN = {**lines.READERS, ".ply": read_ply, ".stl": read_stl, ".glb": read_glb, ".npy": read_npy, ".su2": read_su2}
VTK = (".vtk", ".vtp", ".vtu", ".vts", ".vti", ".vtr")
MESHIO = (  # those that meshio both reads and writes
    *(".msh", ".inp", ".bdf", ".nas", ".fem", ".mesh", ".meshb", ".med", ".xdmf", ".xmf", ".vol", ".ugrid"),
    *(".avs", ".mdpa", ".f3grid", ".dato", ".post", ".tec", ".dat", ".cgns", ".e", ".exo", ".ex2", ".h5m", ".hmf"),
)
ENDINGS = (*OWN, *VTK, *MESHIO)
CONVERSIONS = (".vtp", ".vtu", ".vtk")


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Mesh]:
    """The mesh or cloud in a file, by its ending; it can be written until the end of the block.

    Raises:
        UserError: if the file is missing, unreadable, of an unknown ending, or has no usable points.
    """
    ending = path.suffix.lower()
    if path.is_dir():
        raise UserError(f"{path}: is a directory, not a mesh")
    if ending not in ENDINGS:
        raise UserError(f"{path}: unknown ending '{ending}'; a mesh can be {', '.join(e[1:] for e in ENDINGS)}")
    with contextlib.ExitStack() as stack:
        try:
            if ending in OWN:
                content = path.read_bytes()
                if not content.strip():
                    raise ValueError("the file is empty")
                mesh = OWN[ending](content)
            else:
                path.open("rb").close()
                kind = "vtk" if ending in VTK else "meshio"
                mesh = stack.enter_context(foreign.foreign(kind, path.resolve()))
        except FileNotFoundError:
            raise UserError(f"{path}: no such file") from None
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
        except Exception as error:  # loaders raise whatever they like on a damaged file
            said = " ".join(str(error).split())[:300] or type(error).__name__
            raise UserError(f"{path}: not a readable {ending[1:].upper()} file ({said})") from None
        _check(path, mesh.points)
        yield mesh


def _check(path: Path, points: Array) -> None:
    bad = int((~np.isfinite(points)).any(axis=1).sum())
    if bad:
        raise UserError(f"{path}: {bad} of {len(points)} points have coordinates that are not finite (NaN or infinite)")
    if np.abs(points).max() > 1e100:
        raise UserError(f"{path}: a coordinate is as large as {np.abs(points).max():.1e}; check the file's units")


def refuse_ending(mesh: Path, out: Path) -> None:
    """Raise UserError if a mesh of the ending of `mesh` cannot be written with that of `out`."""
    given, wanted = mesh.suffix.lower(), out.suffix.lower()
    if wanted != given and wanted not in CONVERSIONS:
        raise UserError(f"--out {out}: choose the ending of the mesh, {given}, or one of {', '.join(CONVERSIONS)}")


def write(mesh: Mesh, source: Path, moved: Array, displacement: Array, out: Path) -> list[str]:
    """Write a mesh with moved points [q, 3], whole, in the format that the ending of `out` says; return notes.

    Raises:
        UserError: if it cannot be written.
    """
    given, wanted = source.suffix.lower(), out.suffix.lower()
    if wanted == given or given not in OWN:
        return [*([] if wanted != given else mesh.notes), *mesh.write(moved, displacement, out)]
    foreign.write_dataset(program.polydata(moved, mesh.triangles, {"displacement": displacement}), out)
    return [f"converted to {wanted}: points, triangles and the displacement; nothing else of the file is kept"]
