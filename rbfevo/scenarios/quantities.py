"""Which quantity of a table is asked for, and which of its columns are ids."""

from __future__ import annotations

import dataclasses
import re

import numpy as np

from rbfevo.errors import UserError
from rbfevo.meshes.array_table import Table
from rbfevo.meshes.columns import Columns, Group
from rbfevo.meshes.mesh import FormatError
from rbfevo.scenarios.templates import Template

SCALAR = "surface_sensitivity"  # SU2's component along a normal, beside its vector; the sign depends on the program


def settled(columns: Columns, table: Table, template: Template) -> Columns:
    """The columns of a table, where those that may be ids by their name are ids or values by what they hold.

    They are ids where there are other values, and they hold unequal whole numbers from 0 (or the file's own numbers of
    its points) to the number of points of the mesh.
    """
    names, ids, values = table.header or [], list(columns.ids), list(columns.values)
    top = template.count if template.numbers is None else max(template.count, int(template.numbers.max()))
    for column in columns.doubtful:
        if values and _are_ids(table, column, top):
            ids.append(column)
        else:
            values.append(Group(names[column].strip().lower(), (column,)))
    values.sort(key=lambda group: group.columns[0])
    return dataclasses.replace(columns, ids=tuple(ids), values=tuple(values), doubtful=())


def chosen(table: Table, columns: Columns, what: str, named: str = "") -> Group:
    """The quantity of a table to use: the one that is `named`, else that named `what`, or the only one.

    Raises:
        UserError: if there is none, or several.
    """
    names = table.header or []
    groups = [*columns.values, *columns.aside]
    if not groups:
        listed = ", ".join(names)
        raise UserError(
            f"it holds only ids and coordinates ({listed}) and no values; name the columns of a vector {what}_x, "
            f"{what}_y, {what}_z"
        )
    if named:
        exact = [group for group in groups if named.lower() in (group.name, *_names(group, names))]
        if len(exact) != 1:
            listed = ", ".join(dict.fromkeys(group.name for group in groups))
            raise UserError(f"it has {len(exact) or 'no'} quantities named {named}; there are {listed}")
        return exact[0]
    own = [group for group in groups if re.fullmatch(rf"{re.escape(what)}(?:[:_ .-]?[0-2xyz])?", group.name)]
    near = [group for group in columns.values if "sens" in group.name] if what == "sensitivity" else []
    candidates = own or near or list(columns.values) or groups
    related = [*candidates, *(group for group in near if group not in candidates)]
    if len(related) > 1:
        zero = [group for group in related if not table.numbers(group.columns).any()]
        if zero and len(zero) < len(related):
            full = [group for group in related if group not in zero]
            raise UserError(
                f"{_headings(zero, names)} is zero in every row, {_headings(full, names)} is not: which one should be "
                "used? Remove the other one"
            )
    vectors = [group for group in candidates if len(group.columns) > 1]
    candidates = vectors if (own or near) and len(vectors) == 1 else candidates
    if len(candidates) != 1:
        raise UserError(
            f"it has {len(candidates)} columns or vectors of values "
            f"({'; '.join(_headings([g], names) for g in candidates)}); "
            f"name the one to use {what} (or {what}_x, {what}_y, {what}_z), give its name behind the file's, as in "
            f"FILE:{candidates[0].name}, or remove the others"
        )
    return candidates[0]


def beside(columns: Columns, vector: Group) -> tuple[int, ...]:
    """The column of SU2's scalar beside a vector of sensitivities, if there is one."""
    if len(vector.columns) == 1 or "sens" not in vector.name:
        return ()
    return next((group.columns for group in columns.values if group.name == SCALAR), ())


def remarks(table: Table, columns: Columns, vector: Group) -> list[str]:
    """What else the names of a table's columns say about its sensitivities, a line each."""
    adjoint = any(name.strip().lower().startswith("adjoint_") for name in table.header or [])
    if not adjoint or not beside(columns, vector):
        return []
    return [
        "of SU2_CFD_AD, since there are Adjoint_ columns: derivatives with the inside of the mesh at rest; those of "
        "SU2_DOT (surface_sens) are with the inside following the surface"
    ]


def _are_ids(table: Table, column: int, top: int) -> bool:
    """Whether a column holds unequal whole numbers from 0 to `top`."""
    try:
        numbers = table.numbers([column])[:, 0]
    except FormatError:  # names of points
        return False
    whole = bool((numbers == np.round(numbers)).all())
    return whole and len(np.unique(numbers)) == len(numbers) and numbers.min() >= 0 and numbers.max() <= top


def _names(group: Group, names: list[str]) -> list[str]:
    return [names[column].strip().lower() for column in group.columns]


def _headings(groups: list[Group], names: list[str]) -> str:
    return ", ".join(names[column] for group in groups for column in group.columns)
