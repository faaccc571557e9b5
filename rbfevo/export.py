"""`python -m rbfevo.export RUN --pick knee`: write one setup of a run for other programs, ready to use."""

from __future__ import annotations

import argparse
import json
import shlex
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.commands import parsers
from rbfevo.commands.center_rows import MOVED, numbered
from rbfevo.errors import UserError
from rbfevo.files import csv_text, npz, refuse_held, write_whole
from rbfevo.recorded.morph import morph_of
from rbfevo.recorded.moves import RULES, Move, places_of, spatial, wanted_move
from rbfevo.recorded.objectives import index_of
from rbfevo.recorded.parameters import design_matrix, orthonormal
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import Setup, setup
from rbfevo.scoring.representations import FFD
from rbfevo.scoring.representations.linear import LinearRBF

FILES = (
    *("centers.csv", "centers.vtp", "template.vtp", "setup.npz"),
    *("displacements.csv", "weights.csv", "parameters.prm"),
)
LINEAR = ("coefficients.csv", "morph.csv")  # of RBFs with a linear polynomial, in the place of weights.csv
LATTICE = ("lattice.xyz", "su2.cfg", "lattice.vts")  # of free-form deformation, beside these
EVERY = (*FILES, *LINEAR, *LATTICE)
STEP = 0.05  # of the diagonal of the template's bounding box
DESCRIPTION = """Write one setup of a run (control points and what they can do) for other programs.

centers.csv        the control points;  centers.vtp, template.vtp: the same and the mesh, for ParaView
displacements.csv  how far to move each control point: edit it, then deform any mesh with python -m rbfevo.apply; in
                   runs with held regions moved_x, moved_y, moved_z say how far it really moves
weights.csv        the RBF weights that do the same: displacement = sum over centers.csv of times * weight * phi; in
                   mirrored rows, the component across the symmetry plane changes its sign
coefficients.csv, morph.csv
                   in the place of weights.csv where RBFs have a linear polynomial: what rbfevo.apply takes as
                   --weights; and the RBF weights, as above, with the factors of 1, x, y and z that are added
setup.npz          arrays for your own optimizer: X' = X + U P, and Q and T of U = Q T: with parameters q = T p steps
                   are taken in Q, whose columns are orthonormal (R = 1)
parameters.prm     control points for PyGeM
Of representation=ffd also lattice.xyz (plot3d, for pyGeo), su2.cfg (the box, and how its control points move, for SU2)
and lattice.vts (for ParaView); parameters.prm is then PyGeM's for free-form deformation."""


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.PickParser("rbfevo.export", DESCRIPTION, "An existing export is never overwritten.")
    made.add_argument("--out", type=Path, metavar="DIR", help="directory to write (default: RUN/export-PICK)")
    made.add_argument(
        "--step",
        type=parsers.fraction,
        default=STEP,
        help="for runs with a sensitivity, which gives a direction but no length: the largest displacement of a "
        f"vertex, as a fraction of the mesh's diagonal or a percentage (default: {STEP:g}, which is {100 * STEP:g}%%)",
    )
    made.add_argument(
        "--rule",
        choices=RULES,
        help="for runs with a sensitivity: how the step is chosen. max-norm (default): what gains most for the largest "
        "displacement of a vertex; natural: the projection of the (smoothed) sensitivity on the columns; steepest: "
        "steepest descent in the parameters of the run's manipulation",
    )
    made.add_argument(
        "--objective",
        metavar="NAME",
        help="for runs with several objectives: the one that the step follows (default: the weighted sum of their "
        "sensitivities, each of unit norm)",
    )
    made.add_argument(
        "--keep",
        metavar="NAME",
        action="append",
        default=[],
        help="for runs with several objectives: one that must not get worse, to first order; may be given repeatedly",
    )
    made.add_argument("--quiet", action="store_true", help="print nothing")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, or 2 for a user's mistake."""
    return parsers.carried_out(parser, carry_out, arguments)


