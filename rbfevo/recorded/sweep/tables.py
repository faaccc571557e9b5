"""A sweep in tidy tables: what each run found, medians and quartiles over seeds; settings that differ.

Runs that differ in their seed alone are one group; a group is summed up by medians and quartiles (interpolated
linearly, NumPy's default).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.files import csv_text
from rbfevo.recorded.record import OF_EACH, PLAIN, Record, knee
from rbfevo.recorded.sweep.members import Member

# What a run is about, in this order; `mesh` is the fingerprint of `mesh_of`, `support` the radius in model units.
FIRST = ("scenario", "mesh", "kernel", "support", "manipulation", "method", "centers", "preference")
ALWAYS = (*FIRST[:4], "kernel.support", *FIRST[4:7])  # columns of every table; the radius as it was given, too
# Settings that show in the fingerprint of mesh and gradient, whatever the files are called.
SEEN_IN_MESH = tuple(
    f"scenario.{key}"
    for key in (
        *("template", "patches", "target", "sensitivity", "sensitivity_kind", "sensitivity_match", "objective"),
        *("sensitivity_normal", "target_scale", "reject", "weights", "smooth", "objective_weights", "combine"),
        *("resolution", "subdivisions", "scan", "up", "front"),
    )
)
SEEN_IN_SUPPORT = ("kernel.support", "scenario.support")
QUANTITIES = (
    *("hypervolume", "best_regularity", "best_improvement_potential", "knee_regularity", "knee_improvement_potential"),
    *("evaluations", "seconds"),
)
ALL = "all"  # the series of all rows of a run


class Line(NamedTuple):
    """What one series of one run found: `all` rows of setups.npz, or those of one method, or of one label.

    Attributes:
        settings: those of `ALWAYS` and those that vary in the sweep, of the whole run.
        setups, nondominated: rows with finite centers and scores, those of them that no row of the run dominates.
        hypervolume, ...: of this series' rows, with the potential that was searched; NaN where there is none.
        evaluations, ...: of the whole run.
        of_each: of several objectives the best potential of each, and that at the knee, by the names of columns.
    """

    run: str
    settings: dict[str, Any]
    series: str
    seed: int | None
    setups: int
    nondominated: int
    hypervolume: float
    best_regularity: float
    best_improvement_potential: float
    knee_regularity: float
    knee_improvement_potential: float
    evaluations: float
    failed_evaluations: float
    seconds: float
    stop_reason: str
    of_each: dict[str, float] = {}  # noqa: RUF012 - nothing changes it


class Spread(NamedTuple):
    """The median and the first and third quartile of a quantity; NaN where no run has it."""

    median: float
    lower: float
    upper: float


class Group(NamedTuple):
    """The same series of runs that differ in nothing but the seed.

    Attributes:
        settings: those of `ALWAYS` and those that vary in the sweep; varying: the keys of the latter.
        vertices: of the mesh; setups: the largest number of setups a run has; potential: the name of what was searched.
        runs: names; seeds: how many different ones there are; spreads, values: of each
            of `QUANTITIES`, over the runs and of each run.
    """

    settings: dict[str, Any]
    varying: tuple[str, ...]
    series: str
    vertices: int
    setups: int
    runs: tuple[str, ...]
    seeds: int
    spreads: dict[str, Spread]
    values: dict[str, tuple[float, ...]]
    potential: str = PLAIN


def varying(members: Sequence[Member]) -> list[str]:
    """The settings that differ among the members, but for the seed, and without those that follow from others.

    A default that comes with the mesh, the kernel or the method follows from it (the support radius from the mesh and
    the kernel, `method.generations` and the preferences from the method). Settings that merely happen to go together
    are both listed, since it is not known which of them matters.
    """
    left_out = ("seed", *SEEN_IN_MESH, *SEEN_IN_SUPPORT)
    keys = dict.fromkeys([*FIRST, *(key for member in members for key in member.settings)])
    listed: list[str] = []
    for key in keys:
        if key in left_out or len({member.settings.get(key) for member in members}) == 1:
            continue
        origins = [origin for origin in listed if origin in origins_of(key)]
        values: dict[tuple[Any, ...], set[Any]] = {}
        for member in members:
            before = tuple(member.settings.get(origin) for origin in origins)
            values.setdefault(before, set()).add(member.settings.get(key))
        if not origins or any(len(several) > 1 for several in values.values()):
            listed.append(key)
    return listed


def origins_of(key: str) -> tuple[str, ...]:
    """The settings that a default of `key` follows from."""
    special = {"support": ("mesh", "kernel"), "preference": ("method",)}
    group = key.split(".")[0]
    return special.get(key, () if group == key else ("mesh",) if group == "scenario" else (group,))


def lines(members: Sequence[Member]) -> list[Line]:
    """The tidy table: a line for each run and series, `all` first."""
    keys = _columns(members)
    return [line for member in members for line in _lines(member, keys)]


def _columns(members: Sequence[Member]) -> list[str]:
    return list(dict.fromkeys([*ALWAYS, *varying(members)]))


def _lines(member: Member, keys: Iterable[str]) -> Iterator[Line]:
    record, entry = member.record, member.record.summary.get
    usable, origins = record.usable, np.array([record.origin(row) for row in range(len(record.method))], dtype=np.str_)
    for series in (ALL, *dict.fromkeys(origins.tolist())):
        rows = usable if series == ALL else usable[origins[usable] == series]
        R, P = record.regularity[rows], record.potential[rows]
        found = knee(_part(record, rows))
        yield Line(
            run=member.name,
            settings={key: member.settings.get(key) for key in keys},
            series=series,
            seed=member.settings.get("seed"),
            setups=len(rows),
            nondominated=int(record.nondominated[rows].sum()),
            hypervolume=hypervolume(R, P),
            best_regularity=float(R.max()) if len(rows) else math.nan,
            best_improvement_potential=float(P.max()) if len(rows) else math.nan,
            knee_regularity=math.nan if found is None else float(R[found]),
            knee_improvement_potential=math.nan if found is None else float(P[found]),
            evaluations=_number(entry("evaluations")),
            failed_evaluations=_number(entry("failed_evaluations")),
            seconds=_number(entry("seconds")),
            stop_reason=str(entry("stop_reason", "")),
            of_each=_of_each(record, rows, found),
        )


def _of_each(record: Record, rows: Array, knee: int | None) -> dict[str, float]:
    """The best potential of each of several objectives among rows, and that of the row of the knee among them."""
    found = {}
    for name, values in zip(record.objectives, record.potential_of_each[rows].T, strict=True):
        found[f"best_potential_{name}"] = float(values.max()) if len(rows) else math.nan
        found[f"knee_potential_{name}"] = math.nan if knee is None else float(values[knee])
    return found


def _part(record: Record, rows: Array) -> Record:
    """The record of some of the rows, with the front among themselves."""
    names = ("centers", "regularity", "improvement_potential", "method", "preference")
    arrays = {name: getattr(record, name)[rows] for name in names}
    for name in ("bounded_potential", *OF_EACH):
        if (whole := getattr(record, name)) is not None:
            arrays[name] = whole[rows]
    front = nondominated(arrays["regularity"], record.potential[rows])
    return dataclasses.replace(record, **arrays, nondominated=front)


def _number(value: Any) -> float:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def hypervolume(R: Array, P: Array) -> float:
    """The area that rows [p] dominate above (0, 0), R and P maximized; rows that are not finite are left out."""
    finite = np.isfinite(R) & np.isfinite(P)
    levels, highest, _ = _staircase(np.maximum(R[finite], 0.0), np.maximum(P[finite], 0.0))
    return float((np.diff(levels, prepend=0.0) * highest).sum())


def nondominated(R: Array, P: Array) -> Array:
    """Which of the rows [p], all finite, no other one dominates, R and P maximized; duplicates are treated alike."""
    _, highest, level = _staircase(R, P)
    beyond = np.append(highest[1:], -math.inf)  # the largest P of all with a larger R
    return (highest[level] <= P) & (beyond[level] < P)


def _staircase(R: Array, P: Array) -> tuple[Array, Array, Array]:
    """The distinct R in rising order, the largest P of the rows with at least that R, and the rows' places there."""
    levels, level = np.unique(R, return_inverse=True)
    highest = np.full(len(levels), -math.inf)
    np.maximum.at(highest, level, P)
    return levels, np.maximum.accumulate(highest[::-1])[::-1], level


