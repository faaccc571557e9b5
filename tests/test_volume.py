"""`apply --volume laplace`: the design surface as the setup says, the inside by the dense equations."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
from grids import EDGES, box, hexahedra, polyhedra, write_su2
from test_columns import MIRRORS
from test_export import a_run
from test_extension import dense

from rbfevo import apply, meshes
from rbfevo.commands.volume import carried
from rbfevo.errors import UserError
from rbfevo.meshes.constraints import Constraints, Plane, constraints, solid_faces
from rbfevo.meshes.mesh import Cells, Mesh
from rbfevo.recorded import setup
from rbfevo.recorded.record import read


def half_box(types: dict[str, str] | None = None) -> Mesh:
    """A graded box with y = 0 as one side, of 9 x 5 x 6 points."""
    x, y = np.array([-1, -0.7, -0.45, -0.3, 0, 0.2, 0.4, 0.7, 1]), np.array([0, 0.1, 0.3, 0.6, 1.0])
    return box(*hexahedra(x, y, np.array([-1, -0.9, -0.7, -0.4, 0.1, 1.0])), types)


def corners(mesh: Mesh) -> Any:
    count = int((mesh.cells.kinds == 12).sum())
    return mesh.cells.corners[: 8 * count].reshape(-1, 8)


def points_of(mesh: Mesh, *names: str) -> Any:
    """[n] True at the points of some patches."""
    mask, count = np.zeros(len(mesh.points), bool), len(corners(mesh))
    for name in names:
        mask[mesh.cells.corners[8 * count :].reshape(-1, 4)[mesh.patches[name] - count]] = True
    return mask


def bump_run(run: Path, vertices: Any, **more: Any) -> Path:
    """A run whose template has these vertices."""
    a_run(run, **{"symmetry": MIRRORS[1], "on": 2} | more)
    with np.load(run / "scenario.npz") as archive:
        lower, upper = archive["lower"], archive["upper"]
    g = np.tile([0.0, 0.0, 1.0], (len(vertices), 1)) / np.sqrt(len(vertices))
    faces = np.stack([np.arange(3) + k for k in range(len(vertices) - 2)])
    arrays = {"vertices": vertices, "faces": faces, "gradient": g, "weights": np.ones(len(vertices))}
    np.savez(run / "scenario.npz", **arrays, lower=lower, upper=upper)
    return run


def rows_of(run: Path, size: float = 0.03) -> Any:
    rows = size * np.random.default_rng(0).normal(size=(len(read(run).centers[0]), 3))
    rows[:2, 1] = 0.0
    return rows


def edges_of_hexahedra(mesh: Mesh) -> Any:
    return np.unique(np.sort(corners(mesh)[:, EDGES].reshape(-1, 2), axis=1), axis=0)


def wanted(mesh: Mesh, rbf: Any, design: Any, slip: dict[int, Any]) -> Any:
    """What the dense equations say: slip by axis -> the points of the plane."""
    outer = points_of(mesh, *mesh.patches)
    fixed = np.repeat(outer[:, None], 3, axis=1)
    for axis, mask in slip.items():
        fixed[mask] = np.arange(3) == axis
    fixed[design] = True
    return dense(mesh.points, edges_of_hexahedra(mesh), np.where(design[:, None], rbf, 0.0), fixed)


def applied(run: Path, mesh: Path, out: Path, *options: str) -> int:
    given = ["--displacements", str(run.parent / "rows.npy"), "--mesh", str(mesh), "--out", str(out)]
    return apply.main([str(run), "--pick", "index:0", *given, *options])


def test_the_design_surface_moves_by_rbf_and_the_inside_by_the_laplacian(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = half_box()
    design = points_of(mesh, "bump")
    run = bump_run(tmp_path / "run", mesh.points[design])
    np.save(tmp_path / "rows.npy", rows_of(run))
    write_su2(tmp_path / "a.su2", mesh)
    assert applied(run, tmp_path / "a.su2", tmp_path / "rbf.su2", "--volume", "rbf") == 0
    assert applied(run, tmp_path / "a.su2", tmp_path / "default.su2") == 0
    assert (tmp_path / "rbf.su2").read_bytes() == (tmp_path / "default.su2").read_bytes()
    capsys.readouterr()
    assert applied(run, tmp_path / "a.su2", tmp_path / "laplace.su2", "--volume", "laplace") == 0
    said = capsys.readouterr()
    with meshes.opened(tmp_path / "rbf.su2") as one, meshes.opened(tmp_path / "laplace.su2") as other:
        np.testing.assert_array_equal(other.points[design], one.points[design])
        slip = points_of(mesh, "ymin") & ~points_of(mesh, "xmin", "xmax", "zmin", "zmax", "bump")
        expected = mesh.points + wanted(mesh, one.points - mesh.points, design, {1: slip})
        np.testing.assert_allclose(other.points, expected, rtol=0, atol=1e-12)
        assert np.abs(expected - one.points).max() > 1e-3
        assert np.abs((other.points - mesh.points)[slip][:, [0, 2]]).max() > 1e-3
    held = points_of(mesh, *mesh.patches) & ~design & ~slip
    inside = len(design) - int((design | held | slip).sum())
    assert (
        f"note: the {design.sum()} points of the design surface move as the setup says, {held.sum()} others of the "
        f"boundary are held, {slip.sum()} slide in symmetry planes, {inside} inside are carried along\n"
    ) in said.out
    assert "note: worst non-orthogonality 0.0 degrees before, " in said.out
    # Nothing is held at the rim of the bump: said with the number of points, and the largest move.
    moves = np.linalg.norm(one.points - mesh.points, axis=1)
    rim = design & points_of(mesh, "zmin", "ymax")
    beside = np.abs(np.abs(mesh.points[:, 0]) - 0.45) < 0.1
    rim |= design & beside
    assert "points at the rim of the design surface move by up to " in said.err
    edges = edges_of_hexahedra(mesh)
    edges = np.concatenate([edges, edges[:, ::-1]])
    edges = edges[design[edges[:, 0]] & held[edges[:, 1]]]
    share = moves[edges[:, 0]] / np.linalg.norm(mesh.points[edges[:, 0]] - mesh.points[edges[:, 1]], axis=1)
    assert f"move by up to {moves[rim].max():.4g}, {share.max():.2g} times the edge" in said.err
    assert "scenario.hold" in said.err


def found(mesh: Mesh, vertices: Any, mirror: Any = None, **options: Any) -> Constraints:
    return constraints(mesh, solid_faces(mesh.cells), vertices, mirror, **options)


ON_Y = Plane(1, 0.0)


def test_types_of_patches_decide_what_slides() -> None:
    mesh = half_box({"xmin": "patch", "ymin": "symmetryPlane", "zmax": "symmetry", "bump": "wall"})
    c = found(mesh, mesh.points[points_of(mesh, "bump")])
    others = points_of(mesh, "xmin", "xmax", "ymax", "zmin")
    design = points_of(mesh, "bump")
    np.testing.assert_array_equal(c.design, design)
    for axis, name in ((1, "ymin"), (2, "zmax")):
        np.testing.assert_array_equal(c.slip[~design, axis], (points_of(mesh, name) & ~others)[~design])
    assert not c.slip[:, 0].any()
    np.testing.assert_array_equal(c.held, others & ~design)
    corner = points_of(mesh, "ymin") & points_of(mesh, "zmax") & ~others
    assert corner.sum() == 7  # on the line of both planes a point slides along x alone
    np.testing.assert_array_equal(c.fixed[corner], np.tile([False, True, True], (7, 1)))
    # Where there are types, the run's plane does not count; without any it does.
    walls = half_box({"ymin": "wall"})
    assert not found(walls, mesh.points[design], ON_Y).slip.any()
    np.testing.assert_array_equal(
        found(half_box(), mesh.points[design], ON_Y).slip[:, 1], c.slip[:, 1] & ~points_of(mesh, "zmax")
    )
    assert (
        found(walls, mesh.points[design], slip=["ymin"]).slip[:, 1].sum()
        == (points_of(mesh, "ymin") & ~c.held).sum() - 7
    )


def test_a_slab_one_cell_thick_slides_between_its_empty_sides() -> None:
    mesh = box(*hexahedra(np.linspace(-1, 1, 9), np.array([0.0, 0.1]), np.linspace(0, 1, 5)))
    design = points_of(mesh, "bump")
    held = points_of(mesh, "xmin", "xmax", "zmin", "zmax") & ~design
    free = ~design & ~held
    typed = dataclasses.replace(mesh, patch_types={"ymin": "empty", "ymax": "empty"})
    for c in (
        found(typed, mesh.points[design]),
        found(mesh, mesh.points[design], sides=[Plane(1, 0.0), Plane(1, 0.1)]),
        found(mesh, mesh.points[design], slip=["ymin", "ymax"]),
    ):
        np.testing.assert_array_equal(c.design, design)
        np.testing.assert_array_equal(c.held, held)
        np.testing.assert_array_equal(c.fixed[free], np.tile([False, True, False], (free.sum(), 1)))


def test_a_patch_of_two_planes_slides_and_an_inclined_one_is_refused() -> None:
    mesh = half_box({"both": "symmetry"})
    both = np.concatenate([mesh.patches["ymin"], mesh.patches["ymax"]])
    mesh = dataclasses.replace(mesh, patches={**mesh.patches, "both": both})
    c = found(mesh, mesh.points[points_of(mesh, "bump")])
    assert c.slip[:, 1].sum() > 2 * 7 * 4
    inclined = dataclasses.replace(mesh, points=mesh.points + 0.1 * mesh.points[:, [1, 0, 2]] * [0, 1, 0])
    with pytest.raises(
        UserError, match=r"80 of 80 faces of the symmetry patch both are not in a plane across x, y or z"
    ):
        found(inclined, inclined.points[points_of(mesh, "bump")])


def test_the_template_is_found_in_the_boundary_or_refused() -> None:
    mesh, design = half_box(), points_of(half_box(), "bump")
    vertices = mesh.points[design]
    rounded = vertices.astype(np.float32).astype(np.float64) + 1e-7
    np.testing.assert_array_equal(found(mesh, rounded).design, design)
    finer = np.concatenate([vertices, vertices[:3] + np.array([0.01, 0, 0])])
    with pytest.raises(
        UserError,
        match=r"its boundary lacks 3 of the 28 vertices of the run's template, .*--design PATCH; there are xmin, xmax",
    ):
        found(mesh, finer)
    with pytest.raises(UserError, match="its boundary lacks all 25 vertices of the run's template"):
        found(mesh, vertices * 1000.0)
    with pytest.raises(UserError, match=r"If so, take the template from this mesh, or use --volume rbf"):
        found(dataclasses.replace(mesh, patches={}), finer)
    np.testing.assert_array_equal(found(mesh, finer, design=["bump"]).design, design)
    np.testing.assert_array_equal(found(mesh, finer, design=["bump", "zmin"]).design, design | points_of(mesh, "zmin"))
    for options, message in (
        ({"design": ["bumb"]}, r"--design=bumb: there is no such patch \(did you mean 'bump'\?\)"),
        ({"slip": ["flor"]}, r"--slip=flor: there is no such patch"),
        ({"design": ["bump"], "slip": ["bump"]}, "--design and --slip both name bump"),
    ):
        with pytest.raises(UserError, match=message):
            found(mesh, vertices, **options)
    inner = dataclasses.replace(mesh, patches={**mesh.patches, "cells": np.arange(4)})
    with pytest.raises(UserError, match=r"--design=cells: none of its 4 cells is a face of the mesh's boundary"):
        found(inner, vertices, design=["cells"])


def test_halves_and_wholes_of_a_mirrored_run() -> None:
    half = half_box()
    x, z = np.unique(half.points[:, 0]), np.unique(half.points[:, 2])
    y = np.unique(np.concatenate([half.points[:, 1], -half.points[:, 1]]))
    whole = box(*hexahedra(x, y, z))
    one, both = half.points[points_of(half, "bump")], whole.points[points_of(whole, "bump")]
    for mesh in (half, whole):
        for vertices in (one, both):  # half or whole, of the template and of the mesh
            np.testing.assert_array_equal(found(mesh, vertices, ON_Y).design, points_of(mesh, "bump"))
    other = dataclasses.replace(half, points=half.points * [1, -1, 1])
    np.testing.assert_array_equal(found(other, one, ON_Y).design, points_of(half, "bump"))
    with pytest.raises(UserError, match="boundary lacks"):  # without a mirror the whole template is needed
        found(half, both)
    skew = dataclasses.replace(whole, points=whole.points + [0.01, 0, 0] * (whole.points[:, 1:2] < 0))
    with pytest.raises(UserError, match="boundary lacks"):  # the other half has no such points
        found(skew, one, ON_Y)
    np.testing.assert_array_equal(
        found(skew, skew.points[points_of(whole, "bump")], ON_Y).design, points_of(whole, "bump")
    )


def test_points_of_no_solid_cell_follow_the_rbf(tmp_path: Path) -> None:
    mesh = half_box()
    run = bump_run(tmp_path / "run", mesh.points[points_of(mesh, "bump")])
    more = dataclasses.replace(mesh, points=np.concatenate([mesh.points, [[0.1, 0.2, 0.3], [0.3, 0.1, -0.9]]]))
    record = read(run)
    chosen = setup.setup(record, 0)
    rbf = chosen.displacement(more.points, chosen.weights(rows_of(run)))
    result = carried(more, solid_faces(more.cells), record, chosen, rbf)
    np.testing.assert_array_equal(result.displacement[-2:], rbf[-2:])
    assert result.line.endswith("2 in no solid cell move as the setup says")
    plain = carried(mesh, solid_faces(mesh.cells), record, chosen, rbf[:-2])
    np.testing.assert_allclose(result.displacement[:-2], plain.displacement, atol=1e-14)
    stored = dataclasses.replace(mesh, cells=polyhedra(corners(mesh)))
    other = carried(stored, solid_faces(stored.cells), record, chosen, rbf[:-2])
    np.testing.assert_allclose(other.displacement, plain.displacement, atol=1e-14)


def test_a_held_rim_is_quiet_and_a_design_that_leaves_the_plane_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = half_box()
    design = points_of(mesh, "bump")
    rim = design & (np.isin(mesh.points[:, 0], [-0.45, 0.4]) | (mesh.points[:, 1] == 1.0))
    run = bump_run(tmp_path / "run", mesh.points[design], hold_width=0.1)
    with np.load(run / "scenario.npz") as archive:
        arrays = dict(archive)
    blend = np.ones(int(design.sum()))
    np.savez(run / "scenario.npz", **arrays, held=mesh.points[rim], blend=blend)
    np.save(tmp_path / "rows.npy", rows_of(run))
    write_su2(tmp_path / "a.su2", mesh)
    assert applied(run, tmp_path / "a.su2", tmp_path / "b.su2", "--volume", "laplace") == 0
    assert capsys.readouterr().err == ""
    # The same mesh, and a run that knows of no symmetry.
    run = bump_run(tmp_path / "other", mesh.points[design], symmetry=None)
    said = "points of the design surface leave a symmetry plane of the mesh, by up to "
    options = ("--volume", "laplace", "--slip", "ymin")
    assert applied(run, tmp_path / "a.su2", tmp_path / "c.su2", *options) == 2
    refused = capsys.readouterr().err
    assert f"a.su2: {(design & (mesh.points[:, 1] == 0)).sum()} {said}" in refused
    assert "set scenario.symmetry=y" in refused
    assert len(refused.splitlines()) == 1
    assert not (tmp_path / "c.su2").exists()
    assert applied(run, tmp_path / "a.su2", tmp_path / "c.su2", *options, "--force") == 0
    assert f"warning: {(design & (mesh.points[:, 1] == 0)).sum()} {said}" in capsys.readouterr().err
    assert applied(run, tmp_path / "a.su2", tmp_path / "d.su2", "--force") == 0
    with meshes.opened(tmp_path / "c.su2") as one, meshes.opened(tmp_path / "d.su2") as other:
        np.testing.assert_array_equal(one.points[design], other.points[design])


def test_a_global_kernel_moves_nothing_far_away(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = half_box()
    far = dataclasses.replace(mesh, points=mesh.points * [1, 1, 3])
    run = bump_run(tmp_path / "run", far.points[points_of(mesh, "bump")], kernel="triharmonic")
    write_su2(tmp_path / "a.su2", far)
    np.save(tmp_path / "rows.npy", rows_of(run, 1e-3))
    for volume, warned in (("rbf", True), ("laplace", False)):
        assert applied(run, tmp_path / "a.su2", tmp_path / f"{volume}.su2", "--volume", volume, "--force") == 0
        assert ("the triharmonic kernel reaches everywhere" in capsys.readouterr().err) == warned


def test_cells_turned_inside_out_are_refused_with_a_share(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = half_box()
    run = bump_run(tmp_path / "run", mesh.points[points_of(mesh, "bump")])
    write_su2(tmp_path / "a.su2", mesh)
    np.save(tmp_path / "rows.npy", rows_of(run, 3.0))
    np.save(tmp_path / "rows.npy", rows_of(run, 1.0))
    assert applied(run, tmp_path / "a.su2", tmp_path / "a1.su2", "--volume", "laplace") == 0
    assert "warning: the worst non-orthogonality exceeds 90 degrees: faces of cells are" in capsys.readouterr().err
    np.save(tmp_path / "rows.npy", rows_of(run, 3.0))
    assert applied(run, tmp_path / "a.su2", tmp_path / "b.su2", "--volume", "laplace") == 2
    refused = capsys.readouterr().err
    assert "hexahedra (the worst to" in refused
    share = float(refused.split("by less than ")[1].split(",")[0])
    for factor, code in ((0.999, 0), (1.02, 2)):
        np.save(tmp_path / "rows.npy", factor * share * rows_of(run, 3.0))
        assert applied(run, tmp_path / "a.su2", tmp_path / "b.su2", "--volume", "laplace", "--overwrite") == code


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        (
            [(15, np.arange(10)[None]), (12, np.arange(8)[None])],
            "does not know the edges of 1 prisms; use --volume rbf",
        ),
        ([(25, np.arange(20)[None])], "does not know the edges of 1 second-order cells"),
        (
            [(255, np.arange(8)[None]), (12, np.arange(8)[None])],
            "does not know the edges of 1 cells of an unknown kind",
        ),
        ([(42, np.arange(8)[None])], "does not know the edges of 1 polyhedra without faces"),
        (
            [(5, np.arange(9).reshape(3, 3)), (3, np.arange(2)[None])],
            "fill a volume, but there are 3 triangles, 1 lines",
        ),
        ([], "needs cells that fill a volume, but there are only points; use --volume rbf"),
    ],
)
def test_cells_that_are_not_for_it_are_counted(kinds: Any, message: str) -> None:
    with pytest.raises(UserError, match=message):
        solid_faces(Cells.blocks(kinds))


def test_surfaces_and_plane_runs_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = half_box()
    run = bump_run(tmp_path / "run", mesh.points[points_of(mesh, "bump")])
    np.save(tmp_path / "rows.npy", rows_of(run))
    pyvista.Sphere().save(tmp_path / "a.vtp")
    write_su2(tmp_path / "a.su2", mesh)
    laplace = ("--volume", "laplace")
    for name, options, message in (
        ("a.vtp", laplace, "a.vtp: --volume laplace needs cells that fill a volume, but there are"),
        ("a.su2", (*laplace, "--design", "wing"), "a.su2: --design=wing: there is no such patch; there are xmin, "),
        ("a.su2", ("--design", "bump"), "--design is for --volume laplace"),
        ("a.su2", ("--slip", "ymin"), "--slip is for --volume laplace"),
        ("a.su2", ("--volume", "linear"), "--volume"),
    ):
        assert applied(run, tmp_path / name, tmp_path / f"b{Path(name).suffix}", *options) == 2
        err = capsys.readouterr().err
        assert message in err
        assert len(err.splitlines()) == 1
    plane = read(a_run(tmp_path / "plane", d=2))
    faces = solid_faces(mesh.cells)
    with pytest.raises(UserError, match="this run is on the plane"):
        carried(mesh, faces, plane, setup.setup(plane, 0), np.zeros_like(mesh.points))
