"""The search behind the studio's page, the shapes that it shows, what it keeps, and what comes out of it."""

from __future__ import annotations

import dataclasses
import functools
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import painted
import pytest
import torch

from rbfevo.__main__ import main as rbfevo
from rbfevo.errors import UserError
from rbfevo.meshes import opened as opened_mesh
from rbfevo.methods.gradient import search as gradient
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup
from rbfevo.scenarios.mesh import mesh
from rbfevo.scoring.pareto import hypervolume, nondominated
from rbfevo.studio import keeping, saving
from rbfevo.studio.choices import KERNELS, LENGTHS, Choices
from rbfevo.studio.keeping import State
from rbfevo.studio.opening import opened
from rbfevo.studio.pulling import Chosen
from rbfevo.studio.searching import Front, Search, Task, write_mesh
from rbfevo.studio.shape import Pulls, Shape


@pytest.fixture(scope="module")
def short() -> Iterator[None]:
    """Searches of seconds: a few setups and generations."""
    patch = pytest.MonkeyPatch()
    before = gradient.GradientSearch.__init__

    @functools.wraps(before)
    def fewer(self: gradient.GradientSearch, **settings: Any) -> None:
        """With the smallest numbers that search at all."""
        before(self, **(settings | {"starts": 24, "population": 16, "generations": 12, "polish": 3}))

    patch.setattr(gradient.GradientSearch, "__init__", fewer)
    yield
    patch.undo()


def task(state: State, number: int = 1, **changed: Any) -> Task:
    return Task(number, state.field, state.held, state.choices, **changed)


@pytest.fixture(scope="module")
def searched(short: None, tmp_path_factory: pytest.TempPathFactory) -> tuple[State, list[Front], Search]:
    """A painted ellipsoid, symmetric, with a held end: all fronts of its search."""
    state = painted.state(Choices(centers=6, symmetry="y"))
    search = Search(state.vertices, state.triangles, tmp_path_factory.mktemp("studio") / "searched.vtp")
    first = search.take(task(state))
    fronts = [first, *search.improve(task(state))]
    state.centers = fronts[-1].record.centers
    return state, fronts, search


