"""Nodes and elements that have numbers, as files of finite elements have them, become points and cells."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Ints
from rbfevo.meshes.mesh import Cells, FormatError


def places_of(wanted: Ints, numbers: Ints) -> tuple[Ints, NDArray[np.bool_]]:
    """Where numbers, of any shape, stand among the unequal `numbers` [n], and which of them do so at all."""
    order = np.argsort(numbers, kind="stable")
    place = order[np.minimum(np.searchsorted(numbers, wanted, sorter=order), len(numbers) - 1)]
    return place, numbers[place] == wanted


@dataclasses.dataclass(frozen=True)
class Connected:
    """Points [n, 3], cells among them, patches and, where they are unique, the numbers [n] of the points."""

    points: Array
    cells: Cells
    patches: dict[str, Ints]
    numbers: Ints | None


class Numbered:
    """Collects nodes and cells. Each `scope` (a part) has numbers of its own, and of cells each
    `collection` in it (Kratos' elements, conditions and geometries)."""

    def __init__(self) -> None:
        self._points: list[Sequence[float]] = []
        self._numbers: list[int] = []
        self._place: dict[tuple[str, int], int] = {}
        self._twice = 0
        self._kinds: list[int] = []
        self._nodes: list[tuple[str, Sequence[int]]] = []
        self._cell: dict[tuple[str, str, int], int] = {}
        self._patches: dict[str, list[int]] = {}
        self._scopes: set[str] = set()

    def node(self, number: int, place: Sequence[float], scope: str = "") -> None:
        """Add a node, of two or three coordinates."""
        self._twice += (scope, number) in self._place
        self._place[scope, number] = len(self._points)
        self._points.append([*place, 0.0][:3])
        self._numbers.append(number)
        self._scopes.add(scope)

    def cell(
        self,
        number: int,
        kind: int,
        nodes: Sequence[int],
        patches: Iterable[str] = (),
        scope: str = "",
        collection: str = "",
    ) -> None:
        """Add a cell of one of VTK's kinds, by the numbers of its nodes."""
        self._cell[scope, collection, number] = len(self._kinds)
        for patch in patches:
            self._patches.setdefault(patch, []).append(len(self._kinds))
        self._kinds.append(kind)
        self._nodes.append((scope, nodes))

    def patch(self, name: str, numbers: Iterable[int], scope: str = "", collection: str = "") -> None:
        """Add cells to a patch by their numbers; those that are none of the cells are passed over."""
        own = self._patches.setdefault(name, [])
        keys = [(scope, collection, number) for number in numbers]
        own.extend(self._cell[key] for key in keys if key in self._cell)

    def join(self, name: str, other: str) -> None:
        """Add the cells of another patch, if there is one, to a patch."""
        self._patches.setdefault(name, []).extend(self._patches.get(other, []))

    def mesh(self) -> Connected:
        """What was collected.

        Raises:
            FormatError: if there are no nodes, numbers of nodes are there twice, or cells refer to others.
        """
        if not self._points:
            raise FormatError("it holds no points; is it empty or damaged?")
        if self._twice:
            raise FormatError(f"{self._twice} numbers of nodes are there twice")
        lost = {node for scope, nodes in self._nodes for node in nodes if (scope, node) not in self._place}
        if lost:
            raise FormatError(f"its elements refer to {len(lost)} nodes that are not there, as {min(lost)}")
        corners = [[self._place[scope, node] for node in nodes] for scope, nodes in self._nodes]
        return Connected(
            np.array(self._points, np.float64),
            Cells.of(self._kinds, corners),
            {name: np.unique(np.array(own, np.int64)) for name, own in self._patches.items() if own},
            np.array(self._numbers, np.int64) if len(self._scopes) == 1 else None,
        )
