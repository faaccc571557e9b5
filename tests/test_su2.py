"""SU2 in and out: markers as templates, sensitivities in any order, surface positions as SU2_DEF reads them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from su2_files import csv, flow, vtu
from test_curves import SQUARE_SU2
from test_export import a_run

from rbfevo import apply, export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.fit.source import rebuild
from rbfevo.meshes import opened
from rbfevo.recorded.record import read
from rbfevo.scenarios import mesh
from rbfevo.scenarios.scenario import Scenario

DIMENSIONS = [2, 3]


def fields(d: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """A mesh, vectors [n, d] of all its points, and their component along the outward normal of the body."""
    made = flow(d)
    x = made.points
    vectors = np.stack([np.sin(x[:, 0] + i) + 0.3 * i for i in range(d)], axis=1) * (1.0 + x[:, 1:2] ** 2)
    return made, vectors, (vectors * made.outward).sum(axis=1)


def built(folder: Path, d: int, **settings: Any) -> Scenario:
    made = flow(d)
    (folder / "mesh.su2").write_text(made.text)
    planar = {"planar": "z"} if d == 2 else {}
    return mesh(template=str(folder / "mesh.su2"), patches=["body"], **planar, **settings)


def wanted(made: Scenario) -> np.ndarray:
    return made.gradient.numpy() * made.gradient_norm


@pytest.mark.parametrize("first", ["Point", "PointID"])
@pytest.mark.parametrize("d", DIMENSIONS)
def test_surface_adjoint_csv_in_any_order(d: int, first: str, tmp_path: Path) -> None:
    made, vectors, along = fields(d)
    (tmp_path / "surface_adjoint.csv").write_text(csv(made, vectors, -along, first))
    found = built(tmp_path, d, sensitivity=str(tmp_path / "surface_adjoint.csv"))
    rows = np.sort(made.body)
    assert found.rows is not None
    np.testing.assert_array_equal(found.rows.numpy(), rows)
    np.testing.assert_array_equal(found.vertices.numpy()[:, :d], made.points[rows])
    expected = np.zeros((len(rows), 3))
    expected[:, :d] = -vectors[rows]
    np.testing.assert_allclose(wanted(found), expected, rtol=1e-13, atol=1e-15)
    assert f"rows by '{first}', from 0, coordinates agree to" in found.notes["sensitivity rows"]
    assert "of SU2_CFD_AD, since there are Adjoint_ columns" in found.notes["sensitivity rows"]
    assert "inward normal" in found.notes["scalar sensitivity"]
    assert "as SU2_CFD_AD writes it of a body" in found.notes["scalar sensitivity"]


@pytest.mark.parametrize("d", DIMENSIONS)
def test_surface_sens_vtu_is_matched_by_coordinates(d: int, tmp_path: Path) -> None:
    made, vectors, along = fields(d)
    path = vtu(tmp_path / "surface_sens.vtu", made, vectors, along)
    found = built(tmp_path, d, sensitivity=str(path))
    rows = np.sort(made.body)
    np.testing.assert_allclose(wanted(found)[:, :d], -vectors[rows], rtol=1e-6, atol=1e-7)
    note = found.notes["sensitivity rows"]
    assert "rows by coordinates" in note
    assert "single precision: a CSV with all digits" in note
    assert "SU2_CFD_AD" not in note
    assert "outward normal" in found.notes["scalar sensitivity"]
    assert "as SU2_DOT writes it of a body" in found.notes["scalar sensitivity"]
    scalar = built(tmp_path, d, sensitivity=f"{path}:Surface_Sensitivity", sensitivity_normal="outward")
    assert "one value per vertex, along its outward normal" in scalar.notes["sensitivity"]
    with pytest.raises(UserError, match="it has no quantities named Gradient; there are sensitivity, surface_sens"):
        built(tmp_path, d, sensitivity=f"{path}:Gradient")


def test_a_scalar_that_does_not_belong_to_the_vector_is_told(tmp_path: Path) -> None:
    made, vectors, _ = fields(3)
    (tmp_path / "a.csv").write_text(csv(made, vectors, np.random.default_rng(0).normal(size=len(vectors))))
    found = built(tmp_path, 3, sensitivity=str(tmp_path / "a.csv"))
    assert "is not its component along the normals" in found.notes["scalar sensitivity"]
    np.testing.assert_allclose(wanted(found), -vectors[np.sort(made.body)], rtol=1e-13)


@pytest.mark.parametrize("d", DIMENSIONS)
def test_a_scalar_alone_is_asked_about_and_both_answers_count(d: int, tmp_path: Path) -> None:
    """SU2_CFD_AD's scalar of a body along `inward`, and SU2_DOT's along `outward`, mean the same vectors."""
    made, _, _ = fields(d)
    size = 2.0 + made.points[:, 0]
    for name, scalar in (("cfd", -size), ("dot", size)):
        (tmp_path / f"{name}.csv").write_text(csv(made, size[:, None] * made.outward, scalar, vector=False))
    path = str(tmp_path / "cfd.csv")
    with pytest.raises(UserError, match=r"SU2_CFD_AD writes.*normal=inward.*SU2_DOT.*normal=outward") as caught:
        built(tmp_path, d, sensitivity=path)
    assert "\n" not in str(caught.value)
    found = built(tmp_path, d, sensitivity=path, sensitivity_normal="inward")
    same = built(tmp_path, d, sensitivity=str(tmp_path / "dot.csv"), sensitivity_normal="outward")
    np.testing.assert_allclose(wanted(found), wanted(same), rtol=1e-12)
    rows = np.sort(made.body)
    np.testing.assert_allclose((wanted(found)[:, :d] * made.outward[rows]).sum(axis=1), -size[rows], rtol=0.02)


def test_ids_of_another_numbering_leave_it_to_the_coordinates(tmp_path: Path) -> None:
    """Ids from 1 are confirmed by coordinates; those of a part of the mesh are not, and pass."""
    made, vectors, along = fields(2)
    header, *lines = csv(made, vectors, -along).splitlines()
    expected = -vectors[np.sort(made.body)]
    for shift, told in ((1, "rows by 'Point', from 1"), (7, "rows by coordinates")):
        moved = [f"{(int(line.split(',')[0]) + shift)},{line.partition(',')[2]}" for line in lines]
        (tmp_path / "a.csv").write_text("\n".join([header, *moved]) + "\n")
        found = built(tmp_path, 2, sensitivity=str(tmp_path / "a.csv"))
        np.testing.assert_allclose(wanted(found)[:, :2], expected, rtol=1e-13)
        assert told in found.notes["sensitivity rows"]


def def_reads(text: str, markers: list[np.ndarray], n: int, d: int) -> np.ndarray:
    """New coordinates [n, d] of the markers' points as SU2_DEF reads them: what is not listed goes to the origin."""
    places = np.full((n, d), np.nan)
    for points in markers:
        places[points] = 0.0
    for line in text.splitlines():
        index, *numbers = line.split()
        assert len(numbers) == d
        assert re.fullmatch(r"\d+", index)
        if not np.isnan(places[int(index)]).all():
            places[int(index)] = [float(number) for number in numbers]
    return places