def test_a_front_is_scored_as_a_run_scores_it(searched: tuple[State, list[Front], Search]) -> None:
    state, fronts, _ = searched
    assert fronts[0].step == 0
    assert fronts[-1].settled
    assert not any(front.failed for front in fronts)
    record = fronts[-1].record
    objectives = torch.from_numpy(np.column_stack([record.regularity, record.improvement_potential]))
    assert bool(nondominated(objectives).all())
    assert (np.diff(record.regularity) > 0).all()
    assert fronts[-1].hypervolume == pytest.approx(hypervolume(objectives), rel=1e-12)
    assert fronts[-1].hypervolume > 1.05 * fronts[0].hypervolume
    assert fronts[-1].evaluations > 24 * 12 / 2
    for row in (0, len(record.centers) // 2):  # R and P of U by NumPy, the two components of a symmetric setup apart
        chosen = setup(record, row)
        values, reached = [], 0.0
        for components, across, columns in chosen.parities(3):
            phi = chosen.blended(record.vertices, across)[:, columns]
            U = phi @ np.linalg.inv(chosen.psi(across))
            values.append(np.linalg.svd(U, compute_uv=False))
            q = np.linalg.qr(U)[0]
            reached += float(((q.T @ record.gradient[:, components]) ** 2).sum())
        spectrum = np.concatenate(values)
        assert record.improvement_potential[row] == pytest.approx(reached, rel=1e-9)
        assert record.regularity[row] == pytest.approx(spectrum.min() / spectrum.max(), rel=1e-7)
    assert state.held.any()


def test_known_setups_are_scored_on_a_new_field_at_once(searched: tuple[State, list[Front], Search]) -> None:
    state, fronts, search = searched
    field = state.field + painted.bump(state.vertices, (-0.3, 0.0, 0.3), 0.03)
    new = task(state, 2)._replace(wanted=field)
    known = fronts[-1].record.centers
    front = search.take(new)
    assert (front.number, front.step, front.settled) == (2, 0, False)
    again = Search(state.vertices, state.triangles, search._file.with_name("other.vtp"))
    expected = again.take(new._replace(known=known))  # the design built anew
    np.testing.assert_allclose(front.record.gradient, expected.record.gradient, rtol=0, atol=1e-15)
    np.testing.assert_allclose(front.record.regularity, expected.record.regularity, rtol=1e-9)
    np.testing.assert_allclose(front.record.improvement_potential, expected.record.improvement_potential, rtol=1e-9)
    assert {centers.tobytes() for centers in front.record.centers} <= {centers.tobytes() for centers in known}


def test_a_search_that_is_stopped_ends_after_the_next_step(searched: tuple[State, list[Front], Search]) -> None:
    state, _, search = searched
    asked = []

    def stop() -> bool:
        """After the third step."""
        asked.append(1)
        return len(asked) == 3

    search.take(task(state, 3))
    assert not [front for front in search.improve(task(state, 3), stop) if front.settled]
    assert len(asked) == 3


def test_setups_move_out_of_regions_that_are_marked_later(searched: tuple[State, list[Front], Search]) -> None:
    state, fronts, search = searched
    held = state.held | (state.vertices[:, 2] > 0.2)
    front = search.take(task(state, 4)._replace(held=held, known=fronts[-1].record.centers))
    region = search._parts.scenario.keep_out if search._parts is not None else None
    assert region is not None
    inside = region.contains(torch.from_numpy(front.record.centers.reshape(-1, 3)))
    assert bool(region.contains(torch.from_numpy(fronts[-1].record.centers.reshape(-1, 3))).any())
    assert not bool(inside.any())
    assert not front.record.gradient[held].any()


def test_other_numbers_of_centers_begin_anew(short: None, tmp_path: Path) -> None:
    state = painted.state(Choices(centers=3))
    search = Search(state.vertices, state.triangles, tmp_path / "searched.vtp")
    search.prepare(state.choices)
    first = search.take(task(state))
    assert first.record.centers.shape[1:] == (3, 3)
    assert first.record.summary["support"] == pytest.approx(0.15 * np.linalg.norm(np.ptp(
        state.vertices, axis=0) + 0.1 * np.linalg.norm(np.ptp(state.vertices, axis=0))))  # fmt: skip
    other = dataclasses.replace(state.choices, centers=4, kernel="gaussian", radius=0.4, manipulation="indirect")
    second = search.take(task(state)._replace(choices=other))
    assert second.record.centers.shape[1:] == (4, 3)
    assert second.record.summary["representation"]["kernel"]["scale"] == 0.4
    assert second.record.summary["manipulation"] == "indirect"


def test_a_field_that_moves_nothing_is_refused(short: None, tmp_path: Path) -> None:
    state = painted.state()
    search = Search(state.vertices, state.triangles, tmp_path / "searched.vtp")
    with pytest.raises(UserError, match=r"no vertex is left that should move|zero at every vertex"):
        search.take(task(state)._replace(wanted=np.where(state.held[:, None], 1.0, 0.0)))
    with pytest.raises(UserError, match=r"has only 642 vertices"):
        search.take(task(state)._replace(choices=Choices(centers=10_000)))
    assert search.take(task(state)).record.centers.shape[1:] == (6, 3)  # and the next one is searched


def test_a_wanted_displacement_in_the_place_of_another_is_as_if_it_was_read(tmp_path: Path) -> None:
    state = painted.state()
    other = painted.bump(state.vertices, (-0.5, 0.1, -0.3), 0.2)
    found = []
    for name, field in (("first.vtp", state.field), ("other.vtp", other)):
        write_mesh(tmp_path / name, state.vertices, state.triangles, field, state.held)
        keys: dict[str, Any] = {"sensitivity": "painted", "sensitivity_kind": "nodal", "hold": "held"}
        found.append(mesh(template=str(tmp_path / name), objective="maximize", **keys))
    replaced = found[0].wanting(torch.from_numpy(other))
    np.testing.assert_array_equal(replaced.gradient.numpy(), found[1].gradient.numpy())
    assert replaced.gradient_norm == pytest.approx(found[1].gradient_norm, rel=1e-15)
    smooth = dataclasses.replace(found[0], smooth=0.1)
    with pytest.raises(UserError, match="cannot be replaced"):
        smooth.wanting(torch.from_numpy(other))


# Shapes


def shape_of(searched: tuple[State, list[Front], Search], row: int = 3) -> Shape:
    state, fronts, _ = searched
    size = float(np.linalg.norm(np.where(state.held[:, None], 0.0, state.field)))
    return Shape(fronts[-1].record, setup(fronts[-1].record, row), size)


def test_the_shape_goes_as_far_as_asked_along_the_best_approximation(
    searched: tuple[State, list[Front], Search],
) -> None:
    state, fronts, _ = searched
    shape, still = shape_of(searched), np.zeros((6, 3))
    record = fronts[-1].record
    whole, half = shape.look(Pulls(1.0, still)), shape.look(Pulls(0.5, still))
    moved = whole.vertices - state.vertices
    np.testing.assert_allclose(half.vertices - state.vertices, 0.5 * moved, atol=1e-15)
    wanted = np.where(state.held[:, None], 0.0, state.field)
    left = ((wanted - moved) ** 2).sum() / (wanted**2).sum()
    assert 1.0 - left == pytest.approx(record.improvement_potential[3], rel=1e-8)
    assert whole.farthest == pytest.approx(np.linalg.norm(moved, axis=1).max())
    assert not moved[state.held].any()
    assert whole.folded == 0
    far = shape.look(Pulls(-60.0, still))
    before, after = (painted_normals(v, state.triangles) for v in (state.vertices, far.vertices))
    assert far.folded == int(((before * after).sum(axis=1) < 0).sum()) > 0


def painted_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("manipulation", ["direct", "indirect"])
def test_a_pull_moves_one_control_point(short: None, tmp_path: Path, manipulation: str) -> None:
    state = dataclasses.replace(painted.state(Choices(centers=5, manipulation=manipulation, radius=1.5)), held=None)
    state.held = np.zeros(len(state.vertices), bool)
    search = Search(state.vertices, state.triangles, tmp_path / "searched.vtp")
    record = search.take(task(state)).record
    chosen = setup(record, 0)
    shape, moved = Shape(record, chosen, 1.0), np.zeros((5, 3))
    moved[2] = (0.01, -0.02, 0.03)
    assert np.abs(chosen.psi() - np.eye(5)).max() > 0.1  # they reach each other
    weights = shape.weights(Pulls(0.0, moved))
    reached = chosen.displacement(chosen.centers, weights)
    if manipulation == "direct":
        np.testing.assert_allclose(reached, moved, atol=1e-12)
        before, after = shape.points(Pulls(0.0, moved))
        np.testing.assert_allclose(after - before, moved, atol=1e-12)
    else:
        np.testing.assert_array_equal(weights, moved)  # Wendland's function is 1 at its center
    look = shape.look(Pulls(0.0, moved))
    np.testing.assert_allclose(look.vertices - state.vertices, chosen.displacement(state.vertices, weights), atol=1e-14)


def test_a_control_point_on_the_plane_stays_on_it(searched: tuple[State, list[Front], Search]) -> None:
    shape = shape_of(searched)
    chosen = dataclasses.replace(shape.chosen, on_plane=np.array([True] + [False] * 5))
    own = object.__new__(Shape)
    own.chosen = chosen
    np.testing.assert_array_equal(own.allowed(0, np.array([1.0, 2.0, 3.0])), [1.0, 0.0, 3.0])
    np.testing.assert_array_equal(own.allowed(1, np.array([1.0, 2.0, 3.0])), [1.0, 2.0, 3.0])


def test_the_chosen_setup_stays_while_the_front_changes(searched: tuple[State, list[Front], Search]) -> None:
    _, fronts, _ = searched
    chosen, record = Chosen(), fronts[-1].record
    chosen.take(record, 1.0)
    assert chosen.row == chosen.knee
    chosen.go("right")
    assert chosen.row == (chosen.knee or 0) + 1
    chosen.go("best-regularity")
    assert chosen.row == len(record.regularity) - 1
    chosen.go("right")
    assert chosen.row == len(record.regularity) - 1
    chosen.pulls = chosen.pulls._replace(moved=np.ones((6, 3)))
    kept = chosen.centers
    fewer = slice(1, None)
    shorter = dataclasses.replace(record, **{
        name: getattr(record, name)[fewer]
        for name in ("centers", "regularity", "improvement_potential", "method", "preference", "nondominated")
    })  # fmt: skip
    chosen.take(shorter, 1.0)
    assert chosen.row == len(record.regularity) - 2
    np.testing.assert_array_equal(chosen.centers, kept)
    assert chosen.touched
    chosen.take(dataclasses.replace(shorter, centers=shorter.centers + 0.01), 1.0)  # it is gone: the nearest in scores
    assert chosen.row == len(record.regularity) - 2
    assert not chosen.touched
    chosen.go("best-improvement-potential")
    assert chosen.row == 0
    chosen.go("left")
    assert chosen.row == 0


# What is kept


def test_a_state_is_kept_and_found_again(tmp_path: Path) -> None:
    assert keeping.kept(tmp_path) is None
    state = painted.state(Choices(kernel="gaussian", radius=0.2, symmetry="z", centers=4, up="y"))
    state.centers, state.chosen = np.random.default_rng(0).normal(size=(3, 4, 3)), 2
    state.share, state.moved, state.brush = 0.7, np.ones((4, 3)), {"action": "push", "radius": 3.5}
    keeping.keep(tmp_path, state)
    found = keeping.kept(tmp_path)
    assert found is not None
    for field in dataclasses.fields(State):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(state, field.name))
    assert found.begun
    assert found.same_surface(state)
    aside = keeping.put_aside(tmp_path)
    assert aside is not None
    assert aside.name == "studio-1.npz"
    assert keeping.kept(tmp_path) is None
    assert keeping.put_aside(tmp_path) is None


