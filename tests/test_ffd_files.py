"""Exports of free-form deformation: what other programs do with them, apply beside U P, and boxes read back."""

from __future__ import annotations

import configparser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from test_ffd import EPS, pygem
from test_ffd_manipulations import LATTICE, blocks, surfaced
from test_mesh_runs import egg

from rbfevo import apply, export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.meshes.lattices import read_lattice
from rbfevo.recorded.exported import read_export
from rbfevo.recorded.parameters import Displacement, Parameters
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import setup

RANDOM = ["method=random", "method.population=12"]
KINDS = {  # keys of a run
    "plain": ["representation.lattice=[4,3,3]", "representation.turn=z"],
    "splines": ["representation.lattice=[5,4,4]", "representation.degree=[3,3,2]", "representation.knots=true"],
    "inner": ["representation.lattice=[5,5,5]", "representation.active=inner"],
    "symmetric": ["representation.lattice=[3,5,2]", "scenario.symmetry=y", "scenario.symmetry_at=0"],
    "surface": ["representation.lattice=[4,3,3]", "manipulation=direct", "centers=9"],
    "both": ["representation.lattice=[3,5,2]", "scenario.symmetry=y", "scenario.symmetry_at=0", "manipulation=direct"],
}
KINDS["both"].append("centers=7")
FILES = ("", "setup.npz", "lattice.xyz", "lattice.vts", "su2.cfg", "parameters.prm")


