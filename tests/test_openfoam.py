"""OpenFOAM cases: every form of their files, what their sensitivities mean, and the way back."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foam_cases import (
    Box,
    Form,
    box,
    hollow,
    renumbered,
    write_dictionary,
    write_faces_field,
    write_mesh,
    write_points_field,
)

from rbfevo import apply, export
from rbfevo.__main__ import main
from rbfevo.commands.mesh_report import reported
from rbfevo.errors import UserError
from rbfevo.meshes import cells, opened
from rbfevo.meshes.openfoam.dictionary import UNKNOWN, entries_of
from rbfevo.meshes.openfoam.lists import polygons, read, reals
from rbfevo.meshes.openfoam.writing import in_order
from rbfevo.scenarios import mesh as mesh_scenario
from rbfevo.scenarios.scenario import Scenario

FORMS = {
    "ascii": Form(),
    "ascii.gz": Form(packed=True),
    "binary": Form(binary=True),
    "binary.gz": Form(binary=True, packed=True),
    "labels of 64 bits": Form(binary=True, label=64),
    "big-endian": Form(binary=True, order="MSB"),
}
NAME = "pointSensVeclossESI"


@pytest.fixture(scope="module")
def ducts() -> Box:
    return box()


def lid_values(mesh: Box) -> np.ndarray:
    """dJ/dx [n, 3] of the lid's points alone: to rise in the middle lowers J."""
    rows = np.unique(np.concatenate(mesh.corners("lid")))
    values = np.zeros((len(mesh.points), 3))
    x = mesh.points[rows, 0]
    values[rows, 2] = -np.exp(-((x - 2.0) ** 2)) * (1.0 + 0.3 * mesh.points[rows, 1])
    values[rows, 0] = 0.1 * np.sin(x)
    return values


def case(root: Path, mesh: Box, form: Form = Form(), **dictionary: str) -> Path:  # noqa: B008
    write_mesh(root, mesh, form)
    write_points_field(root, "200", NAME, lid_values(mesh), form)
    write_dictionary(root, **dictionary)
    return root


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_mesh_to_the_bit(form: str, ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts, FORMS[form])
    with opened(root) as found:
        pass
    np.testing.assert_array_equal(found.points, ducts.points)
    np.testing.assert_array_equal(found.arrays[NAME], lid_values(ducts))
    assert cells.counts(found.cells) == {"quadrilaterals": 90, "polyhedra": 54}
    for name in ducts.patches:
        corners = [found.cells.corners[4 * i - 4 * 54 + sum(found.cells.sizes[:54]) :][:4] for i in found.patches[name]]
        np.testing.assert_array_equal(corners, ducts.corners(name))
    (volumes,) = cells.volumes(found.points, found.points, found.cells)
    assert volumes.before.min() > 0
    heights = 1.0 + 0.1 * np.sin(np.linspace(0.0, 4.0, 7)) / 3.0  # of straight segments
    assert volumes.before.sum() == pytest.approx(np.trapezoid(heights, np.linspace(0.0, 4.0, 7)), rel=1e-12)
    assert found.patch_types["symmetry"] == "symmetryPlane"


def test_scalars_of_32_bits_are_read_as_they_are(ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts, Form(binary=True, scalar=32))
    with opened(root) as found:
        np.testing.assert_array_equal(found.points, ducts.points.astype(np.float32).astype(np.float64))


def test_lists_may_be_written_in_other_ways(tmp_path: Path) -> None:
    head = "FoamFile { format ascii; class vectorField; object points; }\n"
    (tmp_path / "points").write_text(head + "// none\n2 /* two */ ( (1 2 3) // first\n (4 5e-1 -6) )")
    file = read(tmp_path / "points")
    np.testing.assert_array_equal(reals(file, file.start, 3)[0], [[1, 2, 3], [4, 0.5, -6]])
    (tmp_path / "alike").write_text(head + "3{(1 2 3)}")
    file = read(tmp_path / "alike")
    np.testing.assert_array_equal(reals(file, file.start, 3)[0], [[1, 2, 3]] * 3)
    (tmp_path / "faces").write_text(head.replace("vectorField", "faceList") + "2(3(0 1 2) 4(3 4 5 6))")
    sizes, corners = polygons(read(tmp_path / "faces"))
    assert (sizes.tolist(), corners.tolist()) == ([3, 4], [0, 1, 2, 3, 4, 5, 6])


