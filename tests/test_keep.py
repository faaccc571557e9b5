"""`keep=FILE`: centers that stay in every setup; `method.start=FILE`: setups that a search starts from."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgba

from rbfevo import advise
from rbfevo.__main__ import main
from rbfevo.figures import __main__ as figures
from rbfevo.figures import centers, style
from rbfevo.methods.lloyd import _seed, inertia, lloyd
from rbfevo.methods.nested import nested
from rbfevo.methods.ols import ols
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup
from rbfevo.runs import run
from rbfevo.runs.config import build
from rbfevo.runs.journal import Journal
from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.representations import RBF
from tests.browsers import opened, settled
from tests.slabs import saved, strip
from tests.test_contracts import METHODS, option, settings
from tests.test_given import HALF, POINTS, notes, on_egg, table
from tests.test_mesh_runs import SUPPORT, egg

if TYPE_CHECKING:
    from playwright.sync_api import Browser

KEPT = POINTS[[0, 3, 2]]
SEARCHES = ("cmaes", "gradient", "nsga2")
ONE_SIDE = np.array([[-1.6, -0.5, 0.2], [0.1, -0.9, -0.3], [1.4, -0.6, 0.4]])  # not the one that is searched


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"))


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def overrides(method: str) -> list[str]:
    return [f"method={method}", *(f"method.{key}={value}" for key, value in METHODS[method].items())]


@pytest.mark.parametrize("method", [name for name in METHODS if name != "given"])
def test_every_method_keeps_the_centers_to_the_bit_and_places_the_others(method: str, tmp_path: Path) -> None:
    file = str(table(tmp_path / "old.csv", KEPT, "x,y"))
    found = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        assert run.carry_out(settings(method, seed, keep=file, centers=5), tmp_path / name) == 0
        found.append(read(tmp_path / name))
    record = found[0]
    assert record.centers.shape[1:] == (5, 2)
    np.testing.assert_array_equal(record.centers[:, :3], np.broadcast_to(KEPT, (len(record.centers), 3, 2)))
    own = record.centers[:, 3:]
    assert (own >= record.lower - 1e-12).all()
    assert (own <= record.upper + 1e-12).all()
    assert len(np.unique(own[record.method == method].reshape(-1, 2), axis=0)) > 1
    assert record.summary["kept"] == 3
    np.testing.assert_array_equal(record.centers, found[1].centers)
    if method not in ("blend", "ols"):  # of two centers all starts of Lloyd end at the same places
        assert not np.array_equal(record.centers, found[2].centers)
    # None of the columns is lost: P is at least that of the kept centers alone.
    phi = build(option("kernel", "wendland"), 2, 0.5, 2.0)

    def potential(centers: np.ndarray) -> float:
        U = phi(np.linalg.norm(record.vertices[:, None] - centers, axis=2))
        return 1.0 - float(np.square(record.gradient - U @ np.linalg.lstsq(U, record.gradient)[0]).sum())

    alone = potential(KEPT)
    assert (record.improvement_potential >= alone - 1e-9).all()
    assert record.improvement_potential[0] == pytest.approx(potential(record.centers[0]), abs=1e-8)


@pytest.mark.parametrize("method", [*SEARCHES, "lloyd", "ols", "random"])
@pytest.mark.parametrize(("kept", "count", "on_plane"), [(ONE_SIDE, 6, 0), (ONE_SIDE, 5, 1), (HALF[[0, 3]], 5, 0)])
def test_with_symmetry_kept_centers_stay_and_an_odd_number_has_one_on_the_plane(
    method: str, kept: np.ndarray, count: int, on_plane: int, template: Path, tmp_path: Path
) -> None:
    file = table(tmp_path / "old.csv", kept, "x,y,z")
    out = tmp_path / "run"
    asked = [*overrides(method), f"keep={file}", f"centers={count}", "manipulation=direct"]
    assert main(on_egg(out, template, None, *asked)) == 0
    record = read(out)
    k = len(kept)
    np.testing.assert_array_equal(record.centers[:, :k], np.broadcast_to(kept, (len(record.centers), k, 3)))
    assert record.centers.shape[1] == count
    added = record.centers[:, k:, 1]
    assert (added >= 0.0).all() or (added <= 0.0).all()
    there = np.isclose(added, 0.0, atol=1e-12).sum(1)
    assert (there == on_plane).all() or (
        method in ("gradient", "ols") and (there >= on_plane).all()
    )  # the box ends there
    assert f"{k} of {count} centers stay" in notes(out)


@pytest.mark.parametrize("method", ["nsga2", "gradient", "lloyd"])
def test_on_a_slab_the_added_centers_lie_in_its_plane(method: str, tmp_path: Path) -> None:
    surface = strip(48)
    x = np.asarray(surface.points)
    mesh = saved(surface, tmp_path / "slab.vtp", s=np.stack([x[:, 0] ** 3, x[:, 1], 0 * x[:, 0]], axis=1))
    kept = np.array([[-1.5, 0.4], [0.3, 0.9]])
    asked = ["scenario=mesh", f"scenario.template={mesh}", "scenario.sensitivity=s", "scenario.planar=z", "quiet=true"]
    asked += [*overrides(method), f"keep={table(tmp_path / 'old.csv', kept, 'x,y')}", "centers=4", "kernel.support=1.5"]
    assert main([f"hydra.run.dir={tmp_path / 'run'}", *asked]) == 0
    record = read(tmp_path / "run")
    at = record.summary["planar"]["at"]
    whole = np.column_stack([kept, [at, at]])
    np.testing.assert_array_equal(record.centers[:, :2], np.broadcast_to(whole, (len(record.centers), 2, 3)))
    np.testing.assert_array_equal(record.centers[:, :, 2], at)


def grid(per_axis: int = 9) -> torch.Tensor:
    x, y = np.meshgrid(np.linspace(0, 1, per_axis), np.linspace(0, 2, per_axis), indexing="ij")
    return torch.from_numpy(np.column_stack([x.ravel(), y.ravel()]))


def design() -> tuple[torch.Tensor, torch.Tensor]:
    X = grid(21)
    g = torch.sin(3.0 * X[:, :1]) * torch.cos(2.0 * X[:, 1:]) + 0.3 * X[:, :1]
    return X, g / g.norm()


def test_ols_goes_on_beside_kept_centers_as_it_would_have_gone_on() -> None:
    X, g = design()
    phi = RBF(build(option("kernel", "wendland"), 2, 0.7, 2.0))

    def columns(centers: torch.Tensor) -> torch.Tensor:
        return phi.phi(X, centers)

    weights = 1.0 + X[:, 0]
    whole = ols(columns, grid(), g, 7, weights=weights)
    rest = ols(columns, grid(), g, 4, weights=weights, kept=whole.centers[:3])
    torch.testing.assert_close(rest.centers, whole.centers[3:], rtol=0, atol=0)
    torch.testing.assert_close(rest.gains, whole.gains[3:], rtol=1e-9, atol=1e-12)
    twice = torch.cat((whole.centers[:3], whole.centers[:1]))  # a column that depends on another changes nothing
    torch.testing.assert_close(ols(columns, grid(), g, 4, weights=weights, kept=twice).centers, rest.centers)
    # Beside centers off the grid the first pick is the best of all candidates, each with a fit of its own.
    kept = torch.tensor([[0.37, 0.81], [0.91, 1.63]], dtype=torch.float64)
    first = ols(columns, grid(), g, 1, kept=kept).centers[0]
    left = []
    for candidate in grid():
        U = columns(torch.cat((kept, candidate[None]))).numpy()
        left.append(np.square(g.numpy() - U @ np.linalg.lstsq(U, g.numpy())[0]).sum())
    torch.testing.assert_close(first, grid()[int(np.argmin(left))], rtol=0, atol=0)


def test_the_nested_sequence_goes_on_beside_kept_centers() -> None:
    X, g = design()
    representation = RBF(build(option("kernel", "wendland"), 2, 0.7, 2.0))
    bounded = BoundedPotential(X, g, representation, 16.0, torch.ones_like(X[:, 0]), None)
    arguments = (bounded, lambda centers: representation.phi(X, centers), lambda centers: centers, grid(5))
    whole = nested(*arguments, 5)
    rest = nested(*arguments, 3, kept=whole.centers[:2])
    torch.testing.assert_close(rest.centers, whole.centers[2:], rtol=0, atol=0)
    torch.testing.assert_close(rest.potential, whole.potential[2:], rtol=1e-7, atol=1e-9)
    # What candidates promise is also measured beside the kept centers: the most promising alone are the same.
    whole = nested(*arguments, 4, tried=1)
    torch.testing.assert_close(nested(*arguments, 2, tried=1, kept=whole.centers[:2]).centers, whole.centers[2:])


def test_lloyd_places_centroids_beside_centers_that_do_not_move() -> None:
    X = grid(31)
    weights = 1.0 + X[:, 1]
    kept = torch.tensor([[0.2, 0.3], [0.8, 0.3]], dtype=torch.float64)
    found = lloyd(X, 4, generator=torch.Generator().manual_seed(1), weights=weights, kept=kept)
    every = torch.cat((found, kept)).numpy()
    label = ((X.numpy()[:, None] - every) ** 2).sum(2).argmin(1)
    for j in range(4):
        mine = label == j
        centroid = (weights.numpy()[mine, None] * X.numpy()[mine]).sum(0) / weights.numpy()[mine].sum()
        np.testing.assert_allclose(every[j], centroid, atol=1e-12)
    alone = lloyd(X, 4, generator=torch.Generator().manual_seed(1), weights=weights)
    both = [inertia(X, torch.cat((centers, kept)), weights) for centers in (found, alone)]
    assert float(both[0]) < float(both[1])


def test_lloyd_is_seeded_away_from_centers_that_do_not_move() -> None:
    near, far = grid() * 0.01, grid() * 0.01 + 5.0
    X = torch.cat((near, far))
    masses = torch.ones(len(X), dtype=torch.float64)
    seeds = _seed(X, masses, 1, 50, torch.Generator().manual_seed(1), torch.tensor([[0.0, 0.0]], dtype=torch.float64))
    assert bool((seeds > 1.0).all())


@pytest.mark.parametrize("method", ["lloyd", "ols"])
def test_heuristics_see_kept_centers_of_the_other_side_as_their_images(
    method: str, template: Path, tmp_path: Path
) -> None:
    added = []
    for name, kept in (("a", ONE_SIDE), ("b", ONE_SIDE * [1, -1, 1])):
        file, out = table(tmp_path / f"{name}.csv", kept, "x,y,z"), tmp_path / name
        assert main(on_egg(out, template, None, *overrides(method), f"keep={file}", "centers=6")) == 0
        added.append(read(out).centers[-1, 3:])
    np.testing.assert_allclose(added[0], added[1], atol=1e-12)


@pytest.mark.parametrize("symmetric", [False, True])
def test_gradients_of_the_searched_centers_are_those_of_differences(
    symmetric: bool, template: Path, tmp_path: Path
) -> None:
    file = str(table(tmp_path / "old.csv", KEPT if not symmetric else ONE_SIDE))
    if symmetric:
        node = {**option("scenario", "mesh"), "template": str(template), "symmetry": "y", "symmetry_at": 0.0}
        node |= {"sensitivity": str(template.parent / "s.npy"), "support": SUPPORT}
        made = settings("gradient", keep=file, centers=6, scenario=node, manipulation="direct")
    else:
        made = settings("gradient", keep=file, centers=6, manipulation="direct")
    problem = run.Run(made).problem()
    space = problem.space
    shape = tuple(space.lower.shape)
    assert shape == (3, 3 if symmetric else 2)
    points = space.lower + (space.upper - space.lower) * torch.rand(
        2, *shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    spectrum = problem.spectrum(space.place(points))
    weights = torch.linspace(-1.0, 1.0, spectrum.sigma.shape[1], dtype=torch.float64).expand_as(spectrum.sigma)
    found = space.pull(points, spectrum.backward(torch.zeros_like(weights), torch.ones(2, dtype=torch.float64)))
    assert found.shape == points.shape
    step = 1e-6
    for row in range(2):
        for index in np.ndindex(*shape):
            values = []
            for sign in (1.0, -1.0):
                moved = points.clone()
                moved[(row, *index)] += sign * step
                values.append(float(problem.spectrum(space.place(moved)).potential[row]))
            assert float(found[(row, *index)]) == pytest.approx((values[0] - values[1]) / (2 * step), abs=2e-6)


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_every_old_design_stays_representable(manipulation: str, template: Path, tmp_path: Path) -> None:
    old = table(tmp_path / "old.csv", ONE_SIDE, "x,y,z")
    more = [f"manipulation={manipulation}"]
    assert main(on_egg(tmp_path / "old", template, old, *more)) == 0
    assert main(on_egg(tmp_path / "new", template, None, *more, *overrides("ols"), f"keep={old}", "centers=6")) == 0
    before, after = read(tmp_path / "old"), read(tmp_path / "new")
    few, many = setup(before, 0), setup(after, 0)
    parameters = np.random.default_rng(3).normal(size=(3, 3))
    weights = parameters if manipulation == "indirect" else few.weights(parameters)
    wanted = few.displacement(before.vertices, weights)
    if manipulation == "indirect":
        again = many.displacement(before.vertices, np.vstack([weights, np.zeros((3, 3))]))
    else:  # the new control points are displaced as the old design displaces them
        moves = few.displacement(many.centers, weights)
        np.testing.assert_allclose(moves[:3], parameters, atol=1e-12)
        again = many.displacement(before.vertices, many.weights(moves))
    np.testing.assert_allclose(again, wanted, atol=1e-10)
    assert after.improvement_potential[0] > before.improvement_potential[0] + 1e-3


def test_a_kept_file_that_does_not_fit_gets_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], template: Path
) -> None:
    file = table(tmp_path / "old.csv", KEPT, "x,y")
    out = tmp_path / "run"

    def refused(*more: str) -> str:
        assert main([f"hydra.run.dir={out}", "scenario=plane", "quiet=true", *more]) == 2
        line = capsys.readouterr().err.strip()
        assert "\n" not in line
        assert not (out / "setups.npz").exists()
        return line

    three = refused(f"keep={file}", "centers=3")
    assert f"keep={file}: it holds 3 centers, and centers=3: give more than 3" in three
    assert "method=given" in three
    assert "centers=2: give more than 3" in refused(f"keep={file}", "centers=2")
    assert "method=given brings all centers itself" in refused(f"keep={file}", "method=given", f"method.centers={file}")
    assert "no such file" in refused(f"keep={tmp_path / 'none.csv'}").lower()
    table(tmp_path / "bad.csv", np.array([[0.1, np.nan], [0.2, 0.3]]), "x,y")
    assert "finite" in refused(f"keep={tmp_path / 'bad.csv'}")
    assert advise.main([f"hydra.run.dir={out}", "scenario=plane", f"keep={file}"]) == 2
    assert "leave it out" in capsys.readouterr().err
    assert main(on_egg(out, template, None, f"keep={file}")) == 2
    assert "three dimensions" in capsys.readouterr().err


def test_a_run_that_goes_on_refuses_other_kept_centers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import signal

    file, out = table(tmp_path / "old.csv", KEPT, "x,y"), tmp_path / "run"
    asked = [f"hydra.run.dir={out}", "scenario=plane", "quiet=true", "centers=5", f"keep={file}", *overrides("nsga2")]
    write_lines = Journal.record

    def record_and_interrupt(journal: Journal, lines: Any) -> None:
        write_lines(journal, lines)
        signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "record", record_and_interrupt)
        assert main(asked) == 143
    capsys.readouterr()
    table(file, KEPT * 1.01, "x,y")
    assert main([f"resume={out}"]) == 2
    assert "keep, method.start or method.centers have changed" in capsys.readouterr().err
    table(file, KEPT, "x,y")
    assert main([f"resume={out}"]) == 0
    np.testing.assert_array_equal(read(out).centers[:, :3][-1], KEPT)


@pytest.mark.parametrize("method", SEARCHES)
def test_what_a_search_finds_is_no_worse_than_what_it_started_from(method: str, tmp_path: Path) -> None:
    good = settings("gradient", 5, method={**option("method", "gradient"), **METHODS["gradient"], "generations": 60})
    assert run.carry_out(good, tmp_path / "good") == 0
    record = read(tmp_path / "good")
    searched = np.flatnonzero(record.method == "gradient")
    rows = [searched[record.regularity[searched].argmax()], searched[record.improvement_potential[searched].argmax()]]
    files = [str(table(tmp_path / f"{i}.csv", record.centers[row], "x,y")) for i, row in enumerate(rows)]
    node = {**option("method", method), **METHODS[method], "start": files}
    preferences = (0.0, 1.0) if method == "cmaes" else None
    assert run.carry_out(settings(method, method=node, preferences=preferences), tmp_path / "run") == 0
    found = read(tmp_path / "run")
    own = found.method == method
    best = found.regularity[own], found.improvement_potential[own]
    for row, potential in zip(rows, (False, True), strict=True):
        better = best[0] >= record.regularity[row] - 1e-12, best[1] >= record.improvement_potential[row] - 1e-12
        if method == "cmaes":  # which climbs one score alone for each of these preferences
            assert better[potential].any()
        else:
            assert (better[0] & better[1]).any()
    without = settings(method, method={**option("method", method), **METHODS[method]}, preferences=preferences)
    assert run.carry_out(without, tmp_path / "without") == 0
    plain = read(tmp_path / "without")
    assert plain.improvement_potential[plain.method == method].max() < record.improvement_potential[rows[1]] - 1e-3
    assert found.summary["notes"][f"start {files[0]}"].startswith(files[0])


def test_a_start_holds_all_centers_or_those_beside_the_kept_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = table(tmp_path / "old.csv", KEPT[:2], "x,y")
    whole = table(tmp_path / "whole.csv", np.vstack([KEPT[:2], [[0.25, 1.75], [0.5, 0.5]]]), "x,y")
    others = table(tmp_path / "others.csv", np.array([[0.25, 1.75], [0.5, 0.5]]), "x,y")
    common = ["scenario=plane", "quiet=true", "centers=4", f"keep={kept}", *overrides("nsga2")]
    runs = []
    for file in (whole, others):
        out = tmp_path / file.stem
        assert main([f"hydra.run.dir={out}", *common, f"method.start={file}", "method.generations=2"]) == 0
        runs.append(read(out))
    np.testing.assert_array_equal(runs[0].centers, runs[1].centers)
    np.testing.assert_array_equal(runs[0].centers[:, :2], np.broadcast_to(KEPT[:2], (len(runs[0].centers), 2, 2)))

    def refused(points: np.ndarray, *more: str) -> str:
        file = table(tmp_path / "wrong.csv", points, "x,y")
        assert main([f"hydra.run.dir={tmp_path / 'no'}", *common, f"method.start={file}", *more]) == 2
        return capsys.readouterr().err

    capsys.readouterr()
    assert "it has 3 centers; give 4, as centers= says, or the 2 beside those of keep=" in refused(POINTS[:3])
    assert "its first 2 centers are not those of keep=" in refused(POINTS)
    assert "1 of 2 centers outside the box" in refused(np.array([[0.5, 0.5], [1.5, 0.5]]))
    assert "keep them: keep=FILE" in refused(POINTS[:3], "keep=null")
    assert "13 files, and method=nsga2 begins with 12" in refused(
        POINTS, f"method.start=[{','.join(f'{i}.csv' for i in range(13))}]"
    )


def test_a_symmetric_start_may_lie_on_either_side(template: Path, tmp_path: Path) -> None:
    image = ONE_SIDE * [1, -1, 1]
    runs = []
    for name, points in (("a", ONE_SIDE), ("b", image)):
        file = table(tmp_path / f"{name}.csv", np.vstack([points, points[:1] * [-1, 1, 1]]), "x,y,z")
        out = tmp_path / name
        asked = [*overrides("nsga2"), "centers=4", f"method.start={file}"]
        assert main(on_egg(out, template, None, *asked)) == 0
        runs.append(read(out))
    np.testing.assert_allclose(np.sort(runs[0].regularity), np.sort(runs[1].regularity), rtol=1e-9)


def test_of_an_odd_number_a_symmetric_start_has_one_on_the_plane(
    template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def asked(points: np.ndarray) -> list[str]:
        file = table(tmp_path / "start.csv", points, "x,y,z")
        return [*overrides("nsga2"), "centers=3", f"method.start={file}"]

    assert main(on_egg(tmp_path / "a", template, None, *asked(ONE_SIDE))) == 2
    assert "keeps one on the plane of symmetry" in capsys.readouterr().err
    points = np.array([[0.2, 0.0, 0.8], [-1.6, 0.5, 0.2], [1.4, 0.6, 0.4]])
    assert main(on_egg(tmp_path / "b", template, None, *asked(points), "method.generations=1")) == 0


def test_dropping_the_kept_rows_is_the_inverse_of_placing(tmp_path: Path) -> None:
    file = str(table(tmp_path / "old.csv", KEPT, "x,y"))
    problem = run.Run(settings("nsga2", keep=file, centers=5)).problem()
    genotypes = torch.rand(4, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    setups = problem.unflatten(genotypes)
    torch.testing.assert_close(problem.flatten(setups), genotypes, rtol=0, atol=0)
    assert dataclasses.replace(problem, kept=problem.kept[:1]).free == 4


def test_pictures_show_which_centers_were_kept(template: Path, tmp_path: Path) -> None:
    dark, red = to_rgba(style.KEPT), to_rgba(style.RED)

    def colours(axes: Any) -> list[tuple[float, ...]]:
        (dots,) = [found for found in axes.collections if isinstance(found, PathCollection)][-1:]
        return [tuple(row) for row in np.asarray(dots.get_facecolor())]

    file = table(tmp_path / "old.csv", POINTS[[0, 3]], "x,y")
    assert run.carry_out(settings("lloyd", keep=str(file), centers=5), tmp_path / "plane") == 0
    record = read(tmp_path / "plane")
    image = centers.picture(record)
    assert colours(image.axes[0]) == [dark, dark, red, red, red]
    assert "the 2 kept centers are black" in [text.get_text() for text in image.texts]

    file = table(tmp_path / "half.csv", HALF[[0, 3]], "x,y,z")  # the second one is on the plane
    assert main(on_egg(tmp_path / "egg", template, "", "method=lloyd", "centers=4", f"keep={file}")) == 0
    record = read(tmp_path / "egg")
    assert record.kept == 2
    image = centers.picture(record, opengl=False)
    shown = [row for found in image.axes[0].collections if isinstance(found, PathCollection)
             for row in np.asarray(found.get_facecolor())]  # fmt: skip
    physical = setup(record, 0).centers_and_images()
    assert len(shown) == len(physical.points)
    assert sum(tuple(row[:3]) == dark[:3] for row in shown) == 3  # one of them and its image, and one on the plane


def test_the_page_shows_which_centers_were_kept(browser: Browser, template: Path, tmp_path: Path) -> None:
    file = table(tmp_path / "half.csv", HALF[[0, 3]], "x,y,z")  # the second one is on the plane
    assert main(on_egg(tmp_path / "egg", template, "", "method=lloyd", "centers=4", f"keep={file}")) == 0
    assert figures.main([str(tmp_path / "egg"), "--only", "report"]) == 0
    with opened(browser, tmp_path / "egg" / "report.html") as page:
        settled(page)
        script = "() => document.getElementById('space-a').data.slice(1).map((of) => [of.color, [...new Set(of.text)]])"
        balls = page.evaluate(script)
        script = (
            "() => ['--ink', '--grey'].map((of) => getComputedStyle(document.documentElement).getPropertyValue(of))"
        )
        ink, grey = (color.strip() for color in page.evaluate(script))
        assert "given to keep" in (page.text_content("#view-hint") or "")
    labels = dict(balls)
    assert [text.split(", given")[0] for text in labels[ink]] == ["center 0", "center 1"]
    assert [text.split("<br>")[0] for text in labels[grey]] == ["center 0, given to keep, mirrored"]
    assert sum(len(texts) for color, texts in balls if color not in (ink, grey)) == 4  # two others and their images
