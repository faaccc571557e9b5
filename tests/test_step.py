"""`python -m rbfevo.step` with solvers of a few lines: known minima, signs, wrong turns, and loops that are killed."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
import trimesh
from called import command
from slabs import lifted, ring, saved, strip

from rbfevo import apply, step
from rbfevo.__main__ import main
from rbfevo.arrays import Array
from rbfevo.commands import stepping
from rbfevo.descent import files
from rbfevo.descent.sensitivity import NO_SEGMENTS, looking_at
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup
from rbfevo.scenarios.sensitivities import Choices, _convention, convention_in

PICK = ["--pick", "best-improvement-potential"]
LLOYD = ["method=lloyd", "centers=6", "figures=false", "quiet=true", "kernel.support=1.6", "manipulation=direct"]


def points_of(path: Path) -> Array:
    return np.array([line.split()[1:4] for line in path.read_text().splitlines() if line[:2] == "v "], np.float64)


def egg() -> Any:
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.apply_transform(np.diag([2.0, 1.0, 0.8, 1.0]))
    return ball


def volume(points: Array) -> tuple[float, Array]:
    """The volume of the egg, and its derivative [n, 3] by the vertices."""
    a, b, c = points[np.array(egg().faces).T]
    slope = np.zeros(points.shape)
    for corner, cross in zip(np.array(egg().faces).T, (np.cross(b, c), np.cross(c, a), np.cross(a, b)), strict=True):
        np.add.at(slope, corner, cross / 6.0)
    return float((a * np.cross(b, c)).sum() / 6.0), slope


class Loop:
    """A run on an egg, and a solver beside it: points [n, 3] of a design -> J and dJ/dx."""

    def __init__(self, path: Path, solve: Callable[[Array], tuple[float, Array]], *keys: str) -> None:
        path.mkdir(parents=True, exist_ok=True)
        self.path, self.solve = path, solve
        self.template, self.run, self.out = path / "egg.obj", path / "run", path / "next.obj"
        self.state = path / "state"
        vertices, corners = np.array(egg().vertices).tolist(), (np.array(egg().faces) + 1).tolist()
        text = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in corners]
        self.template.write_text("\n".join(text) + "\n")
        self.start, s = solve(points_of(self.template))
        np.save(path / "s.npy", s)
        given = [] if any(key.startswith("scenario.sensitivity=") for key in keys) else [
            f"scenario.sensitivity={path / 's.npy'}"
        ]  # fmt: skip
        base = ["scenario=mesh", f"scenario.template={self.template}", f"hydra.run.dir={self.run}"]
        assert main([*base, *LLOYD, *given, *keys]) == 0

    def step(self, *more: str, state: Path | None = None) -> int:
        where = ["--state", str(state or self.state), "--out", str(self.out)]
        return step.main([str(self.run), *PICK, *where, *more])

    def solved(self, points: Array | None = None) -> list[str]:
        """Solve the design that was written; the options that hand over the solution."""
        points = points_of(self.out) if points is None else points
        J, s = self.solve(points)
        np.savez(self.path / "solution.npz", points=points, sensitivity=s)
        (self.path / "J.txt").write_text(f"J at last\n{J!r}\n")
        return ["--sensitivity", str(self.path / "solution.npz"), "--objective", str(self.path / "J.txt")]

    def entries(self, state: Path | None = None) -> dict[str, Any]:
        return json.loads(((state or self.state) / "state.json").read_text())


def toward(points: Array) -> tuple[float, Array]:
    """J with its least value, 3, where each point is at a target."""
    start = np.array(egg().vertices)
    target = start + 0.05 * np.stack([np.sin(start[:, 1]), start[:, 0] * start[:, 2], np.cos(start[:, 0])], axis=1)
    return 3.0 + float(((points - target) ** 2).sum()) / 2.0, points - target


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Loop:
    return Loop(tmp_path_factory.mktemp("loop"), toward)


@pytest.fixture
def loop(made: Loop, tmp_path: Path) -> Loop:
    """The loop with a state of its own."""
    fresh = object.__new__(Loop)
    fresh.__dict__.update(made.__dict__)
    fresh.path, fresh.state, fresh.out = tmp_path, tmp_path / "state", tmp_path / "next.obj"
    return fresh


def lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().out.splitlines()


def mistake(capsys: pytest.CaptureFixture[str]) -> str:
    found = capsys.readouterr()
    assert len(found.err.splitlines()) == 1, found
    return found.err


# --- the loop --------------------------------------------------------------------------------------------------------


def test_the_first_step_is_that_of_export_and_its_mesh_that_of_apply(loop: Loop, capsys: Any) -> None:
    assert loop.step("--objective", str(loop.start), "--step", "0.01") == 0
    printed = lines(capsys)
    moved = points_of(loop.out) - points_of(loop.template)
    diagonal = np.linalg.norm(np.ptp(points_of(loop.template), axis=0))
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(0.01 * diagonal, rel=1e-9)
    s = toward(points_of(loop.template))[1]
    (change,) = [line for line in printed if "predicted change" in line]
    assert float(change.split("predicted change ")[1].split()[0]) == pytest.approx((s * moved).sum(), rel=1e-3)
    assert printed[-1] == f"written: {loop.out}"
    again = loop.path / "again.obj"
    weights = ["--weights", str(loop.state / "weights.csv"), "--mesh", str(loop.template), "--out", str(again)]
    assert apply.main([str(loop.run), *PICK, *weights]) == 0
    assert np.array_equal(points_of(again), points_of(loop.out))


@pytest.mark.parametrize("rule", step.RULES)
def test_a_loop_goes_down_to_the_minimum_of_the_setup(rule: str, loop: Loop, capsys: Any) -> None:
    record = read(loop.run)
    chosen = setup(record, pick(record, PICK[1]))
    A = np.stack(
        [chosen.displacement(record.vertices, unit.reshape(-1, 3)).ravel() for unit in np.eye(3 * chosen.count)], axis=1
    )
    b = -toward(record.vertices)[1].ravel()
    least = 3.0 + 0.5 * float(((b - A @ np.linalg.lstsq(A, b, rcond=1e-13)[0]) ** 2).sum())
    solution, found = ["--objective", str(loop.start)], [loop.start]
    code = 0
    while code == 0 and len(found) < 25:
        code = loop.step(*solution, "--rule", rule)
        solution = loop.solved()
        found.append(toward(points_of(loop.out))[0])
    best = loop.entries()["best"]["objective"]
    assert best == pytest.approx(min(found), rel=1e-12)
    share = (best - least) / (loop.start - least)
    assert -1e-9 < share < {"quasi-newton": 1e-4, "steepest": 0.4}.get(rule, 0.02)
    if code == step.ENDED:
        assert toward(points_of(loop.out))[0] == pytest.approx(best, rel=1e-12)  # the best mesh is there
        capsys.readouterr()
        assert loop.step(*loop.solved()) == step.ENDED
        assert lines(capsys)[-1].startswith("the best design is ")
    assert rule != "quasi-newton" or code == step.ENDED


@pytest.mark.parametrize("objective", ["minimize", "maximize"])
@pytest.mark.parametrize("kind", ["nodal", "density"])
@pytest.mark.parametrize("normal", ["", "inward", "outward", "as_wound"])
def test_signs_and_kinds_are_those_of_the_run(objective: str, kind: str, normal: str, tmp_path: Path) -> None:
    """The volume falls or rises, and by what is predicted, however its derivative is written."""

    def written(points: Array) -> Array:
        surface = trimesh.Trimesh(points, egg().faces, process=False)
        areas = np.bincount(surface.faces.ravel(), np.repeat(surface.area_faces, 3), minlength=len(points)) / 3.0
        slope = volume(points)[1] / (areas[:, None] if kind == "density" else 1.0)
        if not normal:
            return slope
        n = surface.faces
        cross = np.zeros(points.shape)
        a, b, c = points[n.T]
        for corner in n.T:
            np.add.at(cross, corner, np.cross(b - a, c - a))
        along = (slope * cross / np.linalg.norm(cross, axis=1, keepdims=True)).sum(axis=1)
        return -along if normal == "inward" else along

    (tmp_path / "loop").mkdir()
    table, start = tmp_path / "s.npy", np.array(egg().vertices)
    np.save(table, written(start))
    keys = [f"scenario.sensitivity={table}", f"scenario.sensitivity_kind={kind}", f"scenario.objective={objective}"]
    keys += [f"scenario.sensitivity_normal={normal}"] if normal else []
    loop = Loop(tmp_path / "loop", volume, *keys)
    solution, found = ["--objective", repr(loop.start)], [loop.start]
    for _ in range(3):
        assert loop.step(*solution, "--step", "0.002") == 0
        points = points_of(loop.out)
        found.append(volume(points)[0])
        np.savez(tmp_path / "solution.npz", points=points, sensitivity=written(points))
        solution = ["--sensitivity", str(tmp_path / "solution.npz"), "--objective", repr(found[-1])]
    assert loop.step(*solution) == 0
    sign = -1.0 if objective == "minimize" else 1.0
    assert (sign * np.diff(found) > 0).all()
    for line in loop.entries()["lines"][1:]:
        assert line["kept"]
        assert line["real"] == pytest.approx(line["predicted"], rel=0.06)


def test_conventions_are_read_back_from_the_note_of_a_run() -> None:
    for kind in ("nodal", "density"):
        for normal in (None, "outward", "inward", "as_wound"):
            for objective in ("minimize", "maximize"):
                choices = Choices(kind, normal, "exact", objective)
                assert convention_in(_convention("s.csv", np.zeros(3), kind, choices)) == (kind, normal)
                assert convention_in(_convention("s", np.zeros((3, 3)), kind, choices)) == (kind, None)


# --- wrong turns -----------------------------------------------------------------------------------------------------


def test_a_call_without_a_new_solution_steps_once(loop: Loop, capsys: Any) -> None:
    assert loop.step("--objective", str(loop.start)) == 0
    solution = loop.solved()
    assert loop.step(*solution) == 0
    before, points = loop.entries(), points_of(loop.out)
    loop.out.unlink()
    capsys.readouterr()
    assert loop.step(*solution) == 0
    assert lines(capsys) == [f"there is no new solution: design 2 still waits for its own; its mesh is in {loop.out}"]
    assert np.array_equal(points_of(loop.out), points)  # written again, for a loop that was killed
    after = loop.entries()
    assert {**after, "waited": 0} == {**before, "waited": 0}
    assert loop.step(*solution) == 2
    assert "design 2 still waits for its own: give --sensitivity and --objective" in mistake(capsys)
    assert loop.step(*loop.solved()) == 0  # the new one
    assert (loop.entries()["waited"], loop.entries()["proposal"]["number"]) == (0, 3)
    assert loop.step("--objective", "1") == 0  # the run's own sensitivity is that of design 0
    assert "design 3 still waits" in lines(capsys)[-1]


def test_a_rise_and_a_failure_go_back(loop: Loop, capsys: Any) -> None:
    assert loop.step("--objective", str(loop.start)) == 0
    first, start = points_of(loop.out), points_of(loop.template)
    _ = loop.solved()
    capsys.readouterr()
    assert loop.step("--sensitivity", str(loop.path / "solution.npz"), "--objective", str(loop.start + 1)) == 0
    printed = "\n".join(lines(capsys))
    assert "real +1" in printed
    assert "back to design 0, with half the step" in printed
    np.testing.assert_allclose(points_of(loop.out) - start, (first - start) / 2.0, atol=1e-13)
    assert loop.step("--failed", *loop.solved()) == 0  # a loop gives these all the time
    assert "design 2: the solver failed; back to design 0, with half the step" in "\n".join(lines(capsys))
    np.testing.assert_allclose(points_of(loop.out) - start, (first - start) / 4.0, atol=1e-13)
    for _ in range(3):
        assert loop.step("--failed") == 0
    assert loop.step("--failed") == step.ENDED
    assert "the step was halved 6 times" in "\n".join(lines(capsys))
    np.testing.assert_allclose(points_of(loop.out), start, atol=1e-15)
    kept = [(line["number"], line["kept"], line["note"]) for line in loop.entries()["lines"][:3]]
    assert kept == [
        (0, True, ""),
        (1, False, "the objective did not get better"),
        (2, False, "the solver failed"),
    ]


def test_the_solution_of_another_design_is_refused_with_the_distance(loop: Loop, capsys: Any) -> None:
    assert loop.step("--objective", str(loop.start)) == 0
    solution = loop.solved(points_of(loop.template))
    far = np.linalg.norm(points_of(loop.out) - points_of(loop.template), axis=1).max()
    before = loop.entries()
    assert loop.step(*solution) == 2
    error = mistake(capsys)
    assert "vertices have no row within" in error or "largest distance" in error
    assert loop.entries() == before
    shifted = points_of(loop.out) + np.array([0.5 * far, 0.0, 0.0])
    assert loop.step(*loop.solved(shifted)) == 2
    assert f"the largest distance is {0.5 * far:.3g}" in mistake(capsys)


def test_the_run_of_a_state_stays_the_same(loop: Loop, capsys: Any) -> None:
    assert loop.step("--objective", "1", "--rule", "natural") == 0
    for more, line in (
        (["--rule", "steepest"], "--rule steepest: this descent began with natural"),
        (["--step", "0.02"], "--step 0.02: this descent began with 0.01"),
        (["--tolerance", "0.5"], "--tolerance 0.5: this descent began with 1e-05"),
    ):
        assert loop.step(*loop.solved(), *more) == 2
        assert line in mistake(capsys)
    centers = np.load(loop.run / "setups.npz")["centers"]
    other = loop.path / "other"
    other.mkdir()
    for part in ("setups.npz", "scenario.npz", "summary.json"):
        (other / part).write_bytes((loop.run / part).read_bytes())
    (other / ".hydra").mkdir()
    (other / ".hydra" / "config.yaml").write_bytes((loop.run / ".hydra" / "config.yaml").read_bytes())
    with np.load(loop.run / "setups.npz") as archive:
        np.savez(other / "setups.npz", **{**archive, "centers": centers + 0.01})
    loop.run = other
    assert loop.step(*loop.solved()) == 2
    assert "it is of another run or pick" in mistake(capsys)


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (["--step", "2"], "--step 2: give a fraction"),
        (["--tolerance", "1"], "--tolerance 1: give a share"),
        (["--adapt", "-1"], "--adapt -1: give how many"),
        (["--failed"], "the original design has no solution"),
        (["--objective", "none.txt"], "--objective none.txt: give a number, or a file"),
        (["--objective", "nan"], "the objective of the original design is not finite"),
        (["--sensitivity", "none.csv"], "--sensitivity none.csv: no such file"),
        (["--design", "wing", "--objective", "1"], "--design is for --volume laplace"),
        (["--volume", "laplace", "--objective", "1"], "needs cells that fill a volume"),
        (["--mesh", "none.vtu", "--objective", "1"], "none.vtu: no such file"),
        (["--out", "nowhere/next.obj"], "the directory nowhere does not exist"),
    ],
)
def test_mistakes_get_one_line_and_leave_nothing(more: list[str], line: str, loop: Loop, capsys: Any) -> None:
    assert loop.step(*more) == 2
    assert line in mistake(capsys)
    assert files.read(loop.state) is None
    assert not loop.out.exists()


def test_a_sensitivity_of_zero_is_the_end_and_a_damaged_state_one_line(loop: Loop, capsys: Any) -> None:
    points = points_of(loop.template)
    np.savez(loop.path / "zero.npz", points=points, sensitivity=0.0 * points)
    zero = ["--sensitivity", str(loop.path / "zero.npz"), "--objective", "3", "--adapt"]
    assert loop.step(*zero) == step.ENDED
    assert "no step of this setup gains anything" in "\n".join(lines(capsys))
    entries = loop.entries()
    del entries["seen"]
    (loop.state / "state.json").write_text(json.dumps(entries))
    assert loop.step(*zero) == 2
    assert "state.json lacks seen: damaged?" in mistake(capsys)


def test_a_mesh_that_is_there_already_is_not_overwritten(loop: Loop, capsys: Any) -> None:
    loop.out.write_text("mine")
    assert loop.step("--objective", "1") == 2
    assert f"{loop.out} already exists, and not from this descent" in mistake(capsys)
    assert loop.out.read_text() == "mine"


def test_runs_that_it_cannot_take_are_refused(tmp_path: Path, capsys: Any) -> None:
    loop = Loop(tmp_path / "a", toward)
    target = ["scenario=mesh", f"scenario.template={loop.template}", f"scenario.target={loop.template}"]
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.export(tmp_path / "ball.ply")
    target[2] = f"scenario.target={tmp_path / 'ball.ply'}"
    assert main([*target, *LLOYD, f"hydra.run.dir={tmp_path / 'target'}"]) == 0
    loop.run = tmp_path / "target"
    assert loop.step() == 2
    assert "this run has no sensitivity" in mistake(capsys)
    np.save(tmp_path / "a" / "t.npy", np.random.default_rng(0).normal(size=points_of(loop.template).shape))
    both = f"scenario.sensitivity=[{tmp_path / 'a' / 's.npy'},{tmp_path / 'a' / 't.npy'}]"
    base = ["scenario=mesh", f"scenario.template={loop.template}", both, *LLOYD]
    assert main([*base, f"hydra.run.dir={tmp_path / 'several'}"]) == 0
    loop.run = tmp_path / "several"
    assert loop.step() == 2
    assert "this run has several objectives (s, t), and a descent follows one" in mistake(capsys)


# --- other designs ----------------------------------------------------------------------------------------------------


def outline_loop(path: Path, kind: str, *keys: str) -> Loop:
    """A run on a slab one cell thick or a curve about the same ellipse, smoothed, and with held and fixed vertices."""
    loop = object.__new__(Loop)
    path.mkdir()
    loop.path, loop.run, loop.state = path, path / "run", path / "state"
    loop.template, loop.out = path / "outline.vtp", path / "next.vtp"
    flat = ring(64)

    def solve(points: Array) -> tuple[float, Array]:
        start = np.concatenate([lifted(flat, 2, h) for h in heights])
        target = start * [1.03, 0.95, 1.0] + [0.0, 0.02, 0.0]
        mass = len(points) / 64
        return float(((points - target) ** 2).sum()) / (2.0 * mass), (points - target) / mass

    heights = (0.0, 0.1) if kind == "slab" else (0.0,)
    if kind == "slab":
        saved(strip(64), loop.template)
    else:
        around = np.append(np.arange(64), 0)
        pyvista.PolyData(lifted(flat, 2, 0.0), lines=[65, *around]).save(loop.template)
    loop.solve = solve
    loop.start, s = solve(np.asarray(pyvista.read(loop.template).points))
    np.save(path / "s.npy", s)
    base = ["scenario=mesh", f"scenario.template={loop.template}", f"scenario.sensitivity={path / 's.npy'}", *LLOYD]
    base += ["scenario.planar=z", "scenario.smooth=0.2", "scenario.fixed=[null,null,null,-1.7,null,null]", *keys]
    assert main([*base, f"hydra.run.dir={loop.run}"]) == 0
    return loop


@pytest.mark.parametrize("kind", ["slab", "curve"])
def test_planar_designs_look_at_their_sensitivity_as_the_run_did(kind: str, tmp_path: Path) -> None:
    loop = outline_loop(tmp_path / "loop", kind)
    record = read(loop.run)
    segments = np.stack([np.arange(64), np.roll(np.arange(64), -1)], axis=1) if kind == "curve" else NO_SEGMENTS
    points = np.asarray(pyvista.read(loop.template).points)
    found = looking_at(record, loop.solve(points)[1], segments)
    np.testing.assert_allclose(found.gradient, record.gradient, atol=1e-13)
    assert found.gradient_raw is not None
    assert record.gradient_raw is not None
    np.testing.assert_allclose(found.gradient_raw, record.gradient_raw, atol=1e-13)
    assert found.summary["gradient_norm"] == pytest.approx(record.summary["gradient_norm"], rel=1e-12)
    found = [loop.start]
    solution = ["--objective", repr(loop.start)]
    for _ in range(3):
        assert loop.step(*solution, "--step", "0.005") == 0
        moved = np.asarray(pyvista.read(loop.out).points)
        assert np.array_equal(moved[:, 2], points[:, 2])
        J, s = loop.solve(moved)
        np.savez(tmp_path / "solution.npz", points=moved, sensitivity=s)
        solution = ["--sensitivity", str(tmp_path / "solution.npz"), "--objective", repr(J)]
        found.append(J)
    assert (np.diff(found) < 0).all()


def test_a_volume_mesh_whose_cells_would_turn_is_written_with_a_shorter_step(loop: Loop, capsys: Any) -> None:
    """A thin shell of prisms about the egg, of which only some are thin."""
    inner, faces = np.array(egg().vertices), np.array(egg().faces)
    n, thin = len(inner), np.where(np.array(egg().vertices)[:, 0] > 1.0, 0.985, 0.5)
    points = np.concatenate([inner, inner * thin[:, None]])
    cells = np.hstack([np.full((len(faces), 1), 6), faces + n, faces])
    grid = pyvista.UnstructuredGrid(cells.ravel(), np.full(len(faces), 13), points)
    mesh, out = loop.path / "shell.vtu", loop.path / "moved.vtu"
    grid.save(mesh)
    where = ["--state", str(loop.state), "--mesh", str(mesh), "--out", str(out), "--objective", "9", "--volume"]
    for way in ("laplace", "rbf"):
        arguments = [str(loop.run), *PICK, *where, way, "--step", "0.2"]
        assert step.main(arguments) == 0
        printed = capsys.readouterr().out
        shorter = [line for line in printed.splitlines() if line.startswith("shorter step: ")]
        moved: Any = pyvista.read(out)
        volumes = moved.compute_cell_sizes()["Volume"]
        if way == "laplace":
            assert "inside out or flat" in shorter[0]
            assert loop.entries()["proposal"]["size"] == 0.2 / 2 ** len(shorter)
            assert (volumes * np.sign(volumes.sum()) > 0).all()
            own = np.linalg.norm(np.asarray(moved.points)[n:] - points[n:], axis=1)
            assert own.max() == 0.0  # the inner wall is held
            shutil.rmtree(loop.state)
            out.unlink()


# --- killed ----------------------------------------------------------------------------------------------------------


class KilledError(BaseException):
    """Stands for a signal."""


def killed_in(call: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Die at the n-th of all files that step writes, before it is written."""
    count = 0

    def guarded(function: Any) -> Any:
        def wrapped(*arguments: Any, **keys: Any) -> Any:
            nonlocal count
            count += 1
            if count == call:
                raise KilledError
            return function(*arguments, **keys)

        return wrapped

    monkeypatch.setattr(files, "write_whole", guarded(files.write_whole))
    monkeypatch.setattr(stepping, "write_whole", guarded(stepping.write_whole))
    monkeypatch.setattr(stepping.meshes, "write", guarded(stepping.meshes.write))