def damaged(root: Path, name: str, before: str, after: str) -> None:
    path = root / name
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))


@pytest.mark.parametrize(
    ("name", "before", "after", "message"),
    [
        ("constant/polyMesh/points", "112\n(", "113\n(", "announces 113 entries of 3 numbers, but holds 336"),
        ("constant/polyMesh/faces", "4(", "5(", "announces 207 faces"),
        ("constant/polyMesh/owner", "\n207\n", "\n206\n", "announces 206 entries"),
        ("constant/polyMesh/boundary", "nFaces 9;", "nFaces 8;", "begins at face"),
        ("constant/polyMesh/boundary", "6\n(", "7\n(", "announces 7 patches, but holds 6"),
        ("constant/polyMesh/points", "format ascii", "format text", "the format text"),
        ("constant/polyMesh/points", "FoamFile", "Foam", "no FoamFile header"),
        (f"200/{NAME}", "112\n(", "111\n(", "announces 111 entries"),
        (f"200/{NAME}", "pointVectorField", "pointTensorField", "of the class pointTensorField"),
    ],
)
def test_damaged_files_are_refused_with_what_is_wrong(
    name: str, before: str, after: str, message: str, ducts: Box, tmp_path: Path
) -> None:
    root = case(tmp_path / "case", ducts)
    damaged(root, name, before, after)
    with pytest.raises(UserError, match=re.escape(message)), opened(root):
        pass


def test_a_cut_binary_file_is_refused(ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts, Form(binary=True))
    path = root / "constant/polyMesh/points"
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(UserError, match="points is cut off or damaged: a list of 112 entries"), opened(root):
        pass


def test_two_files_of_one_name_are_asked_about(ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts)
    write_mesh(root, ducts, Form(packed=True))
    with pytest.raises(UserError, match=r"points\.gz; remove the one that is out of date"), opened(root):
        pass


def test_decomposed_cases_get_one_line_with_what_to_do(ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts)
    write_points_field(root / "processor0", "300", NAME, lid_values(ducts))
    with pytest.raises(UserError, match="time 300 are decomposed; run reconstructPar -time 300"), opened(root):
        pass
    with opened(root / "200") as found:  # asked for
        assert NAME in found.arrays
    shutil.rmtree(root / "constant")
    with pytest.raises(UserError, match="is decomposed into 1 parts; run reconstructParMesh"), opened(root):
        pass


def test_the_mesh_is_that_of_the_time(ducts: Box, tmp_path: Path) -> None:
    """points of the newest time up to that of the sensitivities, which is the newest with some."""
    root = case(tmp_path / "case", ducts)
    for time, lift in (("100", 1.0), ("150.5", 2.0), ("250", 3.0)):
        Form().write(root / time / "polyMesh" / "points", "vectorField", [("", ducts.points + lift)])
    for path, lift in ((root, 2.0), (root / "0", 0.0), (root / "100", 1.0), (root / "250", 3.0)):
        with opened(path) as found:
            np.testing.assert_array_equal(found.points, ducts.points + lift)
    write_points_field(root, "1e3", NAME, 2.0 * lid_values(ducts))
    with opened(root) as found:
        np.testing.assert_array_equal(found.arrays[NAME], 2.0 * lid_values(ducts))
    with pytest.raises(UserError, match=r"has no time 7; there are 100, 150\.5, 200, 250, 1e3"), opened(root / "7"):
        pass


def test_points_that_are_newer_than_the_sensitivities_are_noted(ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts)
    with opened(root) as found:
        assert "older sensitivities" not in found.notes
    os.utime(root / "200" / NAME, (1e9, 1e9))
    with opened(root) as found:
        assert "constant/polyMesh/points is newer than the sensitivities" in found.notes["older sensitivities"]


def test_a_directory_that_is_no_case_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is a directory, and no OpenFOAM case"), opened(tmp_path):
        pass


def template(root: Path, **settings: Any) -> Scenario:
    return mesh_scenario(str(root), patches=["lid"], hold=["inlet", "outlet"], hold_width=0.8, **settings)


def test_a_case_is_a_template_with_its_own_sensitivity_and_symmetry(ducts: Box, tmp_path: Path) -> None:
    found = template(case(tmp_path / "case", ducts))
    assert found.mirror is not None
    assert (found.mirror.axis, found.mirror.at) == (1, 0.0)
    assert len(found.vertices) == 28
    assert found.rows is not None
    assert found.blend is not None
    expected = -lid_values(ducts)[found.rows.numpy()]
    expected[found.blend.numpy() == 0.0] = 0.0
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(found.gradient.numpy(), expected, atol=1e-14)


