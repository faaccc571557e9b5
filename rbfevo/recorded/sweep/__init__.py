"""The runs of a sweep side by side: finding and reading them, tidy tables, curves, and which setting is best."""

from rbfevo.recorded.sweep.comparison import best, name_of, rivals_of
from rbfevo.recorded.sweep.curves import Curve, advice, curves, table_of_curves
from rbfevo.recorded.sweep.members import Member, find, members, mesh_of
from rbfevo.recorded.sweep.sequences import NestedSequence, labels_of, table_of_sequences
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
    "Curve",
    "Group",
    "Line",
    "Member",
    "NestedSequence",
    "Spread",
    "advice",
    "best",
    "curves",
    "find",
    "groups",
    "hypervolume",
    "labels_of",
    "lines",
    "members",
    "mesh_of",
    "name_of",
    "nondominated",
    "rivals_of",
    "spread",
    "table_of_curves",
    "table_of_medians",
    "table_of_runs",
    "table_of_sequences",
    "varying",
    "warnings",
]
