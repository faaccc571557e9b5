"""Control points of a fine lattice that OLS picks, bounded potential, and held regions, beside plain NumPy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from test_ffd import EPS, KERNEL, SMALL, pygem, rescored
from test_ffd_manipulations import blocks, of_blocks, symmetric
from test_mesh_runs import egg

from rbfevo import export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.recorded.record import read
from rbfevo.scenarios import mesh, plane
from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.representations import ffd


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"), subdivisions=2)


def greedy(B: Any, g: Any, count: int) -> list[int]:
    """OLS by its definition: the column that raises P the most, one after the other."""
    chosen: list[int] = []
    for _ in range(count):
        gains = [rescored(B[:, [*chosen, j]], g)[1] if j not in chosen else -1.0 for j in range(B.shape[1])]
        chosen.append(int(np.argmax(np.round(gains, 9))))
    return chosen


def test_ols_picks_the_control_points_that_raise_p_the_most(tmp_path: Path) -> None:
    keys = ["representation.lattice=[6,7]", "representation.degree=2", "method=ols", "centers=9"]
    assert main([*SMALL, *keys, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    record = read(tmp_path / "run")
    assert record.genotype is not None
    genotype, picks = record.genotype[0, :4], record.genotype[0, 4:].astype(int)
    np.testing.assert_allclose(genotype, [0.5, 1.0, 0.5, 1.0], rtol=2e-6)
    scenario = plane((20, 20))
    whole = ffd(scenario, KERNEL, 0, [6, 7], degree=2).for_run(scenario, "indirect")
    B = whole.phi(record.vertices, genotype)
    assert B.sum(axis=1) == pytest.approx(np.ones(400))
    assert picks.tolist() == greedy(B, record.gradient, 9)
    np.testing.assert_allclose(record.centers[0], whole.handles(genotype)[picks], atol=1e-12)
    R, P = rescored(B[:, picks], record.gradient)
    assert record.regularity[0] == pytest.approx(R, rel=1e-6)
    assert record.improvement_potential[0] == pytest.approx(P, abs=1e-8)


def test_ols_makes_a_front_of_the_face_where_whole_lattices_have_none(tmp_path: Path) -> None:
    """On a sphere, x^2 + y^2 + z^2 - 1 makes the columns of a whole lattice dependent, and its R 0."""
    sphere = trimesh.creation.icosphere(3)
    x = np.array(sphere.vertices)
    np.save(tmp_path / "x.npy", x)
    np.save(tmp_path / "s.npy", np.stack([x[:, 2] ** 3, 0.0 * x[:, 0], x[:, 0] ** 2 * x[:, 1]], axis=1))
    (tmp_path / "s.off").write_text(
        "\n".join(
            ["OFF", f"{len(x)} {len(sphere.faces)} 0", *[" ".join(map(repr, row)) for row in x.tolist()]]
            + [f"3 {a} {b} {c}" for a, b, c in sphere.faces.tolist()]
        )
    )
    keys = ["scenario=mesh", f"scenario.template={tmp_path}/s.off", f"scenario.sensitivity={tmp_path}/s.npy"]
    keys += ["representation=ffd", "representation.lattice=[4,3,3]", "figures=false", "quiet=true"]
    assert main([*keys, "method=random", "method.population=5", f"hydra.run.dir={tmp_path / 'all'}"]) == 0
    assert main([*keys, "method=ols", "centers=12", f"hydra.run.dir={tmp_path / 'picks'}"]) == 0
    whole, picked = read(tmp_path / "all"), read(tmp_path / "picks")
    assert (whole.regularity == 0.0).all()
    assert (np.rint(whole.variability * len(x)) <= 34).all()  # pyright: ignore[reportOptionalOperand]
    (warning,) = [line for line in whole.summary["warnings"] if "rank" in line]
    assert warning.startswith("5 of 5 setups have R = 0: their 36 columns have the rank ")
    assert warning.endswith("method=ols may help")
    assert picked.regularity[0] > 1e-3
    assert picked.improvement_potential[0] > 0.5


def test_picks_of_a_symmetric_design_move_with_their_images(template: Path, tmp_path: Path) -> None:
    keys = ["representation.lattice=[4,6,3]", "method=ols", "centers=8", f"hydra.run.dir={tmp_path / 'run'}"]
    assert main([*symmetric(template)[:-1], *keys]) == 0
    record = read(tmp_path / "run")
    assert record.genotype is not None
    picks = record.genotype[0, 6:].astype(int)
    along, across = blocks(record.vertices, record.genotype[0, :6], (4, 6, 3))
    R, P = of_blocks((along[:, picks], across[:, picks]), record.gradient)
    assert record.regularity[0] == pytest.approx(R, rel=1e-6)
    assert record.improvement_potential[0] == pytest.approx(P, abs=1e-8)
    assert R > 0.0
    assert export.main([str(tmp_path / "run"), "--pick", "knee", "--out", str(tmp_path / "e"), "--quiet"]) == 0
    saved = np.load(tmp_path / "e" / "setup.npz")
    np.testing.assert_allclose(saved["U"], along[:, picks], atol=1e-13)
    np.testing.assert_allclose(saved["U_across"], across[:, picks], atol=1e-13)
    again = ["method=given", f"method.centers={tmp_path / 'e'}", f"hydra.run.dir={tmp_path / 'again'}", "centers=8"]
    assert main([*symmetric(template)[:-1], "representation.lattice=[4,6,3]", *again]) == 0
    assert record.genotype is not None
    np.testing.assert_array_equal(read(tmp_path / "again").genotype, record.genotype)


def test_random_picks_are_drawn_without_repetition(tmp_path: Path) -> None:
    keys = ["representation.lattice=[4,4]", "method=random", "method.population=7", "centers=15"]
    assert main([*SMALL, *keys, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    record = read(tmp_path / "run")
    assert record.genotype is not None
    for row in range(7):
        picks = record.genotype[row, 4:].astype(int)
        assert len(set(picks.tolist())) == 15
        c, h = record.genotype[row, :2], record.genotype[row, 2:4]
        R, P = rescored(pygem(record.vertices, c - h, 2.0 * h, (4, 4))[:, picks], record.gradient)
        assert record.regularity[row] == pytest.approx(R, rel=1e-6, abs=1e-12)
        assert record.improvement_potential[row] == pytest.approx(P, abs=1e-8)
    assert len({tuple(row) for row in record.genotype.tolist()}) > 1


def test_what_cannot_be_picked_is_refused_in_a_line(template: Path, tmp_path: Path, capsys: Any) -> None:
    plain, mirrored = [*SMALL, "representation.lattice=[4,4]"], symmetric(template)
    for keys, line in (
        (
            [*plain, "method=ols"],
            "method=ols picks some of the 16 control points that move: give their number as centers=",
        ),
        (
            [*plain, "method=ols", "centers=5", "manipulation=direct"],
            "method=ols picks control points, which manipulation=direct",
        ),
        ([*plain, "method=lloyd"], "method=lloyd places centers, and representation=ffd has none"),
        (
            [*plain, "method=cmaes", "centers=5"],
            "method=cmaes moves all of them; leave centers= out, or let method=ols pick 5",
        ),
        ([*plain, "method=ols", "centers=5", "criterion.norm=16"], "for criterion.norm=2 alone"),
        (
            [*plain, "method=random", "centers=5", "criterion.norm=16", "manipulation=direct"],
            "P_p is that of all columns",
        ),
        ([*mirrored, "method=ols", "centers=5"], "give the lattice 3 x 5 x 2 an even number along y"),
    ):
        assert main([*keys, f"hydra.run.dir={tmp_path / 'run'}"]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert line in err


def test_bounded_potential_of_symmetric_boxes_is_that_of_both_blocks(template: Path) -> None:
    scenario = mesh(str(template), sensitivity=str(template.parent / "s.npy"), symmetry="y", symmetry_at=0.0)
    made = ffd(scenario, KERNEL, 0, [3, 5, 2]).for_run(scenario, "indirect")
    space = made.space(scenario, 0)
    setups = space.place(space.sample(3, torch.Generator().manual_seed(2)))
    design = scenario.vertices, scenario.gradient, made
    two = BoundedPotential(*design, 2.0, scenario.weights, None, scenario.mirror)
    many = BoundedPotential(*design, 8.0, scenario.weights, None, scenario.mirror)
    for row, genotype in enumerate(setups.numpy()):
        P = of_blocks(blocks(scenario.vertices.numpy(), genotype), scenario.gradient.numpy())[1]
        assert float(two.values(setups, gap=0.0)[row]) == pytest.approx(P, abs=1e-6)
    values, gradients = many.values_and_gradients(setups)
    torch.testing.assert_close(values, many.definition(setups), rtol=1e-6, atol=1e-7)
    h = 1e-5
    for i in (0, 3, 4, 5):
        step = torch.zeros(6, dtype=torch.float64)
        step[i] = h
        above, below = (many.values(setups + sign * step, gap=0.0) for sign in (1.0, -1.0))
        torch.testing.assert_close(gradients[:, i], (above - below) / (2.0 * h), rtol=1e-3, atol=1e-5)


def test_a_run_for_bounded_potential(tmp_path: Path) -> None:
    keys = ["representation.lattice=[3,3]", "method=nsga2", "method.population=8", "method.generations=2"]
    assert main([*SMALL, *keys, "criterion.norm=8", f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    record = read(tmp_path / "run")
    assert record.bounded_potential is not None
    assert (record.bounded_potential <= 1.0).all()
    assert (record.bounded_potential > 0.1).any()


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_held_vertices_stay(manipulation: str, template: Path, tmp_path: Path) -> None:
    x = np.asarray(trimesh.load(template, process=False).vertices)  # pyright: ignore[reportAttributeAccessIssue]
    np.save(tmp_path / "held.npy", x[:, 0] > 1.2)
    keys = ["scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    keys += [f"scenario.hold={tmp_path / 'held.npy'}", "scenario.hold_width=0.5", "representation=ffd", "quiet=true"]
    keys += ["representation.lattice=[4,3,3]", "method=random", "method.population=6", "figures=false"]
    keys += [f"manipulation={manipulation}", *(["centers=8"] if manipulation == "direct" else [])]
    assert main([*keys, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    record = read(tmp_path / "run")
    assert any("keep_out" in line for line in record.summary["warnings"])
    assert record.blend is not None
    assert record.genotype is not None
    for row in range(6):
        c, h = record.genotype[row, :3], record.genotype[row, 3:]
        B = pygem(record.vertices, c - h, 2.0 * h, (4, 3, 3))
        if manipulation == "direct":
            assert (record.centers[row][:, 0] <= 1.2).all()
            S = pygem(record.centers[row], c - h, 2.0 * h, (4, 3, 3))
            B = B @ np.linalg.pinv(S, rcond=max(S.shape) * EPS)
        R, P = rescored(record.blend[:, None] * B, record.gradient)
        assert record.regularity[row] == pytest.approx(R, rel=1e-6, abs=1e-12)
        assert record.improvement_potential[row] == pytest.approx(P, abs=1e-8)
    out = tmp_path / "e"
    assert export.main([str(tmp_path / "run"), "--pick", "knee", "--out", str(out), "--quiet"]) == 0
    assert not (out / "su2.cfg").exists()
    assert (out / "lattice.xyz").exists()
    import pyvista as pv

    found: Any = pv.read(out / "template.vtp")
    assert np.abs(np.asarray(found.point_data["reached"])[x[:, 0] > 1.2]).max() == 0.0
    assert json.loads(str(np.load(out / "setup.npz")["representation_spec"]))["lattice"] == [4, 3, 3]


def test_a_fine_lattice_needs_vertices_for_its_columns() -> None:
    scenario = plane((4, 4))
    with pytest.raises(UserError, match="centers=30: the lattice 5 x 5 has 25 control points that move"):
        ffd(scenario, KERNEL, 30, [5, 5]).for_run(scenario, "indirect")
