"""The contents of a mesh file, for people and for programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.geometry import topology
from rbfevo.geometry.triangles import triangle_areas
from rbfevo.meshes import cells, ending_of, is_case, opened
from rbfevo.meshes.mesh import Mesh
from rbfevo.meshes.surface import Surface
from rbfevo.scenarios.reading import surface
from rbfevo.scenarios.templates import template_of


def reported(path: Path, patches: list[str] | None = None) -> dict[str, Any]:
    """The contents of a file, as plain values.

    Keys: `file`, `format`, `points`, `vertices` (of the surface), `triangles`, `pieces`, `area`, `volume` (within a
    closed surface, else null), `cells` (how many of each kind), `box` (the lowest and highest corner), `arrays` and
    `cell_arrays` (by name: components, lowest, highest, and how many rows are not finite), `patches` (by name: cells),
    `patch_types` (of a case: the solver's type of each patch), `sensitivities` (of a case: what is known of each),
    `notes` (by title). Lengths are in the file's unit.

    Args:
        path: the file; patches: names of patches that make the surface, None for all.

    Raises:
        UserError: if it cannot be read.
    """
    with opened(path) as mesh:
        pass
    part = surface(path, mesh, patches)
    finite: Any = np.isfinite(mesh.points).all(axis=1)
    notes = mesh.notes | part.notes
    if not finite.all():
        notes["not finite"] = f"{int((~finite).sum())} of {len(finite)} points have coordinates that are not finite"
    found: dict[str, Any] = {
        "file": str(path),
        "format": "OpenFOAM case" if is_case(path) else ending_of(path)[1:].upper(),
        "points": len(mesh.points),
        "vertices": len(np.unique(part.triangles)),
        "triangles": len(part.triangles),
        "pieces": 0,
        "area": 0.0,
        "volume": None,
        "cells": cells.counts(mesh.cells),
        "box": [side(mesh.points[finite], axis=0).tolist() for side in (np.min, np.max)] if finite.any() else None,
        "arrays": {name: _described(values) for name, values in mesh.arrays.items()},
        "cell_arrays": {name: _described(values) for name, values in mesh.cell_arrays.items()},
        "patches": {name: len(members) for name, members in mesh.patches.items()},
        "patch_types": mesh.patch_types,
        "sensitivities": {name: meaning._asdict() for name, meaning in mesh.meanings.items()},
        "notes": notes,
    }
    if len(part.triangles):
        _measure(found, path, mesh, part)
    return found


def _measure(found: dict[str, Any], path: Path, mesh: Mesh, part: Surface) -> None:
    """Add the surface that the file would have as a template."""
    try:
        template = template_of(path, mesh, part)
    except UserError as error:
        found["notes"]["no template"] = str(error).removeprefix(f"{path}: ")
        return
    found["vertices"], found["triangles"] = len(template.vertices), len(template.triangles)
    edges = topology.edges_of(len(template.vertices), template.triangles)
    odd = topology.oddities(template.vertices, template.triangles, edges)
    found["area"] = float(triangle_areas(template.vertices, template.triangles).sum())
    found["pieces"] = topology.pieces(len(template.vertices), edges)
    if (edges.uses == 2).all() and "winding" not in odd:
        found["volume"] = topology.volume(template.vertices, template.triangles)
    found["notes"] |= template.notes | odd


def _described(values: Array) -> dict[str, Any]:
    rows = values.reshape(len(values), -1)
    whole = np.isfinite(rows).all(axis=1)
    return {
        "components": int(rows.shape[1]),
        "lowest": float(rows[whole].min()) if whole.any() else None,
        "highest": float(rows[whole].max()) if whole.any() else None,
        "not_finite": int((~whole).sum()),
    }


def lines(found: dict[str, Any]) -> list[str]:
    """The report in lines, for people."""
    listed = ", ".join(f"{count} {kind}" for kind, count in found["cells"].items()) or "no cells: a cloud"
    rows = [f"{found['file']}: {found['format']}, {found['points']} points; {listed}"]
    if found["box"]:
        sides = ", ".join(
            f"{axis} {low:.6g} to {high:.6g}" for axis, low, high in zip("xyz", *found["box"], strict=True)
        )
        rows.append(f"box: {sides}")
    if found["triangles"]:
        volume = "open, no volume" if found["volume"] is None else f"volume {found['volume']:.6g}"
        pieces = "1 piece" if found["pieces"] == 1 else f"{found['pieces']} pieces"
        rows.append(
            f"surface: {found['vertices']} vertices, {found['triangles']} triangles, {pieces}, "
            f"area {found['area']:.6g}, {volume}"
        )
    for title, key in (("point arrays", "arrays"), ("cell arrays", "cell_arrays")):
        if found[key]:
            rows.append(f"{title}:")
        for name, values in found[key].items():
            size = "" if values["components"] == 1 else f", {values['components']} components"
            span = "" if values["lowest"] is None else f": {values['lowest']:.6g} to {values['highest']:.6g}"
            gaps = f", {values['not_finite']} rows not finite" if values["not_finite"] else ""
            rows.append(f"  {name}{size}{span}{gaps}")
    if found["patches"]:
        kinds = {name: f"{kind}, " for name, kind in found["patch_types"].items()}
        listed = (f"{name} ({kinds.get(name, '')}{count} cells)" for name, count in found["patches"].items())
        rows.append("patches: " + ", ".join(listed))
    for name, known in found["sensitivities"].items():
        rows.append(f"sensitivity: {name}: {known['kind'] or 'not known whether integrated'} ({known['note']})")
    rows += [f"note: {title}: {note}" for title, note in found["notes"].items()]
    return rows