@pytest.mark.parametrize("rule", ["max-norm", "quasi-newton"])
def test_a_loop_that_is_killed_at_any_file_goes_on_to_the_same_bits(rule: str, loop: Loop, monkeypatch: Any) -> None:
    def unbroken(state: Path) -> list[bytes]:
        found = []
        solution = ["--objective", str(loop.start)]
        for _ in range(4):
            assert loop.step(*solution, "--rule", rule, "--step", "0.004", state=state) == 0
            found.append(points_of(loop.out).tobytes())
            solution = loop.solved()
        loop.out.unlink()
        return found

    expected = unbroken(loop.path / "unbroken")
    deaths = 0
    for call in range(1, 8):
        state = loop.path / f"killed-{call}"
        found, solution = [], ["--objective", str(loop.start)]
        for number in range(4):
            if number in (0, 2):
                with monkeypatch.context() as patch:
                    killed_in(call, patch)
                    try:
                        loop.step(*solution, "--rule", rule, "--step", "0.004", state=state)
                    except KilledError:
                        deaths += 1
            assert loop.step(*solution, "--rule", rule, "--step", "0.004", state=state) == 0
            found.append(points_of(loop.out).tobytes())
            solution = loop.solved()
        loop.out.unlink()
        assert found == expected, call
        assert [p.name for p in state.iterdir() if p.name.startswith(".") and p.name != ".lock"] == []
    assert deaths >= 7
    entries = [{**loop.entries(loop.path / name), "outs": [], "waited": 0} for name in ("unbroken", "killed-3")]
    for one in entries:
        one["seen"] = []  # digests of files of the solver
    assert entries[0] == entries[1]