def test_a_damaged_state_is_refused(tmp_path: Path) -> None:
    state = painted.state()
    keeping.keep(tmp_path, state)
    path = tmp_path / keeping.FILE
    whole = path.read_bytes()
    for content, message in ((whole[:1000], "damaged"), (b"", "damaged")):
        path.write_bytes(content)
        with pytest.raises(UserError, match=message):
            keeping.kept(tmp_path)
    state.chosen = 3
    keeping.keep(tmp_path, state)
    with pytest.raises(UserError, match="do not match"):
        keeping.kept(tmp_path)


def test_choices_are_checked() -> None:
    assert set(LENGTHS) == set(KERNELS) - {"triharmonic"}
    wrong: dict[str, Any]
    for wrong, message in (
        ({"kernel": "spline"}, "kernel=spline: choose one of"),
        ({"radius": 0.0}, "radius 0: give a positive length"),
        ({"manipulation": "both"}, "manipulation=both: choose one of"),
        ({"centers": 0}, "centers=0: give at least 1"),
        ({"symmetry": "w"}, "symmetry=w: choose one of"),
    ):
        with pytest.raises(UserError, match=message):
            Choices(**wrong)
    arguments = Choices(kernel="triharmonic", radius=1.0).arguments(Path("a.vtp"), 100_000, True)
    assert "scenario.hold=held" in arguments
    assert "scenario.search_vertices=20000" in arguments
    assert not [argument for argument in arguments if argument.startswith("kernel.")]


