"""Files as SU2 has them: meshes in two and three dimensions, surface_adjoint.csv, surface_sens.vtu."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pyvista as pv
import trimesh

BOXES = """FFD_NBOX= 2
FFD_NLEVEL= 1
FFD_TAG= MAIN_BOX
FFD_LEVEL= 0
FFD_DEGREE_I= 1
FFD_DEGREE_J= 1
FFD_PARENTS= 0
FFD_CHILDREN= 0
FFD_CORNER_POINTS= 4
-2.0 -1.0
2.0 -1.0
2.0 1.0
-2.0 1.0
FFD_CONTROL_POINTS= 8
0 0 0 -2.0 -1.0 -0.5
1 0 0 2.0 -1.0 -0.5
FFD_SURFACE_POINTS= 2
body 3 0.5 0.25 0.5
body 7 0.125 0.75 0.5
FFD_TAG= TAIL
FFD_SURFACE_POINTS= 0
"""


@dataclasses.dataclass(frozen=True)
class Flow:
    """A mesh about a body: points [n, d], the points of its markers, and the text of the file."""

    points: np.ndarray
    body: np.ndarray
    far: np.ndarray
    outward: np.ndarray
    text: str


def _file(points: np.ndarray, kind: int, cells: np.ndarray, part: int, markers: dict[str, np.ndarray]) -> str:
    found = [f"NDIME= {points.shape[1]}", f"NELEM= {len(cells)}"]
    found += [f"{kind} {' '.join(map(str, cell))} {i}" for i, cell in enumerate(cells.tolist())]
    found += [f"NPOIN= {len(points)}"]
    found += [f"{' '.join(map(repr, point))} {i}" for i, point in enumerate(points.tolist())]
    found += [f"NMARK= {len(markers)}"]
    for name, parts in markers.items():
        found += [f"MARKER_TAG= {name}", f"MARKER_ELEMS= {len(parts)}"]
        found += [f"{part} {' '.join(map(str, one))}" for one in parts.tolist()]
    return "\n".join(found) + "\n" + BOXES


def flow(dimension: int, seed: int = 0) -> Flow:
    """An ellipse in a ring of quadrilaterals, or an ellipsoid in two layers of prisms; points in any order."""
    rng = np.random.default_rng(seed)
    if dimension == 2:
        angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
        round_ = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        i = np.arange(40)
        faces = np.stack([i, np.roll(i, -1)], axis=1)
        stretch = np.array([1.0, 0.4])
    else:
        ball = trimesh.creation.icosphere(subdivisions=2)
        round_, faces, stretch = np.array(ball.vertices), np.array(ball.faces), np.array([1.0, 0.4, 0.7])
    q = len(round_)
    layers = [round_ * stretch, round_ * 1.8, round_ * 3.0]
    points = np.concatenate(layers) + 0.05
    order = rng.permutation(len(points))  # which layer's point stands where in the file
    place = np.argsort(order)
    surfaces = [place[faces + layer * q] for layer in range(3)]
    if dimension == 2:
        cells = np.concatenate([np.concatenate([a, b[:, ::-1]], axis=1) for a, b in itertools.pairwise(surfaces)])
    else:
        cells = np.concatenate([np.concatenate([a, b], axis=1) for a, b in itertools.pairwise(surfaces)])
    outward = round_ / stretch
    outward = np.concatenate([outward, round_, round_])[order]
    text = _file(
        points[order],
        9 if dimension == 2 else 13,
        cells,
        3 if dimension == 2 else 5,
        {"body": surfaces[0], "far": surfaces[2]},
    )
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return Flow(points[order], place[:q], place[2 * q :], outward, text)


def csv(made: Flow, vectors: np.ndarray, scalar: np.ndarray, first: str = "Point", vector: bool = True) -> str:
    """surface_adjoint.csv: all surface points in the order of processes, for values of all points [n, d] and [n]."""
    d = made.points.shape[1]
    letters = "xyz"[:d]
    names = [first, *letters, "Adjoint_Density", *(f"Adjoint_Momentum_{a}" for a in letters), "Adjoint_Energy"]
    names += [f"Sensitivity_{a}" for a in letters] if vector else []
    rows = np.random.default_rng(1).permutation(np.concatenate([made.body, made.far]))
    text = ",".join(f'"{name}"' for name in [*names, "Surface_Sensitivity"]) + "\n"
    for row in rows.tolist():
        adjoint = np.full(d + 2, 0.5 + row)
        values = [*made.points[row], *adjoint, *(vectors[row] if vector else []), scalar[row]]
        text += f"{row}, " + ", ".join(f"{value:.15e}" for value in values) + "\n"
    return text


def vtu(path: Path, made: Flow, vectors: np.ndarray, scalar: np.ndarray) -> Path:
    """surface_sens.vtu of SU2_DOT: single precision, in an order of its own, without numbers of points."""
    rows = np.random.default_rng(2).permutation(np.concatenate([made.body, made.far]))
    across = ((0, 0), (0, 3 - made.points.shape[1]))
    places = np.pad(made.points[rows], across).astype(np.float32)
    cells = np.stack([np.ones(len(rows), int), np.arange(len(rows))], axis=1).ravel()
    grid = pv.UnstructuredGrid(cells, np.full(len(rows), 1), places)
    grid.point_data["Sensitivity"] = np.pad(vectors[rows], across).astype(np.float32)
    grid.point_data["Surface_Sensitivity"] = scalar[rows].astype(np.float32)
    grid.save(path)
    return path