def test_per_area_is_made_undone_by_full_areas_about_each_point(ducts: Box, tmp_path: Path) -> None:
    """surfacePoints without includeSurfaceArea: OpenFOAM divides by the areas of all faces of the lid at a point."""
    areas = np.zeros(len(ducts.points))
    for face in ducts.corners("lid"):
        a, b, c, d = ducts.points[face]
        areas[face] += np.linalg.norm(np.cross(c - a, d - b)) / 2.0
    root = tmp_path / "case"
    case(root, ducts, area="")
    values = lid_values(ducts)
    per_area = np.divide(values, areas[:, None], out=np.zeros_like(values), where=areas[:, None] > 0)
    write_points_field(root, "200", NAME, per_area)
    with opened(root) as found:
        np.testing.assert_allclose(found.arrays[NAME], values, rtol=1e-12, atol=1e-15)
        assert found.meanings[NAME].kind == "nodal"
    with pytest.raises(UserError, match=r"sensitivity_kind=density: pointSensVeclossESI is nodal .*remove the setting"):
        template(root, sensitivity_kind="density")


@pytest.mark.parametrize(
    ("kind", "area", "meant"),
    [
        ("surface", "", "nodal"),
        ("surface", "includeSurfaceArea true;", "nodal"),
        ("surface", "includeSurfaceArea off;", "density"),
        ("surface", 'includeSurfaceArea #calc "1";', None),
        ("surfacePoints", "", None),
    ],
)
def test_what_sensitivities_of_faces_are(kind: str, area: str, meant: str | None, ducts: Box, tmp_path: Path) -> None:
    root = tmp_path / "case"
    write_mesh(root, ducts)
    write_dictionary(root, kind, area)
    count = ducts.patches["lid"][1]
    values = np.column_stack([np.zeros(count), np.zeros(count), np.arange(1.0, count + 1.0)])
    for form in (Form(), Form(binary=True)):
        write_faces_field(root, "5", "faceSensVeclossESI", {"lid": values}, form)
        with opened(root) as found:
            assert found.meanings["faceSensVeclossESI"].kind == meant
            array = found.cell_arrays["faceSensVeclossESI"]
            np.testing.assert_array_equal(array[found.patches["lid"]], values)
            assert not np.delete(array, found.patches["lid"], axis=0).any()
    if meant is None:
        with pytest.raises(UserError, match=r"set scenario\.sensitivity_kind=nodal"):
            template(root)
    else:
        assert template(root).gradient.abs().max() > 0


def test_vectors_of_points_are_taken_first_and_doubt_is_asked_about(ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts)
    write_points_field(root, "200", "pointSensNormallossESI", lid_values(ducts)[:, 2])
    write_points_field(root, "200", "pointSensNormalVeclossESI", lid_values(ducts))
    assert template(root).notes["sensitivity"].startswith(NAME)
    write_points_field(root, "200", "pointSensVecliftESI", lid_values(ducts))
    with pytest.raises(UserError, match=r"pointSensVecliftESI, pointSensVeclossESI: set scenario\.sensitivity"):
        template(root)
    assert template(root, sensitivity="pointSensVecliftESI").notes["sensitivity"].startswith("pointSensVecliftESI")


def test_a_scalar_is_along_the_normal_that_points_out_of_the_fluid(ducts: Box, tmp_path: Path) -> None:
    """The lid's normal is +z here: a negative value wants it to move up."""
    root = tmp_path / "case"
    write_mesh(root, ducts)
    write_dictionary(root)
    write_points_field(root, "200", "pointSensNormallossESI", lid_values(ducts)[:, 2])
    found = template(root)
    assert float(found.gradient[:, 2].max()) > 0
    assert float(found.gradient[:, 2].min()) > -1e-12


