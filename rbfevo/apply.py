"""`python -m rbfevo.apply RUN --pick knee --displacements FILE --mesh FILE --out FILE`: deform a mesh with a setup."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rbfevo import meshes
from rbfevo.commands import doubts, following, parsers, volume
from rbfevo.commands.center_rows import read_rows
from rbfevo.errors import UserError
from rbfevo.meshes.constraints import solid_faces
from rbfevo.meshes.faces import Between
from rbfevo.meshes.quality import qualities
from rbfevo.recorded.moves import places_of
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup

FORMS = ("points", "pointDisplacement")  # of a case
DESCRIPTION = """Deform a mesh with the control points of one setup of a run.

You give how far each control point moves (--displacements, in the unit of the mesh), as in the displacements.csv that
python -m rbfevo.export writes; every point of the mesh follows. The mesh can be the template of the run or any other
one in the same place and unit: a finer surface, a volume mesh, a cloud. Everything else in its file is kept.

With --volume laplace the points of the design surface alone move as the setup says. The inside of a volume mesh is
carried along by a Laplacian over the edges of its cells; the rest of the boundary is held, and slides in symmetry
planes: patches of type symmetryPlane, symmetry or empty, or else what lies in the run's own planes."""
EPILOG = f"""Mesh formats: {", ".join(ending[1:] for ending in meshes.ENDINGS)}.
--out ends as --mesh does, or in one of {", ".join(meshes.CONVERSIONS)}.
Of an OpenFOAM case, --mesh is its directory and --out the directory of a time, such as CASE/1.
Of an SU2 mesh, --out FILE.dat writes surface positions: SU2_DEF reads them with DV_KIND= SURFACE_FILE."""


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.PickParser("rbfevo.apply", DESCRIPTION, EPILOG)
    what = made.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--displacements",
        type=Path,
        metavar="FILE",
        help="how far each center moves: CSV with columns center,dx,dy,dz or only dx,dy,dz (on the plane also one, "
        "the height), NPY [m, 3], or NPZ with an array named displacements",
    )
    what.add_argument(
        "--weights",
        type=Path,
        metavar="FILE",
        help="RBF weights instead of displacements, in the same way: center,wx,wy,wz",
    )
    made.add_argument("--mesh", type=Path, required=True, metavar="FILE", help="the mesh to deform")
    made.add_argument("--out", type=Path, required=True, metavar="FILE", help="the file to write the deformed mesh to")
    made.add_argument(
        "--as",
        dest="form",
        choices=FORMS,
        default=FORMS[0],
        help="of an OpenFOAM case: the points of time OUT (default), or OUT/pointDisplacement for its own mover",
    )
    made.add_argument(
        "--patches",
        type=lambda text: text.split(","),
        metavar="NAMES",
        help="of an SU2 mesh and --out FILE.dat: the markers to write, as in wing,tail (default: all)",
    )
    made.add_argument(
        "--volume",
        choices=("rbf", "laplace"),
        default="rbf",
        help="how points inside a volume mesh move: as the RBFs say (rbf, the default), or carried along by the design "
        "surface (laplace)",
    )
    made.add_argument(
        "--design",
        action="append",
        default=[],
        metavar="PATCH",
        help="for laplace: a patch of the design surface (give it once for each); without, the design surface is the "
        "boundary points that are vertices of the run's template",
    )
    made.add_argument(
        "--slip",
        action="append",
        default=[],
        metavar="PATCH",
        help="for laplace: a further patch whose points slide in its plane, across x, y or z",
    )
    made.add_argument("--force", action="store_true", help="write a volume mesh even if cells turn inside out")
    made.add_argument("--overwrite", action="store_true", help="replace --out if it exists")
    made.add_argument("--quiet", action="store_true", help="print only warnings")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, or 2 for a user's mistake."""
    return parsers.carried_out(parser, carry_out, arguments)