def carry_out(options: argparse.Namespace) -> None:
    """Write the files of one setup.

    Raises:
        UserError: for a user's mistake; nothing is written then.
    """
    record = read(options.run)
    row = pick(record, options.pick)
    if not 0 < options.step <= 1:
        raise UserError(f"--step {options.step:g}: give a fraction of the mesh's diagonal, above 0 and at most 1")
    k = record.alone(0).gradient.shape[1]
    if record.vertices.shape[1] == 3 and k != 3:
        raise UserError(
            f"{options.run}: cannot be exported, since its gradient has {k} components, not the three of a "
            "displacement in space"
        )
    out = options.out or options.run / f"export-{options.pick.strip().replace(':', '-')}"
    refuse_held(out, EVERY, "--out")
    chosen = setup(record, row)
    for option, names in (("--objective", [options.objective or ""]), ("--keep", options.keep)):
        for name in filter(None, names):
            index_of(record, name, option)
    rule = options.rule or RULES[0]
    move = wanted_move(record, chosen, options.step, rule, options.objective, options.keep)
    if options.rule is not None and not move.direction:
        raise UserError(
            f"--rule {options.rule}: {options.run} has a target, which is approximated; rules are for sensitivities"
        )
    contents, left_out = file_contents(record, chosen, move)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out, prefix=".export-") as aside:  # all of it appears, or nothing
            for name, content in contents.items():
                write_whole(Path(aside) / name, content)
            write_vtp(Path(aside), record, chosen, move)
            for path in sorted(Path(aside).iterdir()):
                path.replace(out / path.name)
    except OSError as error:
        raise UserError(f"--out {out} cannot be written: {error.strerror or error}") from None
    if not options.quiet:
        for line in closing(options, record, chosen, move, out, list(contents), left_out):
            print(line, flush=True)


def file_contents(record: Record, chosen: Setup, move: Move) -> tuple[dict[str, bytes], dict[str, str]]:
    """The contents of all files but VTK's, and for each file that is left out the reason."""
    physical, left_out = chosen.centers_and_images(), {}
    places, times = spatial(physical.points), chosen.times[physical.column]
    rows = zip(physical.column.tolist(), places.tolist(), physical.mirrored.tolist(), times.tolist(), strict=True)
    lines = [(column, *point, int(mirrored), count) for column, point, mirrored, count in rows]
    places = spatial(places_of(chosen))
    contents = {
        "centers.csv": csv_text(["center", "x", "y", "z", "mirrored", "times"], lines),
        coefficients(chosen): numbered(["wx", "wy", "wz"], places, spatial(move.weights)),
    }
    if (morph := morph_of(chosen, move.weights)) is not None:
        names = [*map(str, range(chosen.count)), "1", *"xyz"[: len(morph.polynomial) - 1]]
        values = spatial(np.concatenate([morph.kernel, morph.polynomial])).tolist()
        contents["morph.csv"] = csv_text(
            ["of", "wx", "wy", "wz"], [(name, *row) for name, row in zip(names, values, strict=True)]
        )
    k = move.wanted.shape[1]
    crosses = chosen.crosses(k)
    if reason := chosen.immovable(k):
        left_out |= dict.fromkeys(("displacements.csv", "parameters.prm"), reason)
        if chosen.manipulation == "direct":
            left_out["U in setup.npz"] = reason
    else:
        names, columns = ["dx", "dy", "dz"], spatial(move.centers)
        if chosen.hold is not None:
            names = [*names, *MOVED]
            columns = np.hstack([columns, spatial(chosen.moved(move.centers))])
        contents["displacements.csv"] = numbered(names, spatial(places_of(chosen, "displacements")), columns)
        others = contents_for_others(chosen, move)
        contents |= {name: content for name, content in others.items() if isinstance(content, bytes)}
        left_out |= {name: content for name, content in others.items() if isinstance(content, str)}
    contents["setup.npz"] = npz(_arrays(record, chosen, crosses, bool(reason)))
    return contents, left_out


def coefficients(chosen: Setup) -> str:
    """The file of what `rbfevo.apply` takes as --weights, which are RBF weights where there is no polynomial."""
    return "coefficients.csv" if isinstance(chosen.representation, LinearRBF) else "weights.csv"


def contents_for_others(chosen: Setup, move: Move) -> dict[str, bytes | str]:
    """The files of other programs, or the reason why one is left out."""
    from rbfevo.commands import ffd_files, pygem

    if isinstance(chosen.representation, FFD):
        return ffd_files.contents(chosen, move.weights)
    try:
        return {"parameters.prm": pygem.parameters(chosen, spatial(move.centers))}
    except UserError as error:
        return {"parameters.prm": str(error)}