# What comes out


@pytest.fixture(scope="module")
def saved(
    searched: tuple[State, list[Front], Search], tmp_path_factory: pytest.TempPathFactory
) -> tuple[State, saving.Saved]:
    """The painted ellipsoid saved as a run, in a directory with a blank in its name."""
    state, _, _ = searched
    state = dataclasses.replace(state, chosen=2, moved=np.zeros((6, 3)))
    return state, saving.save(tmp_path_factory.mktemp("out") / "my run", state)


def test_a_saved_run_holds_the_setups_to_the_bit(
    saved: tuple[State, saving.Saved], searched: tuple[State, list[Front], Search]
) -> None:
    state, found = saved
    record, shown = read(found.run), searched[1][-1].record
    np.testing.assert_array_equal(record.centers, state.centers)
    np.testing.assert_allclose(record.regularity, shown.regularity, rtol=1e-9)
    np.testing.assert_allclose(record.improvement_potential, shown.improvement_potential, rtol=1e-9)
    assert (found.run / "report.html").exists()
    with opened_mesh(found.run / saving.MESH) as mesh_read:
        np.testing.assert_array_equal(mesh_read.points, state.vertices)
        np.testing.assert_array_equal(mesh_read.arrays["painted"], state.field)
        np.testing.assert_array_equal(mesh_read.arrays["held"] != 0, state.held)


