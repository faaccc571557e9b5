"""The runs of a sweep side by side: finding and reading them, tidy tables, and which setting is best for a mesh."""

from rbfevo.recorded.sweep.comparison import best, name_of, rivals_of
from rbfevo.recorded.sweep.members import Member, find, members, mesh_of, natural
from rbfevo.recorded.sweep.tables import (
    ALWAYS,
    QUANTITIES,
    Group,
    Line,
    Spread,
    groups,
    hypervolume,
    lines,
    nondominated,
    spread,
    table_of_medians,
    table_of_runs,
    varying,
    warnings,
)

__all__ = [
    "ALWAYS",
    "QUANTITIES",
    "Group",
    "Line",
    "Member",
    "Spread",
    "best",
    "find",
    "groups",
    "hypervolume",
    "lines",
    "members",
    "mesh_of",
    "name_of",
    "natural",
    "nondominated",
    "rivals_of",
    "spread",
    "table_of_medians",
    "table_of_runs",
    "varying",
    "warnings",
]