def _arrays(record: Record, chosen: Setup, crosses: bool, singular: bool) -> dict[str, Any]:
    mirror = chosen.mirror
    arrays: dict[str, Any] = {
        "centers": chosen.centers,
        "vertices": record.vertices,
        "faces": record.faces,
        "lower": record.lower,
        "upper": record.upper,
        "kernel": np.array(chosen.name),
        "support": np.array(np.nan if chosen.support is None else chosen.support),
        **_spec(chosen),
        "manipulation": np.array(chosen.manipulation),
        "symmetry_axis": np.array("" if mirror is None else "xyz"[mirror.axis]),
        "symmetry_at": np.array(np.nan if mirror is None else mirror.at),
        "planar_axis": np.array("" if chosen.planar is None else chosen.planar.name),
        "planar_at": np.array(np.nan if chosen.planar is None else chosen.planar.at),
        "regularity": np.array(chosen.regularity),
        "improvement_potential": np.array(chosen.improvement_potential),
        "row": np.array(chosen.row),
    }
    if "kept" in record.summary:
        arrays["kept"] = np.array(record.summary["kept"])  # how many of the first centers stayed
    if record.objectives:
        arrays |= {"objectives": np.array(record.objectives), "potentials": record.potential_of_each[chosen.row]}
    direct = chosen.manipulation == "direct"
    if direct and singular:
        return arrays
    if chosen.genotype is not None:
        arrays["genotype"] = chosen.genotype
    for name, across in [("U", False), ("U_across", True)][: 2 if crosses else 1]:
        U = design_matrix(chosen, record.vertices, across)
        Q, T = orthonormal(U, record.weights)
        arrays |= {name: U, name.replace("U", "Q"): Q, name.replace("U", "T"): T}
    if chosen.hold is not None and record.blend is not None:
        arrays |= {"blend": record.blend, "held": chosen.hold.points, "hold_width": np.array(chosen.hold.width)}
    if crosses:
        arrays["across"] = chosen.off_plane
    return arrays


def _spec(chosen: Setup) -> dict[str, Any]:
    """The kernel, or another representation, from which a reader rebuilds the columns."""
    if chosen.kernel is not None and chosen.plain:
        return {"kernel_spec": np.array(json.dumps(chosen.kernel.spec()))}
    made = {"name": chosen.representation.name, **chosen.representation.spec()}
    return {"representation_spec": np.array(json.dumps(made))}


def write_vtp(out: Path, record: Record, chosen: Setup, move: Move) -> None:
    """Write centers.vtp and template.vtp."""
    from rbfevo.meshes.foreign import write_dataset
    from rbfevo.meshes.vtk_datasets import polydata

    physical = chosen.centers_and_images()
    arrays: dict[str, Array] = {
        "center": physical.column.astype(np.int64),
        "mirrored": physical.mirrored.astype(np.uint8),
        "times": chosen.times[physical.column].astype(np.uint8),
        "displacement": spatial(chosen.with_images(chosen.moved(move.centers))),
    }
    if chosen.support is not None:
        arrays["support"] = np.full(len(physical.points), chosen.support)
    write_dataset(polydata(spatial(physical.points), None, arrays), out / "centers.vtp")
    fields = {"wanted": move.wanted, "reached": move.reached, "left": move.wanted - move.reached}
    if record.gradients is not None:
        fields |= {f"wanted {name}": own for name, own in zip(record.objectives, record.gradients, strict=True)}
    fields = {name: spatial(field) for name, field in fields.items()} | {"weights": record.weights}
    faces = record.faces if len(record.faces) else None
    write_dataset(polydata(spatial(record.vertices), faces, fields), out / "template.vtp")
    if isinstance(chosen.representation, FFD):
        from rbfevo.commands import ffd_files

        write_dataset(ffd_files.grid(chosen, move.weights), out / "lattice.vts")


