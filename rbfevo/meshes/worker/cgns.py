"""CGNS files by VTK: which patches are read, and zones put one after another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.meshes.vtk_datasets import grid
from rbfevo.meshes.worker.vtk_contents import arrays_of, cells_of, parts_of, points_of


def reader(path: Path, patches: str) -> Any:
    """VTK's reader of all bases, families and arrays of a file, and its `BndPatch` or its `SurfacePatch` as patches."""
    from vtkmodules.vtkIOCGNSReader import vtkCGNSReader

    made: Any = vtkCGNSReader()
    made.SetFileName(str(path))
    made.UpdateInformation()
    for part in ("Bases", "Families", "PointArrays", "CellArrays"):
        getattr(made, f"EnableAll{part}")()
    getattr(made, f"SetLoad{patches}")(True)
    return made


def lacks_patches(found: Any, complaints: str) -> bool:
    """Whether `BndPatch` leaves patches out of what was found: VTK takes the conditions of families alone.

    The sections of surface elements are the patches of other files (`SurfacePatch`). VTK 9.7 crashes where both are
    asked for at once.
    """
    return "Skipping BC_t" in complaints or not any("/Patches/" in name for name, _ in parts_of(found))


def zones(found: Any) -> tuple[Any, dict[str, Any]]:
    """One dataset of the zones, one after another, each with its patches' cells at its own points; patches by name."""
    parts: dict[str, list[tuple[str, Any]]] = {}
    for name, part in parts_of(found):
        zone, _, patch = name.replace("/Surfaces/", "/Patches/").partition("/Patches/")
        parts.setdefault(zone.removesuffix("/Internal"), []).append((patch, part))
    points, cells, arrays, cell_arrays, patches, first, count = [], [], [], [], {}, 0, 0
    for owned in parts.values():
        own = None
        for patch, part in sorted(owned, key=lambda item: item[0] != ""):
            places = points_of(part)
            if own is None:
                own = places
                points.append(places)
                arrays.append(arrays_of(part.GetPointData(), len(places)))
            elif not np.array_equal(own, places):
                continue  # a window of a structured zone: its cells are the boundary's
            block = cells_of(part)
            if block["face cells"].size:
                raise ValueError("its cells are polyhedra; convert the mesh to .vtu first")
            cells.append((block["kinds"], block["sizes"], block["corners"] + first))
            cell_arrays.append(arrays_of(part.GetCellData(), len(block["kinds"])))
            if patch:
                patches.setdefault(patch, []).append(np.arange(count, count + len(block["kinds"])))
            count += len(block["kinds"])
        first += len(own) if own is not None else 0
    if not points:
        raise ValueError("it holds no points; is it empty or damaged?")
    kinds, sizes, corners = (np.concatenate(column) for column in zip(*cells, strict=True))
    dataset = grid(
        np.concatenate(points),
        kinds,
        sizes,
        corners,
        _joined(arrays, [len(own) for own in points]),
        _joined(cell_arrays, [len(own) for own, _, _ in cells]),
    )
    return dataset, {name: np.concatenate(rows) for name, rows in patches.items()}


def _joined(parts: list[dict[str, Any]], counts: list[int]) -> dict[str, Any]:
    """Arrays of parts one after another; NaN where a part does not have one."""
    widths = {name: values.shape[1:] for own in parts for name, values in own.items()}
    return {
        name: np.concatenate(
            [own.get(name, np.full((n, *width), np.nan)) for own, n in zip(parts, counts, strict=True)]
        )
        for name, width in widths.items()
        if all(own[name].shape[1:] == width for own in parts if name in own)
    }
