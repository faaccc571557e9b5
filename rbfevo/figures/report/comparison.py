"""The comparison on the page of a sweep: the settings that differ, medians and quartiles, plain sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rbfevo.recorded import sweep
from rbfevo.recorded.record import PLAIN
from rbfevo.recorded.sweep import Group, Member


def comparison(members: Sequence[Member]) -> dict[str, Any]:
    """The groups of a sweep by mesh, the settings that distinguish them, and which is best.

    Meshes are numbered as they first occur among the members.
    """
    groups, varying = sweep.groups(members), sweep.varying(members)
    meshes = list(dict.fromkeys(member.settings["mesh"] for member in members))
    rivals = []
    for number, mesh in enumerate(meshes):
        here = [group for group in groups if group.settings["mesh"] == mesh]
        keys = [key for key in here[0].varying if len({group.settings[key] for group in here}) > 1]
        rivals += [_group(group, number, sweep.name_of(group, keys, here)) for group in sweep.rivals_of(here)]
    return {
        "varying": [key for key in varying if key not in ("mesh", "criterion.norm")],  # the mesh's name tells the norm
        "meshes": [_mesh(members, mesh) for mesh in meshes],
        "sentences": [sentence[0].upper() + sentence[1:] for sentence in sweep.best(groups)],
        "warnings": sweep.warnings(members),
        "groups": rivals,
    }


def _mesh(members: Sequence[Member], mesh: str) -> str:
    record = next(member.record for member in members if member.settings["mesh"] == mesh)
    searched = "" if record.potential_name == PLAIN else f", {record.potential_name}"
    return f"{record.summary.get('scenario', 'unknown')}, {len(record.vertices):,} vertices{searched} ({mesh})"


def _group(group: Group, mesh: int, label: str) -> dict[str, Any]:
    entry: dict[str, Any] = {"mesh": mesh, "label": label, "seeds": group.seeds, "runs": list(group.runs)}
    for key, (median, lower, upper) in group.spreads.items():
        entry[key] = {
            "median": _number(median),
            "first": _number(lower),
            "third": _number(upper),
            "values": [_number(value) for value in group.values[key]],
        }
    return entry


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
