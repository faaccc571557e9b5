"""Nested sequences beside a sweep: which ones its runs call for, and the files that hold them, read without torch."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rbfevo.files import csv_text
from rbfevo.recorded.sweep.comparison import description
from rbfevo.recorded.sweep.members import Member
from rbfevo.recorded.sweep.tables import ALWAYS, varying

FILE = "sequence.csv"  # of a run, and of a sweep
FREE = ("method", "centers", "seed", "preference")  # settings on which no sequence depends
AXES = ("x", "y", "z")


class NestedSequence(NamedTuple):
    """Centers placed one after the other by OLS on one design, and what the first 1, 2, ... m of them score.

    Attributes:
        key: a fingerprint of the settings that it depends on; mesh: of vertices and gradient; settings: shown ones.
        regularity, improvement_potential: [m]; bounded_potential: [m] where that was searched, else None.
        points: [m] of [d] coordinates, in the order placed; note: why there are no more, or empty.
    """

    key: str
    mesh: str
    settings: dict[str, Any]
    regularity: list[float]
    improvement_potential: list[float]
    bounded_potential: list[float] | None
    points: list[list[float]]
    note: str = ""

    @property
    def potential(self) -> list[float]:
        """The potential that was searched."""
        return self.improvement_potential if self.bounded_potential is None else self.bounded_potential


def key_of(member: Member) -> str:
    """Eight hexadecimal digits for the settings of a run that its nested sequence depends on."""
    counted = {key: value for key, value in member.settings.items() if not _is_free(key)}
    return hashlib.blake2b(json.dumps(counted, sort_keys=True, default=str).encode(), digest_size=4).hexdigest()


def _is_free(key: str) -> bool:
    return key in FREE or key.startswith("method.")


def shown_settings(members: Sequence[Member]) -> list[str]:
    """The settings of a sweep that tell its sequences apart."""
    keys = dict.fromkeys([*ALWAYS, *varying(members)])
    return [key for key in keys if key != "mesh" and not _is_free(key)]


def wanted(members: Sequence[Member], meshes: Sequence[str]) -> dict[str, Member]:
    """For each sequence that the runs on some meshes call for, by its key, the first of these runs."""
    found: dict[str, Member] = {}
    for member in members:
        if member.settings["mesh"] in meshes:
            found.setdefault(key_of(member), member)
    return found


def of_runs(members: Sequence[Member], directory: Path, keys: Sequence[str]) -> dict[str, NestedSequence]:
    """The longest sequence that runs of `method=ols` below a sweep's directory have left, by its key."""
    found: dict[str, NestedSequence] = {}
    for member in members:
        for rows in _rows(directory / member.name / FILE).values():
            sequence = _sequence(key_of(member), member, keys, rows)
            if sequence is not None:
                known = found.get(sequence.key)
                if known is None or len(known.points) < len(sequence.points):
                    found[sequence.key] = sequence
    return found


def read(path: Path, wanted: dict[str, Member], keys: Sequence[str]) -> dict[str, NestedSequence]:
    """The sequences of a sweep's file that are still wanted, by key; none of a file that cannot be read."""
    rows = _rows(path)
    found = {key: _sequence(key, member, keys, rows.get(key, [])) for key, member in wanted.items()}
    return {key: sequence for key, sequence in found.items() if sequence is not None}


def _rows(path: Path) -> dict[str, list[dict[str, str]]]:
    """The lines of a file, by their key, which those of a run do not have."""
    try:
        lines = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, csv.Error):
        return {}
    found: dict[str, list[dict[str, str]]] = {}
    for line in lines:
        found.setdefault(line.get("key") or "", []).append(line)
    return found


def _sequence(key: str, member: Member, keys: Sequence[str], rows: list[dict[str, str]]) -> NestedSequence | None:
    """A sequence from its lines; None where they are not all there, or not of the potential that was searched."""
    bounded = member.record.bounded_potential is not None
    axes = AXES[: member.record.vertices.shape[1]]
    names = ("regularity", "improvement_potential", *(("bounded_potential",) if bounded else ()), *axes)
    try:
        columns = {name: [float(row[name]) for row in rows] for name in names}
        numbers = [int(row["centers"]) for row in rows]
    except (KeyError, TypeError, ValueError):
        return None
    whole = all(math.isfinite(value) for column in columns.values() for value in column)
    if not rows or not whole or numbers != list(range(1, len(rows) + 1)):
        return None
    return NestedSequence(
        key=key,
        mesh=member.settings["mesh"],
        settings={name: member.settings.get(name) for name in keys},
        regularity=columns["regularity"],
        improvement_potential=columns["improvement_potential"],
        bounded_potential=columns.get("bounded_potential"),
        points=[list(point) for point in zip(*(columns[axis] for axis in axes), strict=True)],
        note=rows[-1].get("note") or "",
    )


def cut(sequence: NestedSequence, most: int) -> NestedSequence:
    """The first `most` centers of a sequence."""
    if len(sequence.points) <= most:
        return sequence
    bounded = sequence.bounded_potential
    return sequence._replace(
        regularity=sequence.regularity[:most],
        improvement_potential=sequence.improvement_potential[:most],
        bounded_potential=None if bounded is None else bounded[:most],
        points=sequence.points[:most],
        note="",
    )


def table_of_sequences(sequences: Sequence[NestedSequence]) -> bytes:
    """sequence.csv of a sweep: for each sequence a line for each number of centers, the last one with the note."""
    bounded = any(sequence.bounded_potential is not None for sequence in sequences)
    axes = AXES[: max(len(sequence.points[0]) for sequence in sequences)]
    names = ["key", "mesh", *sequences[0].settings, "centers", "regularity", "improvement_potential"]
    names += [*(["bounded_potential"] if bounded else []), *axes, "note"]
    rows = []
    for sequence in sequences:
        last = len(sequence.points)
        for i, point in enumerate(sequence.points):
            values: list[Any] = [sequence.regularity[i], sequence.improvement_potential[i]]
            if bounded:
                values.append(math.nan if sequence.bounded_potential is None else sequence.bounded_potential[i])
            place = [*point, *[math.nan] * (len(axes) - len(point))]
            settled = [sequence.key, sequence.mesh, *sequence.settings.values(), i + 1]
            rows.append([*settled, *values, *place, sequence.note if i + 1 == last else ""])
    return csv_text(names, rows)


def labels_of(sequences: Sequence[NestedSequence]) -> list[str]:
    """What pictures call the sequences: by the settings that tell those of one mesh apart."""
    labels = []
    for sequence in sequences:
        here = [other.settings for other in sequences if other.mesh == sequence.mesh]
        keys = [key for key in sequence.settings if len({str(settings[key]) for settings in here}) > 1]
        apart = description(
            sequence.settings, [key for key in keys if not (key == "kernel.support" and "support" in keys)]
        )
        labels.append(f"nested OLS sequence{apart and f' ({apart})'}")
    return labels
