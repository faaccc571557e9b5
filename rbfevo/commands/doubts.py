"""What may be wrong with a deformed mesh, in sentences: cells turned inside out, another place or unit, folds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rbfevo import meshes
from rbfevo.arrays import Array
from rbfevo.geometry.triangles import doubled_area_vectors
from rbfevo.meshes.constraints import SLIP_TYPES
from rbfevo.meshes.surface import patch_points
from rbfevo.recorded.moves import within_bounds
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup

FAR = 0.01  # of the largest displacement of a center: what moves farther outside the box gets a warning


def warnings(
    record: Record, chosen: Setup, mesh: meshes.Mesh, moved: Array, length: Array | None, largest: float
) -> Iterator[str]:
    """What may be wrong with a deformation, a line each.

    Args:
        length: [q] of the displacements where all points follow the kernel; largest: of a displacement of a center.
    """
    places = mesh.points[:, : record.vertices.shape[1]]
    lowest, highest = places.min(axis=0), places.max(axis=0)
    apart = bool((lowest > record.upper).any() or (highest < record.lower).any())
    if chosen.support is not None:
        from scipy.spatial import KDTree

        nearest = KDTree(chosen.centers_and_images().points).query(places)[0].min()
        if nearest >= chosen.support:
            yield (
                f"no point of the mesh lies within the support radius {chosen.support:g} of a center (the nearest is "
                f"{nearest:.4g} away), so nothing moves; {_boxes(record, lowest, highest)}"
            )
            return
    if mesh.patch_types and length is not None:
        yield from _other_patches(record, mesh, length)
    if "case" in mesh.notes:
        own = {tuple(point) for point in mesh.points.tolist()}
        away = sum(tuple(point) not in own for point in record.vertices.tolist())
        if away:
            yield (
                f"{away} of {len(record.vertices)} vertices of the run's template are not among the "
                f"{mesh.notes['case']}; if the case has moved since the run, give --mesh an earlier time, as CASE/0"
            )
    if apart:
        yield f"the mesh lies outside the box of the run; {_boxes(record, lowest, highest)}"
    if chosen.support is None and length is not None:
        margin = 1e-9 * float(np.linalg.norm(record.upper - record.lower))
        outside = ((places < record.lower - margin) | (places > record.upper + margin)).any(axis=1)
        far = outside & (length > FAR * largest)
        if far.any():
            yield (
                f"the {chosen.name} kernel reaches everywhere: {int(far.sum())} points outside the box of the run "
                f"move by more than {100 * FAR:g} % of the largest displacement of a center, at most by "
                f"{length[far].max():.4g}"
            )
    triangles = meshes.cells.surface(mesh.points, mesh.cells).triangles
    turned = int((_dots(mesh.points, moved, triangles) < 0).sum())
    if turned:
        yield f"{turned} of {len(triangles)} triangles turn by more than 90 degrees: the surface may fold over"


def beyond_bounds(record: Record, reached: Array) -> str:
    """How far vertices of a run move beyond `scenario.max_displacement`; empty if none does.

    Args:
        reached: [n, k] displacements of the vertices of the run's template.
    """
    factor = within_bounds(record, reached)
    if record.max_displacement is None or factor > 1.0 - 1e-9:  # an export at its bound, rounded
        return ""
    lengths = np.linalg.norm(reached, axis=1)
    beyond = int((lengths > record.max_displacement).sum())
    return (
        f"{beyond} of {len(lengths)} vertices of the run's template move farther than scenario.max_displacement "
        f"allows, the worst {1.0 / factor:.4g} times as far; multiply the displacements by at most {factor:.4g}"
    )


def _other_patches(record: Record, mesh: meshes.Mesh, length: Array) -> Iterator[str]:
    """How far patches that are neither of the design surface nor planes of symmetry are moved."""
    template, farthest = {tuple(point) for point in record.vertices.tolist()}, {}
    for name, kind in mesh.patch_types.items():
        if kind in SLIP_TYPES or not len(mesh.patches[name]):
            continue
        points = patch_points(mesh, [name], "--mesh")
        others = [i for i in points.tolist() if tuple(mesh.points[i].tolist()) not in template]
        farthest[name] = float(length[others].max(initial=0.0))
    moved = {name: far for name, far in farthest.items() if far > FAR * float(length.max(initial=0.0))}
    if moved:
        listed = ", ".join(f"{name} by up to {far:.4g}" for name, far in moved.items())
        yield f"points beside the design surface move, too: {listed}; --volume laplace holds them"


def inverted(mesh: meshes.Mesh, moved: Array) -> str:
    """How many cells of a volume mesh a move turns inside out, and how far it may go; empty if there are none."""
    found = meshes.cells.volumes(mesh.points, moved, mesh.cells)
    turned, share = [], 1.0
    for volumes in found:
        bad = (volumes.before != 0) & (volumes.before * volumes.after <= 0)
        if bad.any():
            worst = float((volumes.after[bad] / volumes.before[bad]).min()) + 0.0  # no -0
            share = min(share, volumes.share)
            turned.append(f"{int(bad.sum())} of {len(bad)} {volumes.name} (the worst to {worst:.3g} times its volume)")
    if not turned:
        return ""
    return (
        f"the displacements turn {', '.join(turned)} inside out or flat, and no solver can use such a mesh; "
        f"multiply the displacements by less than {share:.3g}"
    )


def _boxes(record: Record, lowest: Array, highest: Array) -> str:
    def sides(lower: Array, upper: Array) -> str:
        return ", ".join(f"{axis} {a:.4g} .. {b:.4g}" for axis, a, b in zip("xyz", lower, upper, strict=False))

    return (
        "is the mesh in another place or unit than the run? "
        f"Mesh: {sides(lowest, highest)}; box of the run: {sides(record.lower, record.upper)}"
    )


def _dots(before: Array, after: Array, triangles: Array) -> Array:
    """Products [f] of the doubled area vectors of triangles before and after."""
    return (doubled_area_vectors(before, triangles) * doubled_area_vectors(after, triangles)).sum(axis=1)
