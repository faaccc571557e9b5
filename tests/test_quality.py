"""Non-orthogonality and skewness by value, and as OpenFOAM's checkMesh has them where it is installed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from grids import hexahedra, polyhedra

from rbfevo.meshes import cells, faces
from rbfevo.meshes.faces import Between, alike, edges_of
from rbfevo.meshes.mesh import Cells
from rbfevo.meshes.quality import Quality, qualities


def quality(points: Any, moved: Any, mesh_cells: Cells) -> tuple[Quality, Quality]:
    return qualities(points, moved, Between.of(cells.faces_of(mesh_cells)))


@pytest.mark.parametrize("kind", ["hexahedra", "polyhedra"])
@pytest.mark.parametrize("origin", [0.0, 1e4])
def test_a_sheared_grid_has_the_angle_of_the_shear(kind: str, origin: float) -> None:
    points, corners = hexahedra(np.linspace(0, 3, 4), np.linspace(0, 2, 3), np.linspace(0, 4, 5))
    listed = polyhedra(corners) if kind == "polyhedra" else Cells.blocks([(12, corners)])
    for degrees in (10.0, 30.0):
        sheared = points.copy()
        sheared[:, 0] += np.tan(np.radians(degrees)) * points[:, 2]
        before, after = quality(points + origin, sheared + origin, listed)
        assert before.non_orthogonality == pytest.approx(0, abs=1e-5)
        assert before.skewness == pytest.approx(0, abs=1e-9)
        # Across a face of constant z lie centres that are a sheared edge apart: at the angle of the shear.
        assert after.non_orthogonality == pytest.approx(degrees, abs=1e-6)
        # Inner faces are not skewed. At the boundary of constant z the centre lies tan / 2 beside the cell's, and the
        # face reaches half an edge that way.
        assert after.skewness == pytest.approx(np.tan(np.radians(degrees)), abs=1e-9)


@pytest.mark.parametrize("height", [0.5, 1.0, 4.0])
def test_three_boxes_of_which_the_middle_one_slopes(height: float) -> None:
    points, corners = hexahedra(np.array([0.0, 1.0, 4.0, 7.0]), np.array([0.0, 1.0]), np.array([0.0, height]))
    moved = points + [0, 0, 1] * (points[:, :1] >= 4.0)
    before, after = quality(points, moved, Cells.blocks([(12, corners)]))
    assert before.non_orthogonality == pytest.approx(0, abs=1e-5)
    # The centres lie at x = 0.5, 2.5, 5.5, and at z = 0, 0.5, 1 from the middle of the first.
    assert after.non_orthogonality == pytest.approx(np.degrees(np.arctan2(0.5, 2.0)), abs=1e-6)
    # d meets x = 1 at z = 0.125 and x = 4 at 0.75, where the faces' centres are at 0 and 1; these reach height / 2.
    inner = 0.125 / max(height / 2, 0.2 * np.hypot(2.0, 0.5)), 0.25 / max(height / 2, 0.2 * np.hypot(3.0, 0.5))
    # The sloping faces: the foot of the centre lies height / 2 sin(slope) beside f; they reach sqrt 10 / 2.
    slope = height / 2 / np.sqrt(10) / max(np.sqrt(10) / 2, 0.4 * height / 2 * 3 / np.sqrt(10))
    assert after.skewness == pytest.approx(max(*inner, slope), abs=1e-12)


def test_a_pyramid_on_a_box() -> None:
    points, corners = hexahedra(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    apex, top = [0.5 + 0.6, 0.5, 1.0 + 2.0], corners[0, 4:].tolist()
    listed = Cells.of([12, 14], [corners[0].tolist(), [*top, 8]])
    before, _ = quality(np.concatenate([points, [apex]]), np.concatenate([points, [apex]]), listed)
    # The centre of a pyramid lies a quarter of the way from its base to its apex.
    assert before.non_orthogonality == pytest.approx(np.degrees(np.arctan2(0.6 / 4, 0.5 + 2.0 / 4)), abs=1e-9)


def test_keys_that_collide_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes, listed = np.array([3, 3, 3]), np.array([0, 1, 2, 3, 4, 5, 2, 0, 1])
    for factor in (faces._FACTOR, np.uint64(0)):
        monkeypatch.setattr(faces, "_FACTOR", factor)
        number = alike(sizes, listed)
        assert number[0] == number[2] != number[1]


def test_a_face_turned_over_exceeds_90_degrees() -> None:
    points, corners = hexahedra(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    moved = points.copy()
    moved[points[:, 0] == 1.0, 0] = 2.5
    _, after = quality(points, moved, Cells.blocks([(12, corners)]))
    assert after.non_orthogonality == pytest.approx(0, abs=1e-5)  # a face beyond both centres is still square to d
    turned = points * [-1, 1, 1]
    _, after = quality(points, turned, Cells.blocks([(12, corners)]))
    assert after.non_orthogonality == pytest.approx(180, abs=1e-5)


def test_faces_and_edges_once_each() -> None:
    points, corners = hexahedra(np.arange(3.0), np.arange(4.0), np.arange(5.0))
    between = Between.of(cells.faces_of(Cells.blocks([(12, corners)])))
    assert len(between.sizes) == 3 * 3 * 4 + 2 * 4 * 4 + 2 * 3 * 5
    assert len(between.outer) == 2 * (2 * 3 + 3 * 4 + 2 * 4)
    edges = edges_of(between.sizes, between.corners)
    assert len(edges) == 2 * 4 * 5 + 3 * 3 * 5 + 3 * 4 * 4
    np.testing.assert_array_equal(np.abs(points[edges[:, 0]] - points[edges[:, 1]]).sum(axis=1), 1)
    number = alike(np.array([3, 4, 3, 3]), np.array([4, 7, 1, 0, 1, 2, 3, 1, 4, 7, 1, 4, 8]))
    assert number[0] == number[2]
    assert len(set(number.tolist())) == 3


KINDS = {10: 6, 12: 12, 13: 9, 14: 8, 11: 12}


@pytest.mark.parametrize("kind", KINDS)
def test_edges_of_every_kind(kind: int) -> None:
    corners = np.arange({10: 4, 12: 8, 13: 6, 14: 5, 11: 8}[kind])[None]
    listed = cells.faces_of(Cells.blocks([(kind, corners)]))
    edges = edges_of(listed.sizes, listed.corners)
    assert len(edges) == KINDS[kind]
    if kind == 11:  # a voxel's corners count in binary: along an edge one digit changes
        assert all(bin(a ^ b).count("1") == 1 for a, b in edges.tolist())


def write_case(case: Path, points: Any, between: Between) -> None:
    """An OpenFOAM case of a mesh, with one patch."""
    starts = np.cumsum(between.sizes) - between.sizes
    corners = [between.corners[s : s + k].tolist() for s, k in zip(starts, between.sizes, strict=True)]
    owner, neighbour = between.owner.copy(), between.neighbour.copy()
    inner = np.flatnonzero(neighbour >= 0)
    for face in inner[owner[inner] > neighbour[inner]]:
        owner[face], neighbour[face] = neighbour[face], owner[face]
        corners[face] = corners[face][::-1]
    order = [*inner[np.lexsort((neighbour[inner], owner[inner]))], *between.outer[np.argsort(owner[between.outer])]]

    def write(name: str, kind: str, rows: list[str]) -> None:
        head = f"FoamFile {{ version 2.0; format ascii; class {kind}; object {name}; }}\n"
        where = case / "constant" / "polyMesh" / name
        where.parent.mkdir(parents=True, exist_ok=True)
        where.write_text(f"{head}{len(rows)}\n(\n" + "\n".join(rows) + "\n)\n")

    write("points", "vectorField", [f"({x!r} {y!r} {z!r})" for x, y, z in points.tolist()])
    write("faces", "faceList", [f"{len(corners[f])}({' '.join(map(str, corners[f]))})" for f in order])
    write("owner", "labelList", [str(owner[f]) for f in order])
    write("neighbour", "labelList", [str(neighbour[f]) for f in order[: len(inner)]])
    patch = f"all {{ type wall; nFaces {len(between.outer)}; startFace {len(inner)}; }}"
    write("boundary", "polyBoundaryMesh", [patch])
    (case / "system").mkdir()
    header = "FoamFile { version 2.0; format ascii; class dictionary; object controlDict; }\n"
    schemes = " ".join(f"{name}Schemes {{ default none; }}" for name in ("ddt", "grad", "div", "laplacian", "snGrad"))
    (case / "system" / "fvSchemes").write_text(f"{header}{schemes} interpolationSchemes {{ default none; }}")
    (case / "system" / "fvSolution").write_text(header)
    keys = "application none; startFrom startTime; startTime 0; stopAt endTime; endTime 1; deltaT 1;"
    (case / "system" / "controlDict").write_text(f"{header}{keys} writeControl timeStep; writeInterval 1;\n")


@pytest.mark.skipif(shutil.which("checkMesh") is None, reason="OpenFOAM is not installed")
def test_beside_check_mesh(tmp_path: Path) -> None:
    points, corners = hexahedra(np.linspace(0, 2, 7), np.linspace(0, 1, 5), np.linspace(0, 1.5, 6) ** 2)
    moved = points + 0.02 * np.random.default_rng(4).uniform(-1, 1, points.shape)
    between = Between.of(cells.faces_of(Cells.blocks([(12, corners)])))
    write_case(tmp_path, moved, between)
    place = {"WM_PROJECT_DIR": "/usr/share/openfoam"} | dict(os.environ)
    said = subprocess.run(
        ["checkMesh", "-case", str(tmp_path)], env=place, capture_output=True, text=True, check=False
    ).stdout
    angle = re.search(r"non-orthogonality Max: ([\d.]+)", said)
    skewness = re.search(r"Max skewness = ([\d.]+)", said)
    assert angle, said
    assert skewness, said
    _, found = qualities(points, moved, between)
    assert found.non_orthogonality == pytest.approx(float(angle[1]), rel=1e-5)
    assert found.skewness == pytest.approx(float(skewness[1]), rel=1e-5)