def carry_out(options: argparse.Namespace) -> None:
    """Deform one mesh.

    Raises:
        UserError: for a user's mistake; nothing is written then.
    """
    record = read(options.run)
    chosen = setup(record, pick(record, options.pick))
    out = target(options)
    what, path = (
        ("weights", options.weights) if options.displacements is None else ("displacements", options.displacements)
    )
    rows = read_rows(path, what, places_of(chosen, what), heights=record.vertices.shape[1] == 2)
    try:
        chosen.refuse_across(rows, what.removesuffix("s"))
    except UserError as error:
        raise UserError(f"--{what} {path}: {error}") from None
    with np.errstate(over="ignore", invalid="ignore"), meshes.opened(options.mesh) as mesh:
        meshes.refuse_bad_points(options.mesh, mesh.points)
        weights = rows if what == "weights" else chosen.weights(rows)
        displacement = chosen.displacement(mesh.points[:, : record.vertices.shape[1]], weights)
        faces, carried = known_faces(mesh, options), None
        if options.volume == "laplace" and faces is not None and np.isfinite(displacement).all():
            try:
                carried = volume.carried(mesh, faces, record, chosen, displacement, options.design, options.slip)
            except UserError as error:
                raise UserError(f"{options.mesh}: {error}") from None
            displacement = carried.displacement
        moved = mesh.points + displacement
        if not np.isfinite(moved).all():
            raise UserError(f"--{what} {path}: its values are so large that deformed points are not finite")
        if mesh.dimension == 2 and options.out.suffix.lower() not in meshes.CONVERSIONS and displacement[:, 2].any():
            raise UserError(
                f"{options.mesh}: its points have no z coordinate, but the setup moves them along z; "
                "write a VTU file instead: --out FILE.vtu"
            )
        surface = meshes.only_surface(options.mesh, options.out)
        turned = "" if surface else doubts.inverted(mesh, moved)  # SU2_DEF moves the inside in its own way
        found = [line for line in (turned, carried.leaving if carried else "") if line]
        if found and not options.force:
            raise UserError(f"{options.mesh}: {'; and '.join(found)}, or add --force to write the mesh anyway")
        notes = meshes.write(mesh, options.mesh, moved, displacement, out, options.patches)
        centers = chosen.moved(rows if what == "displacements" else chosen.handles_moved(weights))
        length = np.linalg.norm(displacement, axis=1)
        largest = float(np.linalg.norm(centers, axis=1).max(initial=0.0))
        left_to_mover = out.name == FORMS[1]  # which moves the inside in its own way
        quality = None if faces is None or left_to_mover else qualities(mesh.points, moved, faces)
        found = [*doubts.warnings(record, chosen, mesh, moved, None if carried else length, largest), *found]
        if beyond := doubts.beyond_bounds(record, chosen.displacement(record.vertices, weights)):
            found.append(beyond)
        if quality and quality[0].non_orthogonality <= 90.0 < quality[1].non_orthogonality:
            found.append("the worst non-orthogonality exceeds 90 degrees: faces of cells are turned over")
        for warning in [*found, *([carried.jump] if carried and carried.jump else [])]:
            print(f"warning: {warning}", file=sys.stderr, flush=True)
        notes += [carried.line] if carried else []
        if quality:
            notes.append(following.compared(*quality))
    if not options.quiet:
        for note in notes:
            print(f"note: {note}")
        print(f"{len(moved)} points moved by at most {length.max():.6g}, the centers by at most {largest:.6g}")
        print(f"written: {out}", flush=True)


def target(options: argparse.Namespace) -> Path:
    """What is written: --out, or of a case its field for the mover; checked.

    Raises:
        UserError: if the result cannot be written there.
    """
    if options.volume != "laplace" and (options.design or options.slip):
        raise UserError(f"--{'design' if options.design else 'slip'} is for --volume laplace")
    meshes.refuse_ending(options.mesh, options.out)
    if options.patches is not None and not meshes.only_surface(options.mesh, options.out):
        raise UserError(
            "--patches is for surface positions of SU2 alone (--mesh FILE.su2 --out FILE.dat); patches of the design "
            "surface are named by --design, with --volume laplace"
        )
    if meshes.is_case(options.mesh):
        time: Path = options.out
        if not time.parent.is_dir():
            raise UserError(f"--out {time}: the directory {time.parent} does not exist; create it first")
        mover = options.form == FORMS[1]
        written = time / FORMS[1] if mover else time / "polyMesh" / "points"
        there = [one for one in (written, written.with_name(f"{written.name}.gz")) if one.exists()]
        if there and (there[0] != written or not options.overwrite):
            raise UserError(
                f"--out {time}: {there[0]} already exists: choose another time, or "
                + ("add --overwrite" if there[0] == written else "remove it")
            )
        return written if mover else time
    if options.form != FORMS[0]:
        raise UserError(f"--as {options.form}: {options.mesh} is no OpenFOAM case; leave it out")
    refuse_out(options)
    return options.out


def refuse_out(options: argparse.Namespace) -> None:
    """Raise UserError if the result cannot be written to the file --out."""
    if options.out.exists() and not options.overwrite:
        raise UserError(f"--out {options.out} already exists: choose another file, or add --overwrite")
    if options.out.is_dir():
        raise UserError(f"--out {options.out} is a directory: give a file")
    if not options.out.parent.is_dir():
        raise UserError(f"--out {options.out}: the directory {options.out.parent} does not exist; create it first")


def known_faces(mesh: meshes.Mesh, options: argparse.Namespace) -> Between | None:
    """The faces of a mesh's solid cells; None if there are none, or some of a kind whose faces are not known.

    Raises:
        UserError: with --volume laplace, which needs them.
    """
    if options.volume != "laplace":
        return following.known_faces(mesh)
    try:
        return solid_faces(mesh.cells)
    except UserError as error:
        raise UserError(f"{options.mesh}: {error}") from None


if __name__ == "__main__":
    parsers.start(main)