@pytest.mark.parametrize("d", DIMENSIONS)
def test_from_mesh_to_surface_positions(d: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made, vectors, along = fields(d)
    (tmp_path / "mesh.su2").write_text(made.text)
    (tmp_path / "surface_adjoint.csv").write_text(csv(made, vectors, -along))
    given = [f"scenario.template={tmp_path / 'mesh.su2'}", "scenario.patches=[body]"]
    given += [f"scenario.sensitivity={tmp_path / 'surface_adjoint.csv'}", *(["scenario.planar=z"] if d == 2 else [])]
    out = tmp_path / "run"
    plain = ["method=lloyd", "centers=5", "scenario.support=100%", "figures=false", "quiet=true", "evaluator=eager"]
    assert main([f"hydra.run.dir={out}", "scenario=mesh", *given, *plain]) == 0
    assert export.main([str(out), "--pick", "index:0", "--step", "0.01", "--quiet"]) == 0
    table = out / "export-index-0" / "displacements.csv"
    source = tmp_path / "mesh.su2"
    command = [str(out), "--pick", "index:0", "--displacements", str(table), "--mesh", str(source), "--out"]
    capsys.readouterr()
    assert apply.main([*command, str(tmp_path / "moved.su2")]) == 0
    told = capsys.readouterr().out
    assert "the FFD boxes MAIN_BOX, TAIL are kept as they were" in told
    assert "DV_KIND= FFD_SETTING" in told
    assert (tmp_path / "moved.su2").read_text().endswith(source.read_text()[source.read_text().index("NMARK") :])
    with opened(tmp_path / "moved.su2") as deformed:
        moved = deformed.points[:, :d]
    assert np.abs(moved - made.points)[made.body].max() > 1e-3

    assert apply.main([*command, str(tmp_path / "surface_positions.dat")]) == 0
    told = capsys.readouterr().out
    both = len(made.body) + len(made.far)
    assert f"{both} of {len(moved)} points" in told
    assert "DV_MARKER= ( body, far )" in told
    text = (tmp_path / "surface_positions.dat").read_text()
    assert len(text.splitlines()) == both
    for markers in ([made.body], [made.body, made.far]):
        rows = np.concatenate(markers)
        np.testing.assert_array_equal(def_reads(text, markers, len(moved), d)[rows], moved[rows])

    assert apply.main([*command, str(tmp_path / "body.dat"), "--patches", "body"]) == 0
    assert "DV_MARKER= ( body ): these markers and no others" in capsys.readouterr().out
    alone = def_reads((tmp_path / "body.dat").read_text(), [made.body], len(moved), d)
    np.testing.assert_array_equal(alone[made.body], moved[made.body])
    assert len((tmp_path / "body.dat").read_text().splitlines()) == len(made.body)

    for arguments, message in (
        (["a.dat", "--patches", "wing"], "--patches=wing: there is no such patch; there are body, far"),
        (["a.su2", "--patches", "body"], "--patches is for surface positions of SU2"),
        (["a.csv"], "choose the ending of the mesh, .su2, or one of .vtp, .vtu, .vtk, or .dat for surface positions"),
        (["surface_positions.dat"], "already exists"),
    ):
        assert apply.main([*command, str(tmp_path / arguments[0]), *arguments[1:]]) == 2
        assert message in capsys.readouterr().err


def test_a_file_and_the_name_in_it_are_found_again_from_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, vectors, along = fields(3)
    (tmp_path / "mesh.su2").write_text(made.text)
    vtu(tmp_path / "surface sens.vtu", made, vectors, along)
    monkeypatch.chdir(tmp_path)
    given = ["scenario=mesh", "scenario.template=mesh.su2", "scenario.patches=[body]", "method=lloyd", "centers=4"]
    given += ["scenario.sensitivity=surface sens.vtu:Sensitivity", "figures=false", "quiet=true", "evaluator=eager"]
    assert main(["hydra.run.dir=run", *given]) == 0
    monkeypatch.chdir(tmp_path.parent)
    again = rebuild(tmp_path / "run", read(tmp_path / "run")).scenario
    np.testing.assert_allclose(wanted(again), -vectors[np.sort(made.body)], rtol=1e-6, atol=1e-7)


def test_points_of_two_markers_are_listed_once_and_the_inside_may_turn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, made = a_run(tmp_path / "run"), flow(3)
    square = SQUARE_SU2.replace("NDIME= 2", "NDIME= 3").replace("0.0 0.0 0\n", "0.0 0.0 0.5 0\n")
    (tmp_path / "square.su2").write_text(re.sub(r"(?m)^([01]\.0 [01]\.0) (\d)$", r"\1 0.25 \2", square))
    (tmp_path / "bare.su2").write_text(made.text[: made.text.index("NMARK")] + "NMARK= 0\n")
    (tmp_path / "flow.su2").write_text(made.text)
    np.save(tmp_path / "d.npy", np.tile([1.2, -2.7, 0.0], (6, 1)) * np.arange(6)[:, None])
    command = [str(run), "--pick", "index:0", "--displacements", str(tmp_path / "d.npy"), "--out"]
    assert apply.main([*command, str(tmp_path / "a.dat"), "--mesh", str(tmp_path / "square.su2")]) == 0
    assert [line.split("\t")[0] for line in (tmp_path / "a.dat").read_text().splitlines()] == ["0", "1", "2", "3"]
    assert apply.main([*command, str(tmp_path / "b.dat"), "--mesh", str(tmp_path / "flow.su2")]) == 0
    capsys.readouterr()
    assert apply.main([*command, str(tmp_path / "b.su2"), "--mesh", str(tmp_path / "flow.su2")]) == 2
    assert "inside out" in capsys.readouterr().err
    assert apply.main([*command, str(tmp_path / "c.dat"), "--mesh", str(tmp_path / "bare.su2")]) == 2
    assert "the mesh has no markers" in capsys.readouterr().err
