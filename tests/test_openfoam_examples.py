"""The examples of OpenFOAM, where it is installed: from the mesh to an objective that falls by what was predicted."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import called
import numpy as np
import pytest
from pages import blocks, carried_out

from rbfevo.arrays import Ints
from rbfevo.meshes.mesh import Mesh
from rbfevo.meshes.openfoam import case_of, read_case
from rbfevo.scenarios import mesh

ROOT = Path(__file__).parents[1]
TOOLS = ("blockMesh", "snappyHexMesh", "checkMesh", "adjointOptimisationFoam")
MISSING = [tool for tool in TOOLS if shutil.which(tool) is None]
EXAMPLES = ROOT / "examples" / "openfoam"
SHORT = ("figures=false", "method.starts=16", "method.population=16", "method.generations=5", "method.polish=3")
SHORT += ("method.front=8",)
needs_openfoam = pytest.mark.skipif(bool(MISSING), reason=f"OpenFOAM is not installed: {', '.join(MISSING)} missing")


class Case(NamedTuple):
    """An example and the options of its short run: the scale of its mesh and the size of its step."""

    name: str
    patch: str
    scale: float
    step: float


class Done(NamedTuple):
    """What a run of an example leaves."""

    case: Case
    out: Path
    printed: str
    step: str


DUCT, BODY = Case("duct", "bend", 0.6, 0.0025), Case("body", "body", 0.8, 0.01)


def run(out: Path, case: Case, *arguments: str) -> Done:
    """A run of an example as a user starts it."""
    command = [sys.executable, f"examples/openfoam/{case.name}.py", str(out), *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    return ended(out, case, done)


def run_here(out: Path, case: Case, *arguments: str) -> Done:
    """A run of an example in this process, where the commands of rbfevo are carried out as well."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("WM_PROJECT_DIR", raising=False)  # which the example sets
        patch.syspath_prepend(str(EXAMPLES))
        steps: Any = importlib.import_module("steps")
        started = steps._run

        def here(words: list[str]) -> str:
            if words[:2] != [sys.executable, "-m"]:
                return started(words)
            done = called.command(*words[2:])
            assert done.returncode == 0, done.stderr
            print(done.stdout, end="")
            return done.stdout

        patch.setattr(steps, "_run", here)
        return ended(out, case, called.script(EXAMPLES / f"{case.name}.py", str(out), *arguments))


def ended(out: Path, case: Case, done: Any) -> Done:
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    (directory,) = [path.name for path in out.iterdir() if path.name.startswith("step-")]
    return Done(case, out, done.stdout, directory)


def short_run(case: Case, out: Path) -> Done:
    """A run on a coarser mesh, with a short search."""
    done = run_here(out, case, *SHORT, "--scale", str(case.scale), "--step", str(case.step))
    assert done.step == f"step-{case.step:g}"
    return done


@pytest.fixture(scope="module")
def duct(tmp_path_factory: pytest.TempPathFactory) -> Done:
    return short_run(DUCT, tmp_path_factory.mktemp("duct") / "out")


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> Done:
    return short_run(BODY, tmp_path_factory.mktemp("body") / "out")


@pytest.fixture(params=["duct", "body"])
def done(request: pytest.FixtureRequest) -> Done:
    """A short run of each example."""
    return request.getfixturevalue(request.param)


def mesh_of(path: Path) -> Mesh:
    case = case_of(path)
    assert case is not None
    return read_case(case)


def points_of(mesh: Mesh, patch: str) -> Ints:
    ends = np.cumsum(mesh.cells.sizes)
    spans = [slice(ends[face] - mesh.cells.sizes[face], ends[face]) for face in mesh.patches[patch]]
    return np.unique(np.concatenate([mesh.cells.corners[span] for span in spans]))


class Row(NamedTuple):
    """J before and after the step, and its predicted and real change, as the example prints them."""

    before: float
    after: float
    predicted: float
    real: float


def row_of(done: Done) -> Row:
    row = done.printed.split("|---|")[-1].splitlines()[1]
    return Row(*(float(number) for number in re.findall(r"[-+]?\d+\.\d{5}", row)[:4]))


def solved(done: Done, part: str) -> float:
    """J as the solver's own file has it."""
    name = {"duct": "losseslosses", "body": "dragdrag"}[done.case.name]
    written = (done.out / part / "optimisation" / "objective" / "0" / name).read_text().splitlines()[-1]
    return float(written.split()[1])


def check_mesh(done: Done, part: str) -> str:
    return (done.out / part / "log.checkMesh").read_text()


def moved_patches(done: Done) -> list[str]:
    """The patches beside the design and the symmetry plane of which a coordinate has changed, even in its last bit."""
    before, after = mesh_of(done.out / "case"), mesh_of(done.out / done.step / "0")
    others = set(before.patches) - {done.case.patch, "symmetry"}
    own = {patch: points_of(before, patch) for patch in sorted(others)}
    bits = before.points.view(np.int64), after.points.view(np.int64)
    return [patch for patch, points in own.items() if not np.array_equal(bits[0][points], bits[1][points])]