def test_its_two_commands_score_the_setups_and_search_the_field(
    saved: tuple[State, saving.Saved], capfd: pytest.CaptureFixture[str]
) -> None:
    state, found = saved
    python, dash, name, *given = shlex.split(found.scores)
    assert (python, dash, name) == ("python", "-m", "rbfevo")
    assert rbfevo([*given, "figures=false", "quiet=true"]) == 0
    again = read(found.run.with_name(f"{found.run.name}-again"))
    np.testing.assert_array_equal(again.centers, state.centers)
    np.testing.assert_array_equal(again.improvement_potential, read(found.run).improvement_potential)
    searches = shlex.split(found.searches)[3:]
    short = ("starts=16", "population=16", "generations=4", "polish=1")
    assert rbfevo([*searches, "figures=false", "quiet=true", *(f"method.{key}" for key in short)]) == 0
    anew = read(found.run.with_name(f"{found.run.name}-searched"))
    np.testing.assert_array_equal(anew.gradient, again.gradient)
    assert anew.summary["support"] == again.summary["support"]
    assert capfd.readouterr().err == ""


def test_a_saved_directory_opens_as_it_was(saved: tuple[State, saving.Saved]) -> None:
    state, found = saved
    again, template = opened(found.run)
    assert template is None
    for field in dataclasses.fields(State):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(state, field.name))


def test_a_run_of_rbfevo_opens_with_what_it_wanted(saved: tuple[State, saving.Saved]) -> None:
    state, found = saved
    aside = keeping.put_aside(found.run)
    assert aside is not None
    try:
        again, _ = opened(found.run)
    finally:
        aside.replace(found.run / keeping.FILE)
    assert again.choices == dataclasses.replace(state.choices, radius=again.choices.radius)
    np.testing.assert_array_equal(again.held, read(found.run).blend == 0.0)
    np.testing.assert_array_equal(again.centers, state.centers)
    wanted = np.where(state.held[:, None], 0.0, state.field)
    scale = 0.05 * np.linalg.norm(np.ptp(state.vertices, axis=0)) / np.linalg.norm(wanted, axis=1).max()
    np.testing.assert_allclose(again.field, scale * wanted, atol=1e-12)  # a sensitivity has no length of its own


def test_apply_deforms_the_file_as_the_page_shows_it(
    saved: tuple[State, saving.Saved], searched: tuple[State, list[Front], Search]
) -> None:
    _, found = saved
    shape, moved = shape_of(searched, 2), np.zeros((6, 3))
    moved[1] = (0.0, 0.01, 0.02)
    pulls = Pulls(0.8, moved)
    out = saving.apply(found, 2, shape.weights(pulls), found.run / saving.MESH)
    with opened_mesh(out) as deformed:
        np.testing.assert_allclose(deformed.points, shape.look(pulls).vertices, atol=1e-12)
    assert saving.apply(found, 2, shape.weights(pulls), found.run / saving.MESH).name == "deformed-2.vtp"
    assert (saving.export(found, 2) / "centers.csv").exists()
    assert saving.export(found, 2).name == "export-2-2"


def test_what_cannot_be_saved_is_said_in_a_line(saved: tuple[State, saving.Saved], tmp_path: Path) -> None:
    state, found = saved
    with pytest.raises(UserError, match="already holds results"):
        saving.save(found.run, state)
    with pytest.raises(UserError, match="no front to save yet"):
        saving.save(tmp_path / "new", painted.state())
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        saving.save(tmp_path / "file" / "run", state)
