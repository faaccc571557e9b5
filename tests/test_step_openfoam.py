"""`rbfevo.step --case`: on a case that is written here, with a solver of a few lines; and a loop of the page."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foam_cases import box, write_dictionary, write_mesh, write_points_field
from pages import blocks, carried_out

from rbfevo import meshes, step
from rbfevo.__main__ import main
from rbfevo.meshes.openfoam import Case, case_of, objective_of, read_case

PICK = ["--pick", "best-improvement-potential"]
MANAGERS = """
adjointManagers
{
    adjoint
    {
        adjointSolvers
        {
            losses { type incompressible; objectives { objectiveNames { one { weight 2; } two { weight 0.5; } } } }
            other  { type incompressible; objectives { objectiveNames { three { type force; } } } }
        }
    }
}
"""
FIELD = "pointSensVeclossesESI"


def solve(case: Path, time: str, start: str) -> float:
    """J = 2 A + B / 2 of the lid's points: A = sum |x - t|^2 / 2 and B = 3. The sensitivities go to a time."""
    mesh = read_case(found_in(case))
    lid = np.unique(np.concatenate([mesh.cells.corners[span] for span in spans(mesh)]))
    target = box().points + 0.05 * np.sin(3 * box().points[:, [1, 2, 0]]) * [1, 0, 1]
    s = np.zeros(mesh.points.shape)
    s[lid] = 2.0 * (mesh.points - target)[lid]
    one = float(((mesh.points - target)[lid] ** 2).sum()) / 2.0
    write_points_field(case, time, FIELD, s)
    where = case / "optimisation" / "objective" / start
    where.mkdir(parents=True, exist_ok=True)
    (where / "onelosses").write_text(f"# a header of words\n  1   9.9   0.0\n  2   {one!r}   1.0 0.5\n")
    (where / "twolosses").write_text("  2   3.0\n")
    (where / "oneInstantlosses").write_text("1\t77\n")
    return 2.0 * one + 1.5


def found_in(case: Path) -> Case:
    found = case_of(case)
    assert found is not None
    return found


def spans(mesh: Any) -> list[slice]:
    ends = np.cumsum(mesh.cells.sizes)
    return [slice(ends[face] - mesh.cells.sizes[face], ends[face]) for face in mesh.patches["lid"]]