@needs_openfoam
def test_the_objective_falls_as_predicted_on_a_mesh_that_passes(done: Done) -> None:
    """By the table that the example prints, and by checkMesh's and the solver's own files."""
    row = row_of(done)
    assert (solved(done, "case"), solved(done, done.step)) == pytest.approx((row.before, row.after), abs=1e-5)
    assert "Mesh OK." in check_mesh(done, "case")
    assert "Mesh OK." in check_mesh(done, done.step)
    assert "Time = 0" in check_mesh(done, done.step)  # the mesh of the time was checked
    assert row.after < row.before
    assert row.real == pytest.approx(row.after - row.before, abs=2e-5)
    assert abs(row.real - row.predicted) < abs(row.predicted) / 3


@needs_openfoam
def test_only_the_patch_of_the_design_moves(done: Done) -> None:
    assert moved_patches(done) == []
    before, after = mesh_of(done.out / "case"), mesh_of(done.out / done.step / "0")
    plane, design = points_of(before, "symmetry"), points_of(before, done.case.patch)
    np.testing.assert_array_equal(after.points[plane, 1], before.points[plane, 1])
    moved = np.linalg.norm(after.points - before.points, axis=1)
    diagonal = np.linalg.norm(np.ptp(before.points[design], axis=0))
    share = float(done.step.removeprefix("step-"))
    assert moved[design].max() == pytest.approx(share * diagonal, rel=1e-3)
    assert moved.max() <= moved[design].max() * (1 + 1e-9)


@needs_openfoam
def test_a_scalar_sensitivity_needs_no_keys_and_points_as_the_vector_does(done: Done) -> None:
    case = done.out / "case"
    names = [name for name in mesh_of(case).arrays if name.startswith("pointSensNormal")]
    (vector,) = [name for name in names if name.startswith("pointSensNormalVec")]
    (scalar,) = set(names) - {vector}
    ours, theirs = (
        mesh(str(case), patches=[done.case.patch], sensitivity=name).gradient.numpy() for name in (scalar, vector)
    )
    assert (ours * theirs).sum() / np.linalg.norm(ours) / np.linalg.norm(theirs) > 0.9


@needs_openfoam
def test_every_step_is_printed_as_the_command_that_it_runs(done: Done) -> None:
    commands = [line[2:] for line in done.printed.splitlines() if line.startswith("$ ")]
    programs = [line.split()[2] if line.startswith("python") else line.split()[0] for line in commands]
    made = ["blockMesh"] if done.case == DUCT else ["blockMesh", "snappyHexMesh"]
    assert [name for name in programs if name not in ("export", "cp", "mkdir")] == [
        *(*made, "checkMesh", "adjointOptimisationFoam", "rbfevo", "rbfevo.export", "rbfevo.apply"),
        *("checkMesh", "adjointOptimisationFoam"),
    ]


@needs_openfoam
def test_the_shell_loop_of_the_page_is_an_optimization(duct: Done, tmp_path: Path) -> None:
    """Of docs/step.md: it goes on from the short run, and ends sooner."""
    example, block = blocks("step.md")[0].split("\n", 1)
    assert example == "python examples/openfoam/duct.py outputs/duct"
    assert "--tolerance 0.02" in block
    (tmp_path / "outputs").mkdir()
    (tmp_path / "outputs" / "duct").symlink_to(duct.out)
    printed = carried_out(block.replace("--tolerance 0.02", "--tolerance 0.08"), tmp_path)
    lines = json.loads((tmp_path / "outputs" / "loop-state" / "state.json").read_text())["lines"]
    assert len(lines) >= 4
    J = [line["objective"] for line in lines]
    assert (np.diff(J) < 0).all()
    assert J[-1] < 0.85 * J[0]
    for line in lines[1:]:
        assert 0.6 < line["real"] / line["predicted"] < 1.1
    assert "is below 0.08 of the objective" in printed
    checked = subprocess.run(
        ["checkMesh", "-latestTime", "-case", str(tmp_path / "outputs" / "loop")], capture_output=True, text=True,
        env=os.environ | {"WM_PROJECT_DIR": os.environ.get("WM_PROJECT_DIR", "/usr/share/openfoam")}, check=False,
    )  # fmt: skip
    assert "Mesh OK." in checked.stdout


@needs_openfoam
@pytest.mark.slow
@pytest.mark.parametrize("case", [DUCT, BODY], ids=lambda case: case.name)
def test_the_whole_example(case: Case, tmp_path: Path) -> None:
    whole = run(tmp_path / "out", case)
    row = row_of(whole)
    assert solved(whole, whole.step) == pytest.approx(row.after, abs=1e-5)
    assert row.after < row.before
    assert abs(row.real - row.predicted) < abs(row.predicted) / 3
    assert "Mesh OK." in check_mesh(whole, whole.step)
    assert moved_patches(whole) == []


@pytest.mark.parametrize("name", ["duct", "body"])
def test_without_openfoam_one_line_says_what_is_missing(name: str, tmp_path: Path) -> None:
    command = [sys.executable, f"examples/openfoam/{name}.py", str(tmp_path / "out")]
    environment = os.environ | {"PATH": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"{name}.py: OpenFOAM's blockMesh, ")
    assert "apt-get install openfoam" in line
    assert list(tmp_path.iterdir()) == []


@needs_openfoam
def test_a_directory_that_is_there_is_not_touched(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.write_text("mine")
    command = [sys.executable, "examples/openfoam/duct.py", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert list(tmp_path.iterdir()) == [kept]
