"""`method=given`: control points placed by hand are scored where they are, and stay so through export and back."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from scipy.spatial.distance import cdist

from rbfevo import collect, export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.figures.front import picture
from rbfevo.figures.report import page
from rbfevo.figures.series import series
from rbfevo.meshes.control_points import read_control_points
from rbfevo.methods.given import GivenCenters, labels_of
from rbfevo.recorded.record import read
from rbfevo.runs.journal import Journal
from tests.slabs import saved, strip
from tests.test_mesh_runs import SUPPORT, egg, plain_scores

POINTS = np.array([[0.21, 0.3], [0.8, 0.4], [0.5, 1.5], [1.0 / 3.0, 0.9]])
HALF = np.array([[-1.6, 0.5, 0.2], [0.1, 0.9, -0.3], [1.4, 0.6, 0.4], [0.2, 0.0, 0.8], [2.0 / 3.0, 0.0, -0.75]])
IMAGE = np.array([1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"))


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def table(path: Path, points: np.ndarray, header: str = "") -> Path:
    rows = [",".join(map(repr, row)) for row in points.tolist()]
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n")
    return path


def on_plane(out: Path, centers: Any, *more: str) -> list[str]:
    return [f"hydra.run.dir={out}", "scenario=plane", "method=given", f"method.centers={centers}", "quiet=true", *more]


def on_egg(out: Path, template: Path, centers: Any, *more: str) -> list[str]:
    files = [f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    symmetric = ["scenario.symmetry=y", "scenario.symmetry_at=0", f"kernel.support={SUPPORT}"]
    given = ["method=given", f"method.centers={centers}"] if centers else []
    return [f"hydra.run.dir={out}", "scenario=mesh", *files, *symmetric, *given, "quiet=true", *more]


def notes(out: Path) -> str:
    return " | ".join(json.loads((out / "summary.json").read_text())["notes"].values())


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_scores_are_those_of_a_plain_svd_and_centers_those_of_the_file(manipulation: str, tmp_path: Path) -> None:
    file = table(tmp_path / "mine.csv", POINTS, "x,y")
    out = tmp_path / "run"
    assert main(on_plane(out, file, "kernel.support=0.7", f"manipulation={manipulation}")) == 0
    record = read(out)
    np.testing.assert_array_equal(record.centers, POINTS[None])
    assert record.method.tolist() == ["given"]
    assert record.summary["centers"] == 4
    assert record.nondominated.all()

    def phi(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        r = cdist(a, b) / 0.7
        return np.where(r < 1, (1 - r) ** 4 * (4 * r + 1), 0)

    U = phi(record.vertices, POINTS)
    left = record.gradient - U @ np.linalg.lstsq(U, record.gradient, rcond=None)[0]
    if manipulation == "direct":
        U = np.linalg.solve(phi(POINTS, POINTS), U.T).T
    sigma = np.linalg.svd(U, compute_uv=False)
    assert record.regularity[0] == pytest.approx(sigma[-1] / sigma[0], abs=1e-8)
    assert record.improvement_potential[0] == pytest.approx(1 - np.square(left).sum(), abs=1e-8)


def test_every_format_gives_the_same_bits(tmp_path: Path) -> None:
    flat = np.column_stack([POINTS, np.zeros(4)])
    shuffled = np.column_stack([np.arange(4), flat[:, ::-1]])
    pv.PolyData(flat).save(tmp_path / "a.vtp")
    pv.PolyData(flat).save(tmp_path / "b.vtk")
    prm = ["# PyGeM", "[Radial Basis Functions]", "basis function: gaussian_spline", "radius: 0.5", ""]
    prm += ["[Control points]", "# where they are", "original control points:   "]
    prm[-1] += "\n    ".join(" ".join(map(repr, row)) for row in flat.tolist())
    prm += ["", "deformed control points: 9 9 9", "    8 8 8"]
    (tmp_path / "c.prm").write_text("\n".join(prm) + "\n")
    files = [
        table(tmp_path / "d.csv", POINTS, "x,y"),
        table(tmp_path / "e.csv", POINTS),
        table(tmp_path / "f.csv", flat),
        table(tmp_path / "g.csv", shuffled, "center,z,y,x"),
        *(tmp_path / name for name in ("a.vtp", "b.vtk", "c.prm")),
    ]
    (tmp_path / "h i.txt").write_text("\n".join(" ".join(map(repr, row)) for row in POINTS.tolist()))
    files.append(tmp_path / "h i.txt")
    out = tmp_path / "run"
    assert main(on_plane(out, f"[{','.join(map(str, files))}]")) == 0
    record = read(out)
    np.testing.assert_array_equal(record.centers, np.stack([POINTS] * len(files)))
    assert record.label is not None
    assert record.label.tolist() == ["d", "e", "f", "g", "a", "b", "c", "h i"]
    assert len(set(record.regularity.tolist())) == len(set(record.improvement_potential.tolist())) == 1


def test_a_directory_stands_for_its_files_in_natural_order(tmp_path: Path) -> None:
    directory = tmp_path / "setups"
    directory.mkdir()
    generator = np.random.default_rng(3)
    written = {}
    for name in ("setup-10.csv", "setup-2.csv", "setup-1.CSV"):
        written[name] = generator.uniform(0.2, 0.8, (4, 2))
        table(directory / name, written[name])
    (directory / "notes.md").write_text("not control points")
    run = tmp_path / "run"
    assert main(on_plane(run, directory)) == 0
    record = read(run)
    assert record.label is not None
    assert record.label.tolist() == ["setup-1", "setup-2", "setup-10"]
    np.testing.assert_array_equal(record.centers, [written[f"setup-{n}"] for n in ("1.CSV", "2.csv", "10.csv")])
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"neither centers\.csv of an export nor other CSV files"):
        GivenCenters(centers=str(tmp_path / "empty"))


def test_several_files_are_told_apart_by_name_and_by_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [table(tmp_path / "old.csv", POINTS), table(tmp_path / "new.csv", POINTS[::-1] * [1, 1.01])]
    out = tmp_path / "run"
    assert main([*on_plane(out, f"[{files[0]},{files[1]}]")[:-1]]) == 0
    printed = capsys.readouterr().out
    record = read(out)
    assert [record.origin(row) for row in (0, 1)] == ["given (old)", "given (new)"]
    for row, name in enumerate(("old", "new")):
        assert f"{name}: R = {record.regularity[row]:.4g}, P = {record.improvement_potential[row]:.4f}" in printed
    lines = (out / "setups.csv").read_text().splitlines()
    assert lines[0].endswith(",label")
    assert [line.rsplit(",", 1)[1] for line in lines[1:]] == ["old", "new"]
    look = series(record, "given", False)
    others = {series(record, method, False)[:3] for method in ("nsga2", "random", "lloyd", "ols", "unknown")}
    assert look[:3] not in others
    axes = picture(record).axes[0]
    assert {"old", "new"} <= {text.get_text() for text in axes.texts}
    assert look.label in axes.get_legend_handles_labels()[1]
    assert "given (old)" in page(record, out)


def test_names_are_short_and_tell_files_apart() -> None:
    assert labels_of(["a/x.csv", "b/y.vtp", "run/export-knee/centers.csv", "other/export-1"]) == (
        *("x", "y", "export-knee", "export-1"),
    )
    assert labels_of(["a/x.csv", "b/x.csv"]) == ("a/x.csv", "b/x.csv")
    assert labels_of(["1/a/x.csv", "2/a/x.csv"]) == ("1/a/x.csv", "2/a/x.csv")
    assert labels_of(["centers.csv"]) == ("centers",)


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_an_export_comes_back_with_the_same_scores_bit_for_bit(
    manipulation: str, template: Path, tmp_path: Path
) -> None:
    made, more = tmp_path / "made", [f"manipulation={manipulation}", "evaluator=eager"]
    assert main(on_egg(made, template, "", "method=lloyd", "centers=7", *more)) == 0
    assert export.main([str(made), "--pick", "index:0", "--quiet"]) == 0
    exported, before = made / "export-index-0", read(made)
    files = [exported, *(exported / name for name in ("centers.csv", "centers.vtp", "parameters.prm"))]
    files.append(exported / "displacements.csv")  # the centers without their images
    out = tmp_path / "back"
    assert main(on_egg(out, template, f"[{','.join(map(str, files))}]", *more)) == 0
    after = read(out)
    for row in range(len(files)):
        np.testing.assert_array_equal(after.centers[row], before.centers[0])
        assert after.regularity[row] == before.regularity[0]
        assert after.improvement_potential[row] == before.improvement_potential[0]
    assert "6 of 13 points left out, mirror images of others about y = 0: 7 centers, 1 of them on the plane" in notes(
        out
    )
    assert export.main([str(out), "--pick", "index:1", "--quiet"]) == 0
    for name in ("centers.csv", "displacements.csv", "weights.csv", "parameters.prm"):
        assert (out / "export-index-1" / name).read_bytes() == (exported / name).read_bytes()


def test_symmetric_files_give_one_half_scored_as_a_plain_svd_scores_it(template: Path, tmp_path: Path) -> None:
    off = HALF[:3]
    half = table(tmp_path / "half.csv", HALF)
    rows = np.concatenate([off * IMAGE, HALF, [HALF[0]]])[:-1]
    both = table(tmp_path / "both.csv", rows)
    rounded = table(tmp_path / "rounded.csv", np.concatenate([HALF, (off * IMAGE).round(7) + 1e-8]))
    left = table(tmp_path / "left.csv", HALF * IMAGE + 0.0)
    out = tmp_path / "run"
    assert main(on_egg(out, template, f"[{half},{both},{rounded},{left}]")) == 0
    record = read(out)
    for row in range(3):
        np.testing.assert_array_equal(record.centers[row], HALF)
    np.testing.assert_array_equal(record.centers[3], HALF * IMAGE)
    files = {name: getattr(record, name) for name in ("vertices", "gradient", "weights")}
    for setup, R, P in zip(record.centers, record.regularity, record.improvement_potential, strict=True):
        regularity, potential = plain_scores(files, setup, "wendland", False)
        assert regularity == pytest.approx(R, abs=1e-8)
        assert potential == pytest.approx(P, abs=1e-8)
    assert "3 points are on one side of y = 0: mirror images are added; 2 points are on the plane" in notes(out)
    assert "3 of 8 points left out, mirror images of others about y = 0: 5 centers, 2 of them on the plane" in notes(
        out
    )


def test_the_points_that_are_not_marked_as_images_are_the_centers(template: Path, tmp_path: Path) -> None:
    cloud = pv.PolyData(np.concatenate([HALF, HALF[:3] * IMAGE]))
    for name, marked in (("upper", [1, 1, 1, 0, 0, 0, 0, 0]), ("lower", [0, 0, 0, 0, 0, 1, 1, 1])):
        cloud.point_data["mirrored"] = np.array(marked, np.uint8)
        cloud.save(tmp_path / f"{name}.vtp")
    out = tmp_path / "run"
    assert main(on_egg(out, template, f"[{tmp_path / 'upper.vtp'},{tmp_path / 'lower.vtp'}]")) == 0
    record = read(out)
    np.testing.assert_array_equal(record.centers[0], np.concatenate([HALF[3:], HALF[:3] * IMAGE]))
    np.testing.assert_array_equal(record.centers[1], HALF)
    np.testing.assert_allclose(record.regularity[0], record.regularity[1], rtol=1e-9)


def test_points_marked_as_images_are_points_of_their_own_without_symmetry(template: Path, tmp_path: Path) -> None:
    rows = np.concatenate([np.column_stack([HALF, np.zeros(5)]), np.column_stack([HALF[:3] * IMAGE, np.ones(3)])])
    file, out = table(tmp_path / "a.csv", rows, "x,y,z,mirrored"), tmp_path / "run"
    assert main(on_egg(out, template, file, "scenario.symmetry=null", "scenario.symmetry_at=null")) == 0
    np.testing.assert_array_equal(read(out).centers[0], rows[:, :3])
    assert "calls 3 of them mirror images of others; without scenario.symmetry" in notes(out)


def test_what_is_odd_is_scored_as_it_is_with_a_note(template: Path, tmp_path: Path) -> None:
    odd = HALF.copy()
    odd[0] = (-9.0, 0.5, 0.2)  # outside
    odd[1] = odd[2]  # in one place
    odd[3, 1] = 1e-9  # all but on the plane
    out = tmp_path / "run"
    hold = ["scenario.hold=[1,null,null,null,null,null]", "scenario.hold_width=0.3"]
    assert main(on_egg(out, template, table(tmp_path / "odd.csv", odd), *hold)) == 0
    record, found = read(out), notes(out)
    np.testing.assert_array_equal(record.centers[0], odd)
    assert record.regularity[0] == 0.0
    assert record.improvement_potential[0] > 0.0
    assert "1 of 5 points is outside the box of the search (center 0)" in found
    assert "2 of 5 points are in the same place as another (center 1, 2): R = 0" in found
    assert "2 of 5 points are in the region where searches place none (center 1, 2)" in found
    assert "row 3 all but on the plane, and their images almost in the same place: R is near 0" in found


def test_a_planar_design_takes_points_in_its_mid_plane_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    surface = strip(48)
    x = np.asarray(surface.points)
    file = saved(surface, tmp_path / "slab.vtp", s=np.stack([x[:, 0] ** 3, x[:, 1], 0 * x[:, 0]], axis=1))
    flat = np.array([[-1.5, 0.4], [0.3, 0.9], [1.2, -0.7]])

    def arguments(name: str, centers: Any) -> list[str]:
        mesh = [f"scenario.template={file}", "scenario.sensitivity=s", "scenario.planar=z"]
        given = ["method=given", f"method.centers={centers}", "kernel.support=1.5", "quiet=true"]
        return [f"hydra.run.dir={tmp_path / name}", "scenario=mesh", *mesh, *given]

    near = np.column_stack([flat, np.full(3, 0.05 + 1e-12)])
    files = [table(tmp_path / "flat.csv", flat, "x,y"), table(tmp_path / "near.csv", near)]
    assert main(arguments("run", f"[{files[0]},{files[1]}]")) == 0
    record = read(tmp_path / "run")
    at = record.summary["planar"]["at"]
    np.testing.assert_array_equal(record.centers, [np.column_stack([flat, np.full(3, at)])] * 2)
    assert "have no z, and are taken in the mid-plane z = 0.05" in notes(tmp_path / "run")
    assert "off the mid-plane by up to 1.0e-12, which is rounding: taken on it" in notes(tmp_path / "run")
    wrong = np.column_stack([flat, [0.05, 0.0, 0.05]])
    assert main(arguments("other", table(tmp_path / "wrong.csv", wrong))) == 2
    line = capsys.readouterr().err
    assert "1 of 3 points is off the mid-plane z = 0.05" in line
    assert "by up to 0.05 (row 1); put them on it, or leave the column z out" in line


REFUSED = {
    "no_file": (None, "no such file"),
    "empty": ("", "the file is empty"),
    "rows": ("x,y\n", "there are no lines with numbers in it"),
    "nan": ("x,y\n0.1,0.2\nnan,0.3\n", "1 of 2 points have coordinates that are not finite"),
    "infinite": ("0.1,0.2\ninf,0.3\n", "1 of 2 points have coordinates that are not finite"),
    "text": ("x,y\n0.1,0.2\n0.1,there\n", "row 1 (from 0) has 'there' where a number is expected"),
    "ragged": ("0.1,0.2\n0.1\n", "row 1 (from 0) has 1 fields instead of 2"),
    "height": ("0.1,0.2,0.3\n", "have three coordinates, and z is up to 0.3; scenario plane has two dimensions"),
    "axes": ("x,z\n0.1,0.2\n", "have coordinates x and z, but scenario plane has x and y"),
    "header": ("a,b\n0.1,0.2\n", "its header, a, b, does not name x, y and z, or two of them"),
    "columns": ("0,0.1,0.2,0\n1,0.2,0.2,0\n", "it has 4 columns and no header"),
    "huge": ("1e200,0.2\n", "a coordinate is as large as 1.0e+200"),
    "flags": ("x,y,mirrored\n0.1,0.2,2\n", "its column mirrored must hold 0 or 1"),
    "ffd.prm": ("[Box info]\nn control points x: 2\n", "it has no 'original control points' in a section"),
    "two.prm": ("[Control points]\noriginal control points: 0 0\n", "a point needs three coordinates, not '0 0'"),
    "word.prm": ("[Control points]\noriginal control points: 0 0 a\n", "could not convert string to float: 'a'"),
    "none.prm": ("[Control points]\noriginal control points:\n", "there are no control points in it"),
    "damaged.prm": ("original control points: 0 0 0\n", "File contains no section headers"),
    "damaged.vtp": ("<VTKFile", "not a readable VTP file"),
    "mesh.stl": ("solid\n", "unknown ending '.stl'; control points can be CSV, TXT, TSV, XYZ, VTP, VTK, VTU, PLY, PRM"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_that_cannot_be_used_is_one_line_and_leaves_nothing(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content, message = REFUSED[name]
    file = tmp_path / (name if "." in name else f"{name}.csv")
    if content is not None:
        file.write_text(content)
    assert main(on_plane(tmp_path / "run", file)) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"rbfevo: {file}: ")
    assert message in said.err
    assert said.err.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_files_that_contradict_each_other_or_a_setting_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = table(tmp_path / "a.csv", POINTS), table(tmp_path / "b.csv", POINTS[:3])
    cases = {
        f"[{a},{b}]": ([], f"{a} has 4, {b} has 3; with -m and without the brackets each file gets a run of its own"),
        f"{a}": (["centers=25"], "centers=25: the setups of method=given have 4 centers; leave centers= out, or"),
        f"[{a},{a}]": ([], "a file is listed twice"),
        "[]": ([], "method.centers=[]: give a file with control points, or a list of files"),
        "null": ([], "method.centers=null: give a file with control points, or a list of files"),
        "[1,2]": ([], "method.centers=[1, 2]: give a file with control points, or a list of files"),
        f"{tmp_path}": ([], f"{tmp_path}/a.csv has 4, {tmp_path}/b.csv has 3; with -m and without the brackets"),
        f"{a} ": (["preference=0.5"], "preference=0.5: method=given finds the same setups without it"),
    }
    for centers, (more, message) in cases.items():
        assert main(on_plane(tmp_path / "run", centers.strip(), *more)) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
        assert not (tmp_path / "run").exists()
    without = [text for text in on_plane(tmp_path / "run", "") if not text.startswith("method.centers")]
    assert main(without) == 2
    assert "method.centers=null: give a file with control points" in capsys.readouterr().err
    assert main(on_plane(tmp_path / "run", a, "centers=4")) == 0
    assert main(on_plane(tmp_path / "again", tmp_path / "run")) == 2
    assert "this is a run, with many setups; export one: python -m rbfevo.export" in capsys.readouterr().err


def test_points_that_do_not_fit_a_design_in_space_are_one_line(
    template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lone, tilted = np.concatenate([HALF, HALF[:2] * IMAGE]), np.concatenate([HALF, HALF[:3] * IMAGE])
    tilted[3, 1] = 1e-8
    twice = np.concatenate([HALF[:1], HALF[:1], HALF[:1] * IMAGE])
    many = np.random.default_rng(0).normal(size=(700, 3))
    cases = [
        (POINTS, "its points have two coordinates, x and y; scenario mesh has three dimensions: give x, y and z"),
        (lone, "it is not symmetric: 1 of 7 points (row 2) have no mirror image about y = 0 in it; give all images"),
        (tilted, "1 of 8 points (row 3) have no mirror image about y = 0 in it; give all images, or the points on one"),
        (twice, "it is not symmetric: 1 of 3 points (row 1) have no mirror image about y = 0 in it"),
        (np.abs(many), "centers=700: scenario mesh has only 642 vertices; use fewer"),
    ]
    for points, message in cases:
        assert main(on_egg(tmp_path / "run", template, table(tmp_path / "a.csv", points))) == 2
        said = capsys.readouterr().err
        assert message in said
        assert ("1 point is almost on the plane: give y = 0 there" in said) == (points is tilted)
        assert said.count("\n") == 1
        assert not (tmp_path / "run").exists()


def test_a_run_that_goes_on_refuses_centers_that_have_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = table(tmp_path / "a.csv", POINTS), tmp_path / "run"
    write_lines = Journal.record

    def record_and_interrupt(journal: Journal, lines: Any) -> None:
        write_lines(journal, lines)
        signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "record", record_and_interrupt)
        assert main(on_plane(out, file)) == 143
    capsys.readouterr()
    table(file, POINTS * 1.01)
    assert main([f"resume={out}"]) == 2
    assert "have changed since the run started" in capsys.readouterr().err
    table(file, POINTS)
    assert main([f"resume={out}"]) == 0
    np.testing.assert_array_equal(read(out).centers[0], POINTS)


def test_given_setups_stand_beside_a_searched_front_in_one_collection(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep, four = tmp_path / "sweep", table(tmp_path / "four.csv", POINTS)
    three = table(tmp_path / "three.csv", POINTS[:3])
    budget = ["method.generations=4", "method.population=8", "centers=4", "quiet=true"]
    assert main([f"hydra.run.dir={sweep / 'searched'}", "scenario=plane", "method=nsga2", *budget]) == 0
    jobs = ["-m", "scenario=plane", "method=given", f"method.centers={four},{three}", "figures=false", "quiet=true"]
    assert main([f"hydra.sweep.dir={sweep / 'given'}", *jobs]) == 0
    capsys.readouterr()
    assert collect.main([str(sweep)]) == 0
    said = capsys.readouterr().out
    assert "3 runs; written in" in said
    lines = (sweep / "runs.csv").read_text().splitlines()
    names = lines[0].split(",")
    found = {(line.split(",")[0], line.split(",")[names.index("centers")]) for line in lines[1:]}
    assert found == {("given/0", "4"), ("given/1", "3"), ("searched", "4")}
    page = (sweep / "report.html").read_text()
    assert "placed by hand" in page
    assert "front (nsga2)" in page


def test_the_class_works_without_a_run(tmp_path: Path) -> None:
    from rbfevo.scenarios import plane

    method = GivenCenters(str(table(tmp_path / "a.csv", POINTS)))
    count, said = method.bring(plane())
    assert (count, list(said)) == (4, ["centers a"])
    assert method.inputs is not None
    np.testing.assert_array_equal(method.inputs.numpy(), POINTS[None])


def test_a_home_directory_and_upper_case_endings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    shutil.copy(table(tmp_path / "a.csv", POINTS), tmp_path / "A.CSV")
    np.testing.assert_array_equal(read_control_points("~/A.CSV").points, POINTS)
