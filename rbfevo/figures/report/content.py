"""The contents of a page: arrays as base64 of their bytes (little-endian), all else as JSON."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.figures import style
from rbfevo.figures.front import scale_of
from rbfevo.figures.report.surface import surface_of
from rbfevo.figures.series import HEURISTICS, kinds, series
from rbfevo.figures.space import stretch
from rbfevo.figures.view import standpoint
from rbfevo.recorded import hydra_files
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup, setup

MANY = 2_000  # setups of a sweep: above, each run shows its front and its heuristics only
MOST = 4_000  # setups of a run: above, of those that others dominate only some are shown
NUMBERS = 500_000  # coordinates of centers, 4 MB
EMBEDDED = 4_000_000  # numbers of residuals, for kernels whose formula the page does not know: 16 MB
ON_DARK = {
    style.BLUE: "#6aa5f5",
    style.MAGENTA: "#ff66bd",
    style.GREEN: "#6fcf72",
    style.ORANGE: "#ffa733",
    style.GREY: "#a8a8a8",
    style.RED: "#ff6b63",
}
SYMBOLS = {"o": "circle", "^": "triangle-up", "D": "diamond", "s": "square"}


class Shown(NamedTuple):
    """A run that a page shows.

    Attributes:
        name: what the page calls it; place: its directory as seen from the page's; directory: the same from here.
        settings: what it is compared by.
    """

    name: str
    place: str
    directory: Path
    record: Record
    settings: dict[str, Any]


def content(runs: Sequence[Shown], meshes: Sequence[str]) -> dict[str, Any]:
    """Everything that a page shows of `runs`, of which those with the same entry of `meshes` share mesh and gradient.

    Raises:
        UserError: if no run has a setup with finite centers and scores.
    """
    if not any(run.record.usable.size for run in runs):
        raise UserError("no setup has finite centers and scores")
    first = {mesh: run.record for mesh, run in zip(reversed(meshes), reversed(runs), strict=True)}
    order = list(dict.fromkeys(meshes))
    looks: dict[tuple[str, str], dict[str, Any]] = {}
    rows = _rows(runs)
    shown = {mesh: surface_of(record, *_vertices(len(order))).rows for mesh, record in first.items()}
    parts = [
        _run(run, order.index(mesh), kept, looks, shown[mesh], len(runs))
        for run, mesh, kept in zip(runs, meshes, rows, strict=True)
    ]
    every = sum(len(run.record.usable) for run in runs)
    return {
        "runs": parts,
        "series": list(looks.values()),
        "meshes": [_mesh(first[mesh], len(order)) for mesh in order],
        "logarithmic": _logarithmic(runs, rows),
        "left_out": every - sum(len(kept) for kept in rows),
        "colors": [[place / 255, _hex(style.ERROR(place))] for place in range(0, 256, 15)],
    }


def packed(array: Array, kind: str) -> str:
    """An array as base64 of its numbers of a NumPy `kind`, such as `<f8`, row by row."""
    return base64.b64encode(np.ascontiguousarray(array, dtype=kind).tobytes()).decode("ascii")


def _hex(color: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in color[:3])


def _rows(runs: Sequence[Shown]) -> list[Array]:
    """The rows of each run that a page shows: all usable ones, where there are not too many of them."""
    rows = [run.record.usable for run in runs]
    kept_always = [
        run.record.nondominated[kept] | np.isin(run.record.method[kept], HEURISTICS[1:])
        for run, kept in zip(runs, rows, strict=True)
    ]
    numbers = max(1, *(run.record.centers[0].size for run in runs))
    most = min(MANY if len(runs) > 1 else MOST, NUMBERS // numbers)
    if sum(map(len, rows)) <= most:
        return rows
    left = sum(int((~some).sum()) for some in kept_always)
    room = max(0, most - sum(int(some.sum()) for some in kept_always)) if len(runs) == 1 else 0
    found = []
    for kept, some in zip(rows, kept_always, strict=True):
        others = kept[~some][:: max(1, -(-left // room))] if room else kept[:0]
        found.append(np.sort(np.concatenate([kept[some], others])))
    return found


def _vertices(count: int) -> tuple[int, ...]:
    """How many vertices of each of `count` meshes are shown at most; nothing where the default will do."""
    return () if count == 1 else (max(2_000, 50_000 // count),)


def _left(record: Record, rows: Array, vertices: Array, room: int) -> tuple[list[int], str]:
    """The residuals of setups at the vertices shown: for which of `rows`, and float32 [rows, n, k], packed.

    The nondominated ones come first; no more than `room` numbers are given.
    """
    chosen_rows = np.argsort(~record.nondominated[rows], kind="stable")
    number = len(vertices) * record.gradient.shape[1]
    chosen_rows = np.sort(chosen_rows[: max(1, room // number)])
    left = []
    for row in rows[chosen_rows]:
        chosen = setup(record, int(row))
        weights = chosen.fit(record)
        left.append(record.gradient[vertices] - chosen.displacement(record.vertices[vertices], weights))
    return chosen_rows.tolist(), packed(np.array(left), "<f4")


def _run(
    run: Shown, mesh: int, rows: Array, looks: dict[tuple[str, str], dict[str, Any]], vertices: Array, count: int
) -> dict[str, Any]:
    record, summary = run.record, run.record.summary
    which = np.zeros(len(record.regularity), dtype=int)
    for (method, preferred), members in kinds(record).items():
        look = series(record, method, preferred)
        key = (look.label, look.marker + str(look.filled))
        looks.setdefault(
            key,
            {
                "label": look.label,
                "color": look.color,
                "dark": ON_DARK.get(look.color, look.color),
                "symbol": SYMBOLS[look.marker] + ("" if look.filled else "-open"),
                "size": round(1.35 * look.size**0.5, 1),
                "order": look.order,
            },
        )
        which[members] = list(looks).index(key)
    n, m = len(record.vertices), record.centers.shape[1]
    known = _setup(record, rows)
    mirror = known.mirror if known is not None else None
    centers = record.centers[rows]
    if mirror is not None:  # those on the symmetry plane are put exactly there
        centers = np.stack([setup(record, int(row)).centers for row in rows])
    formula = known.kernel.page if known is not None and known.kernel is not None and known.plain else None
    embedded = None
    if known is not None and formula is None:
        each = record.each()
        found = [_left(alone, rows, vertices, EMBEDDED // (count * len(each))) for alone in each]
        embedded = {"rows": found[0][0], "left": found[0][1] if len(each) == 1 else [left for _, left in found]}
    several = {} if record.gradients is None else {"objectives": _objectives(record, rows)}
    variability = record.variability if record.variability is not None else np.full(len(which), np.nan)
    return {
        "name": run.name,
        "place": shlex.quote(run.place),
        "mesh": mesh,
        "title": record.title,
        "kernel": summary.get("kernel"),
        "support": summary.get("support"),
        "scale": getattr(known.kernel, "scale", None) if known is not None else None,
        "manipulation": summary.get("manipulation"),
        "representation": "rbf" if known is None else known.representation.name,
        "mirror": None if mirror is None else {"axis": mirror.axis, "at": mirror.at},
        "known": known is not None and formula is not None,
        "formula": formula,
        "embedded": embedded,
        "settings": run.settings,
        "m": m,
        "stay": record.kept,
        "n": n,
        "rows": rows.tolist(),
        "series": which[rows].tolist(),
        "method": [record.origin(int(row)) for row in rows],
        "preference": [None if not np.isfinite(value) else value for value in record.preference[rows].tolist()],
        "nondominated": record.nondominated[rows].astype(int).tolist(),
        "regularity": packed(record.regularity[rows], "<f8"),
        "potential": packed(record.potential[rows], "<f8"),
        "potential_name": record.potential_name,
        "symbol": record.potential_symbol,
        "bounded": record.bounded_potential is not None,
        **several,
        "variability": packed(variability[rows], "<f8"),
        "centers": packed(centers, "<f8"),
        "made": made(run),
    }


def _objectives(record: Record, rows: Array) -> dict[str, Any]:
    """The potential of each of several objectives of the setups in `rows`, and how they are combined."""
    return {
        "names": list(record.objectives),
        "symbol": record.symbol_of_each,
        "combination": record.combination,
        "potentials": packed(record.potential_of_each[rows], "<f8"),
    }


def _setup(record: Record, rows: Array) -> Setup | None:
    """The first of some setups; None if there is none, or its kernel is not known here."""
    try:
        return setup(record, int(rows[0])) if len(rows) else None
    except UserError:  # a kernel that is unknown here still has centers to show
        return None


def _mesh(record: Record, count: int) -> dict[str, Any]:
    """Vertices, faces and gradient for a page that shows `count` meshes; of several objectives the first one's.

    Those of each are then among `objectives`.
    """
    whole, (record, *_) = record, record.each()
    surface = surface_of(record, *_vertices(count))
    d, towards, up = record.vertices.shape[1], np.array([1.0, -0.4, 0.9]), np.array([0.0, 0.0, 1.0])
    if d == 3:
        towards, up = standpoint(whole)
    factor, remark = stretch(record, np.linalg.norm(record.gradient, axis=1))
    several = {}
    if whole.gradients is not None:
        fields = zip(whole.objectives, whole.gradients, strict=True)
        several["objectives"] = [_field(record, surface.rows, name, gradient) for name, gradient in fields]
    uniform = np.ptp(surface.weights) == 0 and surface.weights[0] == 1
    return {
        "of": len(record.vertices),
        "n": len(surface.rows),
        "d": d,
        "k": record.gradient.shape[1],
        "vertices": packed(record.vertices[surface.rows], "<f8"),
        "faces": packed(surface.faces, "<u4"),
        "gradient": packed(record.gradient[surface.rows], "<f8"),
        "weights": None if uniform else packed(surface.weights, "<f8"),
        "blend": None if record.blend is None else packed(record.blend[surface.rows], "<f8"),
        "scale": record.gradient_norm,
        "direction": record.summary.get("gradient_is") == "direction",
        "stretch": factor,
        "remark": remark.strip().strip("()"),
        "towards": (towards / np.linalg.norm(towards)).tolist(),
        "up": up.tolist(),
        "extent": np.ptp(record.vertices, axis=0).tolist(),
        "scenario": record.summary.get("scenario"),
        **several,
    }


def _field(record: Record, vertices: Array, name: str, gradient: Array) -> dict[str, Any]:
    """The wanted displacement of one of several objectives at the vertices shown, and how it is drawn."""
    factor, remark = stretch(record, np.linalg.norm(gradient, axis=1))
    return {
        "name": name,
        "gradient": packed(gradient[vertices], "<f8"),
        "stretch": factor,
        "remark": remark.strip().strip("()"),
    }


def _logarithmic(runs: Sequence[Shown], rows: Sequence[Array]) -> bool:
    """Whether regularities are best seen on a logarithmic axis."""
    every, searched = [], []
    for run, kept in zip(runs, rows, strict=True):
        every.append(run.record.regularity[kept])
        searched.append(every[-1][~np.isin(run.record.method[kept], HEURISTICS)])
    return scale_of(np.concatenate(every), np.concatenate(searched)).logarithmic


def made(run: Shown) -> dict[str, Any]:
    """How a run was made: its command, settings, versions, counts and seconds."""
    entry = run.record.summary.get
    counted = {
        "evaluations": entry("evaluations"),
        "failed evaluations": entry("failed_evaluations"),
        "gradients": entry("gradients"),
        "seconds": entry("seconds"),
        "evaluations a second": entry("evaluations_per_second"),
        "hypervolume": entry("hypervolume"),
        "stopped by": entry("stop_reason"),
        "seed": entry("seed"),
        "device": entry("device"),
        "evaluator": entry("evaluator"),
        "threads": entry("threads"),
        "saved rows scored by": entry("scored_by"),
        "vertices": entry("vertices"),
        "vertices of the search": entry("search_vertices"),
    }
    return {
        "command": command(run.directory),
        "facts": {key: value for key, value in counted.items() if value is not None},
        "versions": entry("versions") or {},
        "notes": entry("notes") or {},
        "warnings": entry("warnings") or [],
    }


def command(directory: Path) -> str | None:
    """The command that made a run, as Hydra recorded it; None if there is no record."""
    try:
        saved = hydra_files.overrides(directory)
    except UserError:
        return None
    return None if saved is None else shlex.join(["python", "-m", "rbfevo", *saved])
