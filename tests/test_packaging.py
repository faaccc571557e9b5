"""`scenario.inside` and `scenario.outside`: every center that is saved sits where it may."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
import torch

from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.geometry.packaging import Packaging
from rbfevo.geometry.solids import Box, Enclosed, within
from rbfevo.recorded.record import read
from rbfevo.scenarios.packaging import closed_surface
from tests.slabs import saved, strip
from tests.test_contracts import METHODS
from tests.test_given import notes, on_egg, table
from tests.test_mesh_runs import egg

LOW, HIGH = torch.tensor([-2.0, -2.0, -2.0], dtype=torch.float64), torch.tensor([2.0, 2.0, 2.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"))


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def ball(
    radius: float = 1.0, center: tuple[float, float, float] = (0.0, 0.0, 0.0), inward: bool = False, nsub: int = 4
) -> Any:
    made: Any = pv.Icosphere(radius=radius, center=center, nsub=nsub)
    return made.flip_faces() if inward else made


def parts(surface: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(surface.points, np.float64), surface.regular_faces.astype(np.int64)


def scattered(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (count, 3))


def test_heights_are_distances_to_the_boundary_with_their_signs() -> None:
    X = scattered(400)
    low, high = np.array([-1.0, -0.5, -np.inf]), np.array([1.5, 0.5, 1.0])
    heights = Box(low, high).heights(X)
    closest = np.clip(X, low, high)
    away = np.linalg.norm(X - closest, axis=1)
    np.testing.assert_allclose(heights[away > 0], -away[away > 0], atol=1e-15)
    deep = np.min([X[:, 0] + 1.0, 1.5 - X[:, 0], X[:, 1] + 0.5, 0.5 - X[:, 1], 1.0 - X[:, 2]], axis=0)
    np.testing.assert_allclose(heights[away == 0], deep[away == 0], atol=1e-15)
    length = np.linalg.norm(X, axis=1)
    for inward in (False, True):  # however it is wound
        path_free = Enclosed(*parts(ball(inward=inward)))
        np.testing.assert_allclose(path_free.heights(X), 1.0 - length, atol=4e-3)
    both = [Enclosed(*parts(ball(0.7, (-1.0, 0, 0)))), Enclosed(*parts(ball(0.7, (1.0, 0, 0))))]
    apart = np.minimum(*(np.linalg.norm(X - [x, 0, 0], axis=1) for x in (-1.0, 1.0)))
    clear = np.abs(apart - 0.7) > 4e-3
    np.testing.assert_array_equal(within(both, X)[clear], apart[clear] < 0.7)


def test_a_closed_surface_is_wound_outwards_and_keeps_its_cavity(tmp_path: Path) -> None:
    outer, inner = ball(1.0), ball(0.5, inward=True)
    for name, surface in (("a.stl", outer.merge(inner)), ("b.stl", outer.merge(inner).flip_faces())):
        surface.extract_surface(algorithm=None).save(tmp_path / name)
        shell = Enclosed(*closed_surface("outside", str(tmp_path / name)))
        np.testing.assert_array_equal(
            shell.heights(np.array([[0.0, 0, 0], [0.75, 0, 0], [1.2, 0, 0]])) > 0, [False, True, False]
        )


@pytest.mark.parametrize("mirrored", [False, True])
def test_centers_move_to_places_that_are_left_and_others_stay(mirrored: bool) -> None:
    mirror = Mirror.of_box(1, 0.0, LOW, HIGH) if mirrored else None
    inside = [Box(np.array([-1.5, -1.5, -1.5]), np.array([1.5, 1.0, 1.5]))]
    region = Packaging(inside, [Enclosed(*parts(ball()))], (LOW, HIGH), mirror)
    X = torch.from_numpy(scattered(2000))

    def allowed(points: torch.Tensor) -> torch.Tensor:
        every = [points, points * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)] if mirrored else [points]
        found = torch.ones(len(points), dtype=torch.bool)
        for places in every:
            found &= (places.abs() <= 1.5 + 1e-12).all(1) & (places[:, 1] <= 1.0 + 1e-12)
            found &= places.norm(dim=1) > 0.99
        return found

    length = X.norm(dim=1)
    clear = (length > 1.01) | (length < 0.98)
    assert bool((region.contains(X)[clear] == ~allowed(X)[clear]).all())
    placed, moved = region.project(X)
    inner = region.contains(X)
    assert bool((moved.any(1) == inner).all())
    torch.testing.assert_close(placed[~inner], X[~inner], rtol=0, atol=0)
    assert bool(allowed(placed).all())
    assert not bool(region.contains(placed).any())
    assert len(torch.unique(placed, dim=0)) > 1950  # they do not all land in the same places
    # Near the closest place that is left: no lattice point is much closer.
    far = (placed - X).norm(dim=1)
    places = torch.from_numpy(region.places)
    nearest = torch.cdist(X[inner], places).amin(1)
    assert bool((far[inner] <= nearest + 1e-12).all())
    drawn = region.sample(50, 4, torch.Generator().manual_seed(1)).flatten(0, 1)
    assert bool(allowed(drawn).all())
    assert float(drawn.std(0).amin()) > 0.5
    if mirrored:
        onto, _ = region.project(X * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64), 1)
        assert bool((onto[:, 1] == 0.0).all())
        assert bool(allowed(onto).all())


def test_nothing_left_is_refused() -> None:
    with pytest.raises(UserError, match="leave no place for centers"):
        Packaging([Box(np.full(3, 3.0), np.full(3, 4.0))], [], (LOW, HIGH))
    with pytest.raises(UserError, match="leave no place for centers"):
        Packaging([], [Box(np.full(3, -np.inf), np.full(3, np.inf))], (LOW, HIGH))
    mirror = Mirror.of_box(1, 0.0, LOW, HIGH)
    region = Packaging(
        [], [Box(np.array([-np.inf, -0.5, -np.inf]), np.array([np.inf, 0.5, np.inf]))], (LOW, HIGH), mirror
    )
    with pytest.raises(UserError, match="choose an even number"):
        region.project(torch.zeros(1, 3, dtype=torch.float64), 1)


def overrides(method: str) -> list[str]:
    return [f"method={method}", *(f"method.{key}={value}" for key, value in METHODS[method].items())]


@pytest.mark.parametrize("method", [name for name in METHODS if name != "given"])
@pytest.mark.parametrize("count", [4, 5])
def test_every_center_that_is_saved_sits_where_it_may(method: str, count: int, template: Path, tmp_path: Path) -> None:
    ball(0.5, (1.2, 0.3, 0.0), nsub=3).save(tmp_path / "engine.stl")  # within 2e-3
    boxes = ["scenario.inside=[[-1.5,null,-0.6,0.2,null,0.6],[0,-0.9,-0.6,1.9,0.9,0.8]]"]
    boxes += [f"scenario.outside=[{tmp_path / 'engine.stl'},[-0.5,-0.2,-0.2,0.4,0.2,0.2]]"]
    out = tmp_path / "run"
    assert main(on_egg(out, template, None, *overrides(method), *boxes, f"centers={count}")) == 0
    record = read(out)
    every = record.centers.reshape(-1, 3)
    assert len(every)
    for points in (every, every * [1, -1, 1]):
        one = (np.abs(points[:, 2]) <= 0.6) & (points[:, 0] >= -1.5) & (points[:, 0] <= 0.2)
        other = (points[:, 0] >= 0) & (points[:, 0] <= 1.9) & (points[:, 2] >= -0.6) & (points[:, 2] <= 0.8)
        other &= np.abs(points[:, 1]) <= 0.9
        assert (one | other).all()
        assert (np.linalg.norm(points - [1.2, 0.3, 0.0], axis=1) > 0.5 - 4e-3).all()
        low, high = np.array([-0.5, -0.2, -0.2]), np.array([0.4, 0.2, 0.2])
        assert not ((points > low) & (points < high)).all(1).any()
    if count == 5:
        on_plane = np.isclose(record.centers[..., 1], 0.0, atol=1e-12).sum(1)
        assert (on_plane >= 1).all()
    assert "centers sit inside 2 bodies and outside 2 bodies" in notes(out)


def test_the_region_of_held_vertices_counts_beside_them(template: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    asked = ["scenario.hold=[null,null,0.5,null,null,null]", "scenario.inside=[null,null,0,null,null,null]"]
    assert main(on_egg(out, template, None, *overrides("nsga2"), *asked, "centers=4")) == 0
    z = read(out).centers[..., 2]
    assert ((z >= 0.0) & (z <= 0.5 + 1e-9)).all()
    assert z.min() < 0.1 < z.max()


def test_on_a_slab_places_are_looked_for_in_its_plane(tmp_path: Path) -> None:
    surface = strip(48)
    x = np.asarray(surface.points)
    mesh = saved(surface, tmp_path / "slab.vtp", s=np.stack([x[:, 0] ** 3, x[:, 1], 0 * x[:, 0]], axis=1))
    asked = ["scenario=mesh", f"scenario.template={mesh}", "scenario.sensitivity=s", "scenario.planar=z", "quiet=true"]
    asked += [*overrides("gradient"), "centers=4", "kernel.support=1.5", "scenario.outside=[-1,-0.5,null,1,0.5,null]"]
    assert main([f"hydra.run.dir={tmp_path / 'run'}", *asked]) == 0
    record = read(tmp_path / "run")
    np.testing.assert_array_equal(record.centers[..., 2], record.summary["planar"]["at"])
    assert not ((np.abs(record.centers[..., 0]) < 1) & (np.abs(record.centers[..., 1]) < 0.5)).any()


def test_what_is_no_body_gets_one_line(template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*more: str) -> str:
        assert main(on_egg(tmp_path / "no", template, None, "method=random", *more)) == 2
        line = capsys.readouterr().err.strip()
        assert "\n" not in line
        return line

    pv.Disc(inner=0.0, r_res=3, c_res=12).triangulate().save(tmp_path / "disc.stl")
    assert "its surface is not closed: 12 edges belong to one triangle only" in refused(
        f"scenario.outside={tmp_path / 'disc.stl'}"
    )
    cloud = table(tmp_path / "cloud.xyz", scattered(20))
    assert "it has no triangles, and a closed surface is needed" in refused(f"scenario.inside={cloud}")
    assert "a box is six numbers" in refused("scenario.inside=[1,2,3]")
    assert "a lower side lies above its upper side" in refused("scenario.inside=[1,0,0,0,1,1]")
    assert "no such file" in refused(f"scenario.inside={tmp_path / 'none.stl'}").lower()
    assert "leave no place for centers" in refused("scenario.inside=[10,10,10,11,11,11]")
    assert main(on_egg(tmp_path / "yes", template, None, "method=random", "method.population=1")) == 0
    capsys.readouterr()
    almost = float(np.dot([0.0008, 0.9992], [read(tmp_path / "yes").lower[0], read(tmp_path / "yes").upper[0]]))
    assert "leave only 0.00%" not in refused(f"scenario.outside=[null,null,null,{almost},null,null]")


def test_given_centers_in_the_packaging_are_scored_with_a_note(template: Path, tmp_path: Path) -> None:
    file = table(tmp_path / "mine.csv", np.array([[0.1, 0.1, 0.1], [1.5, 0.6, 0.4]]), "x,y,z")
    out = tmp_path / "run"
    assert main(on_egg(out, template, file, "scenario.outside=[-0.5,-0.2,-0.2,0.4,0.2,0.2]")) == 0
    assert "1 of 2 points is in the region where searches place none (center 0)" in notes(out)