def test_a_scalar_of_a_body_in_the_flow_points_into_the_body(tmp_path: Path) -> None:
    """J rises where the surface moves out of the fluid, into the body: so the body has to grow."""
    mesh = hollow(box(3, 3, 3), 13)
    root = tmp_path / "case"
    write_mesh(root, mesh)
    write_dictionary(root, area="includeSurfaceArea true;")
    rows = np.unique(np.concatenate(mesh.corners("body")))
    values = np.zeros(len(mesh.points))
    values[rows] = 1.0
    write_points_field(root, "9", "pointSensNormaldragESI", values)
    found = mesh_scenario(str(root), patches=["body"])
    away = found.vertices - found.vertices.mean(0)
    assert bool(((found.gradient * away).sum(1) > 0).all())
    with opened(root) as read_back:
        (volumes,) = cells.volumes(read_back.points, read_back.points, read_back.cells)
    assert len(volumes.before) == 26
    assert volumes.before.min() > 0


def test_the_last_cell_may_be_a_neighbour_alone(tmp_path: Path) -> None:
    mesh = renumbered(box(3, 3, 3), 13)
    assert mesh.owner.max() == 25
    write_mesh(tmp_path / "case", mesh)
    with opened(tmp_path / "case") as found:
        (volumes,) = cells.volumes(found.points, found.points, found.cells)
    assert len(volumes.before) == 27
    assert volumes.before.min() > 0
    corners = found.cells.corners[sum(found.cells.sizes[:27]) :]
    assert corners.tolist() == [corner for name in mesh.patches for face in mesh.corners(name) for corner in face]


def test_patches_must_be_named_and_an_inclined_symmetry_plane_is_refused(ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts)
    with pytest.raises(UserError, match=r"scenario.patches: name the patches .*lid \(wall\)"):
        mesh_scenario(str(root))
    turned = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    Form().write(root / "constant/polyMesh/points", "vectorField", [("", ducts.points @ turned.T)])
    with pytest.raises(UserError, match="symmetry is a plane of symmetry that is not across x, y or z"):
        template(root)
    write_mesh(root, ducts, types={"symmetry": "wedge"})
    with pytest.raises(UserError, match="the patch symmetry is a wedge"):
        template(root)


def test_empty_patches_make_a_design_of_two_dimensions(tmp_path: Path) -> None:
    slab = box(12, 1, 4)
    root = tmp_path / "case"
    write_mesh(root, slab, types={"symmetry": "empty", "far": "empty"})
    write_dictionary(root)
    values = lid_values(slab)
    values[:, 1] = 0.0
    write_points_field(root, "9", NAME, values)
    found = template(root)
    assert found.planar is not None
    assert (found.planar.axis, found.planar.at) == (1, 0.5)
    assert found.mirror is None


def test_the_report_lists_patches_and_sensitivities(ducts: Box, tmp_path: Path) -> None:
    found = reported(case(tmp_path / "case", ducts))
    assert found["format"] == "OpenFOAM case"
    assert found["patch_types"]["lid"] == "wall"
    assert found["sensitivities"][NAME]["kind"] == "nodal"
    assert found["patches"]["lid"] == 18
    json.dumps(found)