def closing(
    options: argparse.Namespace,
    record: Record,
    chosen: Setup,
    move: Move,
    out: Path,
    written: list[str],
    left_out: dict[str, str],
) -> list[str]:
    """The lines on the screen."""
    wanted, reached = (float(np.linalg.norm(field, axis=1).max()) for field in (move.wanted, move.reached))
    plain = "P" if record.gradients is None else "mean P"
    bounded = ""
    if record.potential_symbol != plain:
        bounded = f", {record.potential_symbol} = {record.potential[chosen.row]:.4f}"
    mirror, rule = chosen.mirror, f"{options.rule or RULES[0]} step"
    mirrored = "" if mirror is None else f", mirrored at {'xyz'[mirror.axis]} = {mirror.at:g}"
    size = (
        f"scaled to --step {options.step:g} of the mesh's diagonal: a sensitivity gives no length"
        if move.direction
        else ""
    )
    lines = [
        f"{options.pick.strip()}: row {chosen.row} of {options.run} ({record.origin(chosen.row)}): "
        f"R = {chosen.regularity:.4g}, {plain} = {chosen.improvement_potential:.4f}{bounded}",
        *_of_each(record, chosen),
        f"{len(chosen.centers)} centers{mirrored}: {record.title}",
        f"{rule if move.direction else 'best approximation'}: a vertex moves by at most {reached:.4g}"
        + (f" ({size})" if size else f" (wanted: at most {wanted:.4g})"),
        *([] if move.change is None else [f"predicted change of the objective: {move.change:+.4g} (to first order)"]),
        *_limits(record, move),
        *_changes(options, record, move),
        *_fixed(record, move),
        f"files: {out}: {', '.join(name for name in EVERY if name in written or (out / name).is_file())}",
    ]
    lines += chosen.doubts(record)
    if "parameters.prm" in written and chosen.kernel is not None:
        from rbfevo.commands.pygem import difference

        lines.append(f"parameters.prm: {difference(chosen)}")
    lines += [f"left out: {name}: {reason}" for name, reason in left_out.items()]
    what, file = ("displacements", "displacements.csv")
    if file not in written:
        what, file = ("weights", coefficients(chosen))
    arguments = [str(options.run), "--pick", options.pick.strip(), f"--{what}", str(out / file)]
    arguments += ["--mesh", str(out / "template.vtp"), "--out", str(out / "deformed.vtp")]
    return [*lines, f"next: python -m rbfevo.apply {shlex.join(arguments)}"]


def _limits(record: Record, move: Move) -> list[str]:
    """How many vertices are at the largest displacement that the run allows them, where that limits the move."""
    if not move.limited:
        return []
    what = "the step is shorter than --step" if move.direction else "the best approximation is scaled down"
    return [f"scenario.max_displacement: {what}, since {move.limited} vertices move by as much as they may"]


def _of_each(record: Record, chosen: Setup) -> list[str]:
    """The potential of each of several objectives."""
    listed = record.listed(chosen.row)
    return [f"{record.symbol_of_each} of each objective: {listed}"] if listed else []


def _changes(options: argparse.Namespace, record: Record, move: Move) -> list[str]:
    """What the step follows, and what it is predicted to change of each of several objectives."""
    if not move.changes:
        return []
    shares = ", ".join(f"{name} {share:.3g}" for name, share in zip(record.objectives, record.shares, strict=True))
    followed = options.objective or f"the weighted sum of the sensitivities, each of unit norm ({shares})"
    lines = [f"the step follows {followed}"]
    for change in move.changes:
        verdict = change.verdict
        if change.name in options.keep:
            verdict = "kept" if change.gain == 0.0 else f"{verdict}, kept without restricting the step"
        shown = "of unknown size" if change.value is None else "0" if change.value == 0.0 else f"{change.value:+.4g}"
        lines.append(f"predicted change of {change.name}: {shown}: {verdict} (to {change.direction}; to first order)")
    return lines


def _fixed(record: Record, move: Move) -> list[str]:
    """How many vertices are held, and how far the setup moves those that should not move, if there are any."""
    held = np.zeros(len(record.vertices), bool) if record.blend is None else record.blend == 0.0
    lines = [f"{int(held.sum())} vertices are held and do not move"] if held.any() else []
    soft = held[:0] if record.stays is None else record.stays & ~held
    if soft.any():
        farthest = float(np.linalg.norm(move.reached[soft], axis=1).max())
        lines.append(f"{int(soft.sum())} vertices should not move; the setup moves them by at most {farthest:.4g}")
    return lines


if __name__ == "__main__":
    parsers.start(main)