@pytest.fixture
def loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[str]]:
    """A solved case, and the arguments of a step on it."""
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])
    case = tmp_path / "case"
    write_mesh(case, box())
    write_dictionary(case, area="includeSurfaceArea true;")
    with (case / "system" / "optimisationDict").open("a") as file:
        file.write(MANAGERS)
    solve(case, "10", "0")
    base = ["scenario=mesh", f"scenario.template={case}", "scenario.patches=[lid]", "kernel.support=1.5", "quiet=true"]
    assert main([*base, "method=lloyd", "centers=5", "figures=false", f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    return case, [str(tmp_path / "run"), *PICK, "--case", str(case), "--state", str(tmp_path / "state")]


def test_the_objective_is_the_weighted_sum_of_the_newest_start(loop: tuple[Path, list[str]]) -> None:
    case = loop[0]
    found = case_of(case)
    assert found is not None
    value = float((case / "optimisation/objective/0/onelosses").read_text().split()[-3])
    assert objective_of(found, "losses") == pytest.approx(2.0 * value + 1.5, rel=1e-14)
    assert objective_of(found, "other") is None  # it has no file
    assert objective_of(found, "nobody") is None
    newer = case / "optimisation" / "objective" / "10"
    newer.mkdir()
    assert objective_of(found, "losses") is None  # the newest start has not written
    (newer / "onelosses").write_text("1 4.0\n")
    (newer / "twolosses").write_text("1 nan\n")
    assert objective_of(found, "losses") is None
    (newer / "twolosses").write_text("1 2.0\n")
    assert objective_of(found, "losses") == 9.0
    (case / "system" / "optimisationDict").unlink()
    assert objective_of(found, "losses") is None


def test_a_loop_in_one_case_falls_and_keeps_the_rest(loop: tuple[Path, list[str]], capsys: Any) -> None:
    case, arguments = loop
    before, found = meshes_of(case, "constant"), []
    for number in range(4):
        assert step.main([*arguments, "--step", "0.002"]) == 0
        time, start = str(20 + 10 * number), str(10 + 10 * number)
        printed = capsys.readouterr().out
        assert f"written: {case / start}" in printed
        after = meshes_of(case, start)
        lid = np.unique(np.concatenate([before.cells.corners[span] for span in spans(before)]))
        moved = np.linalg.norm(after.points - before.points, axis=1)
        ends = np.cumsum(before.cells.sizes)
        for patch in ("inlet", "outlet", "bottom", "far"):
            held = np.unique(
                np.concatenate([before.cells.corners[ends[f] - before.cells.sizes[f] : ends[f]]
                                for f in before.patches[patch]])
            )  # fmt: skip
            assert not moved[np.setdiff1d(held, lid)].any()
        assert moved[lid].max() > 0
        (case / time).mkdir()
        found.append(solve(case, time, start))
    assert (np.diff(found) < 0).all()
    state = json.loads((Path(arguments[-1]) / "state.json").read_text())
    assert [line["objective"] for line in state["lines"][1:]] == pytest.approx(found[:3], rel=1e-13)
    for line in state["lines"][1:]:
        assert 0.7 < line["real"] / line["predicted"] < 1.0
    assert np.array_equal(meshes_of(case, "constant").points, before.points)


def meshes_of(case: Path, part: str) -> Any:
    with meshes.opened(case / part) as mesh:
        return mesh


def test_a_solver_that_did_nothing_and_another_mesh_are_told(loop: tuple[Path, list[str]], capsys: Any) -> None:
    case, arguments = loop
    assert step.main(arguments) == 0
    written = (case / "10/polyMesh/points").read_bytes()
    capsys.readouterr()
    (case / "10/polyMesh/points").unlink()
    assert step.main(arguments) == 0
    assert "there is no new solution: design 1 still waits for its own" in capsys.readouterr().out
    assert (case / "10/polyMesh/points").read_bytes() == written
    assert step.main(arguments) == 2
    assert "there is no new solution" in capsys.readouterr().err
    (case / "10/polyMesh/points").rename(case / "moved-away")
    (case / "20").mkdir()
    solve(case, "20", "10")  # on the original mesh
    assert step.main(arguments) == 2
    error = capsys.readouterr().err
    state = json.loads((Path(arguments[-1]) / "state.json").read_text())
    far = state["proposal"]["moved"]
    assert f"a vertex is {far:.3g} away from where it should be" in error
    assert f"the last step moved one by {far:.3g}" in error
    (case / "moved-away").rename(case / "10/polyMesh/points")
    solve(case, "20", "10")
    assert step.main(arguments) == 0


def test_the_next_case_can_be_another_one(loop: tuple[Path, list[str]], tmp_path: Path, capsys: Any) -> None:
    case, arguments = loop
    new = tmp_path / "new"
    for part in ("constant", "system"):
        shutil.copytree(case / part, new / part)
    assert step.main([*arguments, "--out", str(new / "0")]) == 0
    assert not (case / "10" / "polyMesh").exists()
    (new / "1").mkdir()
    solve(new, "1", "0")
    arguments[arguments.index("--case") + 1] = str(new)
    newer = tmp_path / "newer"
    shutil.copytree(new / "constant", newer / "constant")
    assert step.main([*arguments, "--out", str(newer / "0")]) == 0
    assert "change by the last step" in capsys.readouterr().out
    assert (newer / "0" / "polyMesh" / "points").exists()
    mine = ["--case", str(tmp_path / "run")]
    assert step.main([*arguments, *mine]) == 2
    assert capsys.readouterr().err.count("\n") == 1


# --- the page --------------------------------------------------------------------------------------------------------

SHORT = ("figures=false", "method.starts=16", "method.population=16", "method.generations=5")


@pytest.mark.slow
def test_the_loop_around_the_bracket_is_an_optimization(tmp_path: Path) -> None:
    """On a coarser mesh, with a short search, and ended sooner."""
    pytest.importorskip("skfem", reason="scikit-fem is not installed (extra elastic)")
    block = blocks("step.md")[1].replace("solve.py outputs/bracket", "solve.py --cells 12 3 2 outputs/bracket")
    search = f"evaluator=eager method.polish=3 {' '.join(SHORT)}"
    whole = "method.starts=32 method.population=24 method.generations=40"
    assert whole in block
    block = block.replace(whole, search).replace("--step 0.04", "--step 0.04 --tolerance 0.02")
    carried_out(block, tmp_path)
    lines = json.loads((tmp_path / "outputs" / "bracket" / "state" / "state.json").read_text())["lines"]
    kept = [line["objective"] for line in lines if line["kept"]]
    assert len(kept) >= 3
    assert (np.diff(kept) < 0).all()
    assert kept[-1] < 0.95 * kept[0]
    assert 0.5 < lines[1]["real"] / lines[1]["predicted"] < 1.05