@pytest.fixture(scope="module")
def lloyd(ducts: Box, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a case, with one step exported."""
    directory = tmp_path_factory.mktemp("lloyd")
    root = case(directory / "case", ducts)
    arguments = [f"scenario.template={root}", "scenario.patches=[lid]", "scenario.hold=[inlet,outlet]", "centers=3"]
    more = ["scenario.hold_width=0.8", "kernel.support=1.5", "method=lloyd", "figures=false", "quiet=true"]
    assert main(["scenario=mesh", *arguments, *more, f"hydra.run.dir={directory / 'run'}"]) == 0
    assert (
        export.main([str(directory / "run"), "--pick", "knee", "--step", "0.02", "--out", str(directory / "step")]) == 0
    )
    return directory


def applied(directory: Path, *more: str) -> int:
    step = ["--displacements", str(directory / "step" / "displacements.csv")]
    return apply.main([str(directory / "run"), "--pick", "knee", *step, "--mesh", str(directory / "case"), *more])


def test_a_step_becomes_the_points_of_a_time(lloyd: Path, ducts: Box, tmp_path: Path) -> None:
    root = tmp_path / "case"
    shutil.copytree(lloyd / "case", root)
    assert applied(lloyd, "--out", str(root / "1")) == 0
    with opened(root / "1") as found:
        moved = found.points - ducts.points
    lid = np.unique(np.concatenate(ducts.corners("lid")))
    ends = np.unique(np.concatenate([*ducts.corners("inlet"), *ducts.corners("outlet")]))
    assert moved[lid, 2].max() > 0.01
    assert not moved[np.intersect1d(lid, ends)].any()
    symmetry = np.unique(np.concatenate(ducts.corners("symmetry")))
    assert np.abs(moved[symmetry, 1]).max() < 1e-15
    with opened(root) as found:  # the sensitivities' time is 200, and points of 1 are the newest up to it
        np.testing.assert_array_equal(found.points, ducts.points + moved)


def test_a_case_that_has_moved_since_the_run_gets_a_warning(
    lloyd: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "case"
    shutil.copytree(lloyd / "case", root)
    shutil.rmtree(root / "200")
    assert applied(lloyd, "--out", str(root / "1"), "--quiet") == 0
    assert "the case has moved" not in capsys.readouterr().err
    step = ["--displacements", str(lloyd / "step" / "displacements.csv"), "--out", str(root / "2")]
    command = [str(lloyd / "run"), "--pick", "knee", *step]
    assert apply.main([*command, "--mesh", str(root)]) == 0
    error = capsys.readouterr().err
    assert "vertices of the run's template are not among the points of" in error
    assert "1/polyMesh/points; if the case has moved" in error
    assert apply.main([*command, "--mesh", str(root / "1"), "--volume", "laplace", "--overwrite"]) == 2
    assert "If the case has moved since the run, give --mesh an earlier time, such as CASE/0" in capsys.readouterr().err
    assert apply.main([*command, "--mesh", str(root / "0"), "--overwrite", "--quiet"]) == 0
    assert "the case has moved" not in capsys.readouterr().err
    with opened(root / "1") as first, opened(root / "2") as second:
        np.testing.assert_array_equal(first.points, second.points)


def test_other_patches_that_move_get_a_warning_and_laplace_holds_them(
    lloyd: Path, ducts: Box, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The bottom is one support radius below the lid; inlet and outlet are held by the run."""
    assert applied(lloyd, "--out", str(tmp_path / "1")) == 0
    captured = capsys.readouterr()
    with opened(lloyd / "case") as found:
        before = found.points
    points = read(tmp_path / "1/polyMesh/points")
    length = np.linalg.norm(reals(points, points.start, 3)[0] - before, axis=1)
    lid = set(np.unique(np.concatenate(ducts.corners("lid"))).tolist())
    far = max(length[i] for i in np.unique(np.concatenate(ducts.corners("far"))) if i not in lid)
    assert "points beside the design surface move, too: " in captured.err
    assert f"far by up to {far:.4g}" in captured.err
    assert "symmetry by up to" not in captured.err
    assert "worst non-orthogonality" in captured.out
    assert applied(lloyd, "--out", str(tmp_path / "2"), "--volume", "laplace") == 0
    assert "beside the design surface" not in capsys.readouterr().err
    laplace = ["--volume", "laplace", "--as", "pointDisplacement"]
    assert applied(lloyd, "--out", str(tmp_path / "3"), *laplace) == 0
    assert "worst non-orthogonality" not in capsys.readouterr().out


def test_results_are_not_overwritten_and_other_outputs_are_refused(
    lloyd: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert applied(lloyd, "--out", str(tmp_path / "2"), "--quiet") == 0
    before = (tmp_path / "2/polyMesh/points").read_bytes()
    capsys.readouterr()
    for out, message in (
        (tmp_path / "2", "already exists: choose another time, or add --overwrite"),
        (tmp_path / "deformed.vtu", "give a directory with a time as its name"),
        (tmp_path / "none" / "1", "does not exist"),
    ):
        assert applied(lloyd, "--out", str(out)) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert (tmp_path / "2/polyMesh/points").read_bytes() == before
    assert applied(lloyd, "--out", str(tmp_path / "2"), "--overwrite", "--quiet") == 0


def test_the_field_for_the_mover_has_the_patch_s_points_in_its_order(lloyd: Path, ducts: Box, tmp_path: Path) -> None:
    assert applied(lloyd, "--out", str(tmp_path / "1"), "--quiet") == 0
    assert applied(lloyd, "--out", str(tmp_path / "1"), "--as", "pointDisplacement", "--quiet") == 0
    file = read(tmp_path / "1/pointDisplacement")
    assert file.kind == "pointVectorField"
    points = read(tmp_path / "1/polyMesh/points")
    moved = reals(points, points.start, 3)[0] - ducts.points
    order = []
    for face in ducts.corners("lid"):
        order += [corner for corner in face if corner not in order]
    block = re.search(rb"lid\s*\{\s*type\s+fixedValue;\s*value\s+nonuniform List<vector>\s*", file.content)
    assert block is not None
    np.testing.assert_allclose(reals(file, block.end(), 3)[0], moved[order], atol=1e-15)
    assert in_order(np.array([5, 2, 5, 9, 2, 1])).tolist() == [5, 2, 9, 1]
    assert re.search(rb"symmetry\s*\{\s*type\s+symmetryPlane;\s*\}", file.content)


def test_dictionaries_are_read_as_openfoam_reads_them(tmp_path: Path) -> None:
    (tmp_path / "more").write_text("deep { value 3; }")
    text = """
    // top
    one 1; two "a b"; list (a b "c d");
    sub { inner $one; "wall.*" { type x; } #include "more"
      copy { $..deep; other yes; } from $:one; }
    sum #calc "1 + 2"; code #{ x = "{"; #}; lost $nothing; empty;
    """
    found = entries_of(text, tmp_path / "dict")
    assert found["one"] == "1"
    assert found["two"] == "a b"
    assert found["list"] == ["a", "b", "c d"]
    assert found["sub"]["inner"] == "1"
    assert found["sub"]["wall.*"] == {"type": "x"}
    assert found["sub"]["deep"] == {"value": "3"}
    assert found["sub"]["from"] == "1"
    assert found["sum"] == found["code"] == found["lost"] == UNKNOWN
    with pytest.raises(ValueError, match="cut off"):
        entries_of("a { b 1;", tmp_path / "dict")


FOAM = Path("/usr/share/openfoam")
TOOLS = shutil.which("blockMesh") is not None and FOAM.is_dir()


@pytest.mark.skipif(not TOOLS, reason="OpenFOAM is not installed")
def test_openfoam_takes_what_is_written(lloyd: Path, tmp_path: Path) -> None:
    """checkMesh on the moved mesh; and a case that foamFormatConvert has written is read to the bit."""
    root = tmp_path / "case"
    shutil.copytree(lloyd / "case", root)
    shutil.rmtree(root / "200")
    assert applied(lloyd, "--out", str(root / "1"), "--quiet") == 0
    head = "FoamFile { version 2.0; format ascii; class dictionary; object x; }\n"
    control = f"{head}startFrom latestTime; deltaT 1; startTime 0; stopAt endTime; endTime 1; writeInterval 1;"
    control += " writePrecision 17; writeFormat %s; writeCompression %s;"
    (root / "system" / "fvSolution").write_text(head)
    schemes = ("ddt", "grad", "div", "laplacian", "interpolation", "snGrad")
    (root / "system" / "fvSchemes").write_text(
        head + "".join(f"{name}Schemes {{ default none; }}\n" for name in schemes)
    )
    environment = {"WM_PROJECT_DIR": str(FOAM), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    (root / "system" / "controlDict").write_text(control % ("ascii", "off"))
    done = subprocess.run(
        ["checkMesh", "-latestTime"], cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    assert "Mesh OK." in done.stdout, done.stdout[-2000:]
    with opened(root) as found:
        expected = found.points
    for form, packed in (("binary", "off"), ("binary", "on")):
        (root / "system" / "controlDict").write_text(control % (form, packed))
        for options in ((), ("-constant",)):
            command = ["foamFormatConvert", *options]
            subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=True)
        with opened(root) as found:
            np.testing.assert_allclose(found.points, expected, rtol=4e-16, atol=1e-17)


def test_adjoint_solvers_name_several_objectives(ducts: Box, tmp_path: Path) -> None:
    root = case(tmp_path / "case", ducts)
    other = lid_values(ducts) * np.cos(ducts.points[:, :1]) + 0.0
    write_points_field(root, "200", "pointSensVecliftESI", other)
    write_points_field(root, "200", "pointSensNormalliftESI", other[:, 2])  # of lower rank
    both = template(root, sensitivity=["loss", "lift"])
    assert both.objectives is not None
    assert both.objectives.names == ("loss", "lift")
    k = both.gradient.shape[1] // 2
    for index, name in enumerate((NAME, "pointSensVecliftESI")):
        alone = template(root, sensitivity=name)
        ours = both.gradient[:, index * k : (index + 1) * k]
        np.testing.assert_allclose(ours, alone.gradient * 0.5**0.5, rtol=1e-12, atol=1e-14)
    with pytest.raises(UserError, match="drag"):
        template(root, sensitivity=["loss", "drag"])