# --- more centers ----------------------------------------------------------------------------------------------------


def test_adapt_adds_centers_that_keep_the_old_designs(tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    started, searches = subprocess.run, []

    def search(words: list[str], **keys: Any) -> Any:
        """The first search is a process, as it stands; the others run here."""
        searches.append(words)
        return started(words, **keys) if len(searches) == 1 else command(*words[2:])

    monkeypatch.setattr("rbfevo.commands.adapting.subprocess.run", search)
    loop = Loop(tmp_path / "a", toward, "centers=3", "kernel.support=1.4")
    solution = ["--objective", str(loop.start)]
    record = read(loop.run)
    chosen = setup(record, pick(record, PICK[1]))
    added, before, code = 0, None, 0
    for _ in range(14):
        previous = loop.entries()["best"] if loop.state.exists() else None
        code = loop.step(*solution, "--rule", "quasi-newton", "--adapt", "2")
        printed = lines(capsys)
        entries = loop.entries()
        if len(entries["adapted"]) > added and before is None:
            added, before = len(entries["adapted"]), previous
            assert any("2 centers were added" in line for line in printed)
            new = read(loop.state / "adapted-1")
            grown = setup(new, entries["adapted"][0]["row"])
            assert np.array_equal(grown.centers[:3], chosen.centers)
            assert grown.count == 5
            weights = np.array(entries["best"]["weights"])
            assert not weights[3:].any()
            difference = grown.displacement(new.vertices, weights) - chosen.displacement(record.vertices, weights[:3])
            assert np.abs(difference).max() < 1e-10 * np.abs(weights).max()
        if code:
            break
        solution = loop.solved()
    assert added
    assert all(words[:3] == [sys.executable, "-m", "rbfevo"] for words in searches)
    J = [line["objective"] for line in loop.entries()["lines"] if line["kept"]]
    assert (np.diff(J) < 0).all()
    # lower than the old centers can get, by least squares
    A = np.stack([chosen.displacement(record.vertices, u.reshape(-1, 3)).ravel() for u in np.eye(9)], axis=1)
    b = -toward(record.vertices)[1].ravel()
    least = 3.0 + 0.5 * float(((b - A @ np.linalg.lstsq(A, b, rcond=1e-13)[0]) ** 2).sum())
    assert min(J) < least - 1e-3
