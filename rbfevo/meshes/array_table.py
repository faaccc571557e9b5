"""Tables that are numbers from the start, with named columns as a text has them: arrays of a mesh's points."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from rbfevo.arrays import Array
from rbfevo.meshes.mesh import Mesh


class Table(Protocol):
    """Rows of numbers: names of its columns or None, how many there are, and notes."""

    @property
    def header(self) -> list[str] | None:
        """The columns' names."""
        ...

    @property
    def width(self) -> int:
        """How many columns there are."""
        ...

    @property
    def notes(self) -> list[str]:
        """What is worth knowing, a line each."""
        ...

    def numbers(self, columns: Sequence[int] | None = None) -> Array:
        """The `columns` (all without) as float64 [rows, columns]."""
        ...


@dataclasses.dataclass(frozen=True)
class ArrayTable:
    """A table in memory: the names of its columns, its values [r, c], and notes."""

    header: list[str]
    values: Array
    notes: list[str] = dataclasses.field(default_factory=list)

    @property
    def width(self) -> int:
        """How many columns there are."""
        return len(self.header)

    def numbers(self, columns: Sequence[int] | None = None) -> Array:
        """The `columns` (all without) as float64 [rows, columns]."""
        return self.values if columns is None else self.values[:, list(columns)]

    @staticmethod
    def of(points: Array, arrays: dict[str, Array], notes: Sequence[str] = ()) -> ArrayTable:
        """The table of points [r, 3] and their arrays, [r] or [r, k]; vectors of two components get a third, 0."""
        header, columns = ["x", "y", "z"], [points]
        for name, values in arrays.items():
            rows = values.reshape(len(points), -1)
            rows = np.pad(rows, ((0, 0), (0, 1))) if rows.shape[1] == 2 else rows
            one, three = rows.shape[1] == 1, rows.shape[1] == 3
            header += [name] if one else [f"{name}{'_' if three else ' '}{'xyz'[i] if three else i}" for i in
                                          range(rows.shape[1])]  # fmt: skip
            columns.append(rows)
        return ArrayTable(header, np.concatenate(columns, axis=1), list(notes))


def arrays_of(mesh: Mesh) -> ArrayTable:
    """The arrays of a mesh's points, with the points' coordinates."""
    notes = []
    if (mesh.points == mesh.points.astype(np.float32)).all():
        notes.append(
            "its coordinates have single precision: a CSV with all digits and the numbers of points is more certain, "
            "such as SU2's (SURFACE_CSV)"
        )
    return ArrayTable.of(mesh.points, mesh.arrays, notes)