def groups(members: Sequence[Member], found: Sequence[Line] | None = None) -> list[Group]:
    """The lines whose settings and series are the same, all but the seed; in the order in which they first occur.

    Args:
        found: `lines(members)`, if there are any already.
    """
    vary = tuple(varying(members))
    gathered: dict[tuple[Any, ...], list[Line]] = {}
    records = {member.name: member.record for member in members}
    for line in lines(members) if found is None else found:
        alike = (line.settings["mesh"], *(line.settings[key] for key in vary), line.series)
        gathered.setdefault(alike, []).append(line)
    return [
        Group(
            settings=found[0].settings,
            varying=vary,
            series=found[0].series,
            vertices=len(records[found[0].run].vertices),
            setups=max(line.setups for line in found),
            runs=tuple(line.run for line in found),
            seeds=len({line.seed for line in found}),
            spreads={key: spread(getattr(line, key) for line in found) for key in QUANTITIES},
            values={key: tuple(float(getattr(line, key)) for line in found) for key in QUANTITIES},
            potential=records[found[0].run].potential_name,
        )
        for found in gathered.values()
    ]


def spread(values: Iterable[float]) -> Spread:
    """Median and quartiles of the values that are finite, interpolated linearly."""
    finite = [value for value in values if math.isfinite(value)]
    return Spread(*map(float, np.quantile(finite, [0.5, 0.25, 0.75]))) if finite else Spread(*[math.nan] * 3)