def mesh_keys(template: Path) -> list[str]:
    keys = ["scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    return [*keys, "representation=ffd", "figures=false", "quiet=true"]


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"), subdivisions=2)


@pytest.fixture(scope="module")
def runs(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a run of each kind, and an export of the setup of the largest P of each."""
    place = tmp_path_factory.mktemp("ffd")
    for kind, keys in KINDS.items():
        assert main([*mesh_keys(template), *keys, *RANDOM, f"hydra.run.dir={place / kind}"]) == 0
        assert (
            export.main(
                [
                    str(place / kind),
                    "--pick",
                    "best-improvement-potential",
                    "--out",
                    str(place / f"{kind}-export"),
                    "--quiet",
                ]
            )
            == 0
        )
    return place


def best(runs: Path, kind: str) -> tuple[Record, int, Any]:
    record = read(runs / kind)
    row = int(np.load(runs / f"{kind}-export" / "setup.npz")["row"])
    assert record.genotype is not None
    return record, row, record.genotype[row]


def rows(path: Path) -> Any:
    return np.loadtxt(path, delimiter=",", skiprows=1)


def applied(runs: Path, kind: str, what: str, out: Path) -> Any:
    """Displacements of the template under the weights or the displacements of an export."""
    made = runs / f"{kind}-export"
    arguments = [
        "--pick",
        "best-improvement-potential",
        f"--{what}",
        str(made / f"{what}.csv"),
        "--mesh",
        str(made / "template.vtp"),
    ]
    assert apply.main([str(runs / kind), *arguments, "--out", str(out), "--quiet"]) == 0
    return np.asarray(pv.read(out).points) - np.asarray(pv.read(made / "template.vtp").points)


@pytest.mark.parametrize("kind", KINDS)
def test_apply_does_what_the_columns_do(kind: str, runs: Path, tmp_path: Path) -> None:
    record, _, genotype = best(runs, kind)
    made = runs / f"{kind}-export"
    moved = {what: applied(runs, kind, what, tmp_path / f"{what}.vtp") for what in ("displacements", "weights")}
    np.testing.assert_allclose(moved["displacements"], moved["weights"], atol=1e-9)
    saved = np.load(made / "setup.npz")
    P = rows(made / "displacements.csv")[:, 4:7]
    if "U_across" in saved:
        expected = np.empty_like(moved["weights"])
        expected[:, [0, 2]] = saved["U"] @ P[:, [0, 2]]
        expected[:, 1] = saved["U_across"] @ P[saved["across"], 1]
    else:
        expected = saved["U"] @ P
    np.testing.assert_allclose(moved["displacements"], expected, atol=1e-9)
    longest = np.linalg.norm(moved["weights"], axis=1).max()
    assert longest == pytest.approx(0.05 * np.linalg.norm(np.ptp(record.vertices, axis=0)))
    if kind == "both":  # by plain NumPy
        U = surfaced(record.vertices, record.centers[0], genotype)
        np.testing.assert_allclose(saved["U"], U[0], atol=1e-10)
        np.testing.assert_allclose(saved["U_across"], U[1], atol=1e-10)
    if kind == "symmetric":
        U = blocks(record.vertices, genotype)
        np.testing.assert_allclose(saved["U"], U[0], atol=1e-13)
        np.testing.assert_allclose(saved["U_across"], U[1], atol=1e-13)
    np.testing.assert_allclose(saved["Q"] @ saved["T"], saved["U"], atol=1e-9)


@pytest.mark.parametrize("kind", ["surface", "both"])
def test_the_step_of_points_on_the_surface_stays_within_what_they_reach(kind: str, runs: Path, tmp_path: Path) -> None:
    for rule in ("natural", "steepest"):
        out = tmp_path / rule
        assert (
            export.main(
                [str(runs / kind), "--pick", "best-improvement-potential", "--rule", rule, "--out", str(out), "--quiet"]
            )
            == 0
        )
        saved, P = np.load(out / "setup.npz"), rows(out / "displacements.csv")[:, 4:7]
        reached = np.asarray(pv.read(out / "template.vtp").point_data["reached"])
        np.testing.assert_allclose(reached[:, [0, 2]], saved["U"] @ P[:, [0, 2]], atol=1e-9)
        if rule == "steepest":  # P is along -U^T s
            record = read(runs / kind)
            pulled = saved["U"].T @ record.gradient[:, [0, 2]]
            np.testing.assert_allclose(
                P[:, [0, 2]] / np.abs(P[:, [0, 2]]).max(), pulled / np.abs(pulled).max(), atol=1e-9
            )


@pytest.mark.parametrize("kind", ["plain", "inner", "symmetric"])
def test_pygem_deforms_as_apply_does(kind: str, runs: Path, tmp_path: Path) -> None:
    """By the map that PyGeM documents: into the unit cube, there by Bernstein polynomials, and back."""
    record, _, genotype = best(runs, kind)
    parser = configparser.RawConfigParser()
    parser.read(runs / f"{kind}-export" / "parameters.prm")
    counts, sides, origin, angles = (
        np.array([float(parser.get("Box info", f"{name} {letter}")) for letter in "xyz"])
        for name in ("n control points", "box length", "box origin", "rotation angle")
    )
    counts = counts.astype(int)
    mu = np.zeros((*counts, 3))
    for axis, letter in enumerate("xyz"):
        for line in parser.get("Parameters weights", f"parameter {letter}").split("\n"):
            *index, value = line.split()
            mu[(*map(int, index), axis)] = float(value)
    assert not angles[:2].any()
    assert (angles[2] != 0.0) == (kind == "plain")
    c, s = np.cos(np.radians(angles[2])), np.sin(np.radians(angles[2]))
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    frame = turned * sides  # psi^-1 is origin + frame u
    u = np.linalg.solve(frame, (record.vertices - origin).T).T
    inside: Any = ((u > -1e-12) & (u < 1.0 + 1e-12)).all(axis=1)
    B = pygem(u, np.zeros(3), np.ones(3), counts)
    moved = np.where(inside[:, None], (B @ mu.reshape(-1, 3)) @ frame.T, 0.0)
    np.testing.assert_allclose(moved, applied(runs, kind, "weights", tmp_path / "a.vtp"), atol=1e-9)
    half = frame.sum(axis=1) / 2.0
    np.testing.assert_allclose(origin + half, genotype[:3], atol=1e-12)


@pytest.mark.parametrize("kind", ["plain", "symmetric"])
def test_su2_moves_the_control_points_as_apply_does(kind: str, runs: Path, tmp_path: Path) -> None:
    record, _, _ = best(runs, kind)
    text = (runs / f"{kind}-export" / "su2.cfg").read_text()
    settings = dict(line.split("= ", 1) for line in text.splitlines() if not line.startswith("%"))
    corners = np.array(settings["FFD_DEFINITION"].strip("() ").split(", ")[1:], float).reshape(8, 3)
    counts = np.array(settings["FFD_DEGREE"].strip("() ").split(", "), int) + 1
    np.testing.assert_allclose(corners[2] - corners[1], corners[3] - corners[0], atol=1e-12)  # around a face
    np.testing.assert_allclose(corners[6] - corners[2], corners[4] - corners[0], atol=1e-12)
    frame = np.stack([corners[1] - corners[0], corners[3] - corners[0], corners[4] - corners[0]], axis=1)
    moves = np.zeros((*counts, 3))
    kinds, values = settings["DV_KIND"].split(", "), settings["DV_VALUE"].split(", ")
    parameters = settings["DV_PARAM"].split("; ")
    assert len(kinds) == len(values) == len(parameters)
    for parameter, value in zip(parameters, values, strict=True):
        tag, *numbers = parameter.strip("() ").split(", ")
        assert tag == "BOX"
        moves[tuple(map(int, numbers[:3]))] += float(value) * np.array(numbers[3:], float)
    u = np.linalg.solve(frame, (record.vertices - corners[0]).T).T
    moved = pygem(u, np.zeros(3), np.ones(3), counts) @ moves.reshape(-1, 3)
    np.testing.assert_allclose(moved, applied(runs, kind, "weights", tmp_path / "a.vtp"), atol=1e-9)


def test_lattices_are_whole_and_in_the_order_of_their_formats(runs: Path, tmp_path: Path) -> None:
    record, row, _ = best(runs, "symmetric")
    made = runs / "symmetric-export"
    found = read_lattice(made / "lattice.xyz")
    assert found.counts == LATTICE
    centers = record.centers[row]
    every = np.concatenate([centers, centers * [1.0, -1.0, 1.0]])
    apart = np.linalg.norm(found.places.reshape(-1, 1, 3) - every[None], axis=2).min(axis=1)
    assert apart.max() < 1e-12
    numbers = (made / "lattice.xyz").read_text().split()
    assert numbers[:4] == ["1", "3", "5", "2"]
    assert float(numbers[5]) == found.places[1, 0, 0, 0]  # the first axis runs fastest
    grid: Any = pv.read(made / "lattice.vts")
    assert grid.dimensions == LATTICE
    np.testing.assert_array_equal(np.asarray(grid.points)[1], found.places[1, 0, 0])
    moves = np.asarray(grid.point_data["displacement"]).reshape(2, 5, 3, 3)  # the last axis first
    np.testing.assert_allclose(moves[:, ::-1], moves * [1.0, -1.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(
        pygem_of(record, grid, moves), applied(runs, "symmetric", "weights", tmp_path / "a.vtp"), atol=1e-9
    )


def pygem_of(record: Record, grid: Any, moves: Any) -> Any:
    low, high = np.asarray(grid.points).min(axis=0), np.asarray(grid.points).max(axis=0)
    return pygem(record.vertices, low, high - low, LATTICE) @ moves.transpose(2, 1, 0, 3).reshape(-1, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_boxes_are_read_back(kind: str, runs: Path, template: Path, tmp_path: Path) -> None:
    record, row, genotype = best(runs, kind)
    made = runs / f"{kind}-export"
    splines = kind == "splines"
    assert [name for name in FILES if not (made / name).exists()] == (["su2.cfg", "parameters.prm"] if splines else [])
    for name in FILES:
        if not (made / name).exists():
            continue
        again = tmp_path / f"again-{name or 'directory'}"
        keys = ["method=given", f"method.centers={made / name}", f"hydra.run.dir={again}"]
        assert main([*mesh_keys(template), *KINDS[kind], *keys]) == 0
        found = read(again)
        assert found.genotype is not None
        np.testing.assert_allclose(found.genotype[0], genotype, atol=1e-9)
        assert found.improvement_potential[0] == pytest.approx(record.improvement_potential[row], abs=1e-9)
        assert found.regularity[0] == pytest.approx(record.regularity[row], rel=1e-6, abs=1e-12)


def test_su2_meshes_with_a_box_are_read(tmp_path: Path) -> None:
    corners = ["0 0 0", "2 0 0", "2 1 0", "0 1 0", "0 0 3", "2 0 3", "2 1 3", "0 1 3"]
    lines = ["NDIME= 3", "FFD_NBOX= 1", "FFD_TAG= WING", "FFD_DEGREE_I= 3", "FFD_DEGREE_J= 2", "FFD_DEGREE_K= 1"]
    path = tmp_path / "mesh.su2"
    path.write_text("\n".join([*lines, "FFD_CORNER_POINTS= 8", *corners, "FFD_CONTROL_POINTS= 24", ""]))
    found = read_lattice(path)
    assert found.counts == (4, 3, 2)
    np.testing.assert_array_equal(found.places[1, 0, 1], [2.0, 0.0, 3.0])
    path.write_text("NDIME= 3\n")
    with pytest.raises(UserError, match="it has 0 FFD boxes, and one is expected"):
        read_lattice(path)


def test_files_that_do_not_fit_are_refused_in_a_line(
    runs: Path, template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = runs / "plain-export"
    text = (made / "lattice.xyz").read_text()
    cut, bent, far, text_file = (tmp_path / name for name in ("cut.xyz", "bent.xyz", "far.prm", "a.stl"))
    cut.write_text("\n".join(text.splitlines()[:-1]))
    numbers = text.split("\n")
    numbers[6] = repr(float(numbers[6]) + 0.1)
    bent.write_text("\n".join(numbers))
    parameters = (made / "parameters.prm").read_text()
    far.write_text("\n".join("box origin x: 50.0" if "origin x" in line else line for line in parameters.splitlines()))
    text_file.write_text("")
    plain, symmetric = KINDS["plain"], KINDS["symmetric"]
    for keys, file, line in (
        (plain, cut, "107 coordinates, but 108 belong to its sizes"),
        (plain, bent, "control points are up to 0.1 away from those of an undeformed box"),
        (plain, far, "no vertex of the design lies in its box"),
        (plain, text_file, "unknown ending '.stl'; a lattice can be xyz, cfg, su2, prm, vts, or an export"),
        (plain, tmp_path, "this directory has neither centers.csv of an export nor other CSV files"),
        (plain, runs / "plain", "this is a run, with many setups"),
        (plain, runs / "inner-export", "its lattice is [5, 5, 5], and that of the run [4, 3, 3]"),
        (
            plain,
            runs / "inner-export" / "lattice.xyz",
            "its lattice is 5 x 5 x 5, and representation.lattice=[4, 3, 3]",
        ),
        (plain, runs / "inner-export" / "lattice.vts", "it has 125 points, and the lattice 4 x 3 x 3 of the run 36"),
        ([*plain, "representation.turn=null"], made / "lattice.xyz", "away from those of an undeformed box"),
        (
            [*symmetric, "representation.lattice=[4,3,3]"],
            runs / "surface-export" / "lattice.xyz",
            "away from the symmetry",
        ),
    ):
        place = ["method=given", f"method.centers={file}", f"hydra.run.dir={tmp_path / 'refused'}"]
        assert main([*mesh_keys(template), *keys, *place]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert line in err


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_displace_as_apply_does(kind: str, runs: Path, tmp_path: Path) -> None:
    """What rbfevo.openmdao stands on, from the run and from its export alike; transposed, too."""
    record, row, _ = best(runs, kind)
    exported, _ = read_export(runs / f"{kind}-export" / "setup.npz")
    P = rows(runs / f"{kind}-export" / "displacements.csv")[:, 4:7]
    for one in (setup(record, row), setup(exported, 0)):
        parameters = Parameters(one, 3)
        displacement = Displacement(parameters, record.vertices)
        found = displacement(parameters.flat(P))
        np.testing.assert_allclose(found, applied(runs, kind, "weights", tmp_path / f"{one.row}.vtp"), atol=1e-9)
        (tmp_path / f"{one.row}.vtp").unlink()
        forces = np.random.default_rng(0).normal(size=found.shape)
        pulled = displacement.transposed(forces)
        direction = np.random.default_rng(1).normal(size=len(parameters))
        assert float(pulled @ direction) == pytest.approx(float((forces * displacement(direction)).sum()), rel=1e-9)


def test_what_depends_on_each_other_and_what_reaches_less_is_told(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--pick", "best-improvement-potential", "--out"]
    keys = ["scenario=plane", "scenario.resolution=[12,12]", "representation=ffd", "representation.lattice=[6,6]"]
    keys += ["representation.degree=2", "figures=false", "quiet=true", f"hydra.run.dir={tmp_path / 'run'}"]
    assert main([*keys, *RANDOM]) == 0
    record = read(tmp_path / "run")
    rows = [setup(record, row).columns(record.vertices) for row in range(len(record.regularity))]
    sigmas = [np.linalg.svd(U, compute_uv=False) for U in rows]
    ranks = [int((sigma > 144 * EPS * sigma[0]).sum()) for sigma in sigmas]
    idle = [int((U == 0.0).all(axis=0).sum()) for U in rows]
    assert max(ranks) == 36
    for row in (int(np.argmin(ranks)), int(np.argmax(ranks))):
        assert export.main([str(tmp_path / "run"), "--pick", f"index:{row}", "--out", str(tmp_path / f"{row}")]) == 0
        out = capsys.readouterr().out
        assert (f"rank {ranks[row]} of 36 columns, so that R = 0" in out) == (ranks[row] < 36)
        assert (f"{idle[row]} control points move no vertex" in out) == (idle[row] > 0)
        assert "left out: lattice.xyz: it is for boxes in space" in out
        assert record.genotype is not None
        inside: Any = (np.abs(record.vertices - record.genotype[row, :2]) <= record.genotype[row, 2:]).all(axis=1)
        torn = sum(0 < inside[face].sum() < 3 for face in record.faces)
        assert torn > 0 or row != int(np.argmin(ranks))
        assert (f"where displacements end abruptly, in {torn} triangles" in out) == (torn > 0)
    assert min(ranks) < 36
    assert max(idle) > 0
    assert export.main([str(runs / "surface"), *arguments, str(tmp_path / "b")]) == 0
    out = capsys.readouterr().out
    assert "direct manipulation: 9 points on the surface move, and P and V are theirs, not those of the 36" in out