def table_of_runs(lines: Sequence[Line]) -> bytes:
    """runs.csv: `lines`, with a column for each setting, and for the potentials of each of several objectives."""
    at = Line._fields.index("settings")
    each = list(dict.fromkeys(name for line in lines for name in line.of_each))
    names = [*Line._fields[:at], *lines[0].settings, *Line._fields[at + 1 : -1], *each]
    own = ([line.of_each.get(name, math.nan) for name in each] for line in lines)
    rows = (
        (*line[:at], *line.settings.values(), *line[at + 1 : -1], *more) for line, more in zip(lines, own, strict=True)
    )
    return csv_text(names, rows)


def table_of_medians(groups: Sequence[Group]) -> bytes:
    """medians.csv: `groups`, with a column for each setting, and the median and both quartiles of each quantity."""
    names = [*groups[0].settings, "series", "runs", "seeds"]
    names += [f"{key}_{what}" for key in QUANTITIES for what in ("median", "q1", "q3")]
    rows = []
    for group in groups:
        numbers = [number for key in QUANTITIES for number in group.spreads[key]]
        rows.append([*group.settings.values(), group.series, len(group.runs), group.seeds, *numbers])
    return csv_text(names, rows)


def warnings(members: Sequence[Member]) -> list[str]:
    """What makes a comparison less certain, a line each: equal runs, and runs that were stopped."""
    keys = ["seed", "mesh", *varying(members)]
    same: dict[tuple[Any, ...], list[str]] = {}
    for member in members:
        same.setdefault(tuple(member.settings.get(key) for key in keys), []).append(member.name)
    found = [
        f"{', '.join(names)}: these runs have the same settings and seed; each of them counts"
        for names in same.values()
        if names[1:]
    ]
    for member in members:
        reason = str(member.record.summary.get("stop_reason", "budget"))
        if reason.startswith("interrupted") or reason == "error":
            found.append(f"{member.name}: this run was stopped early ({reason}); it counts like the others")
    return found
