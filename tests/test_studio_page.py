"""The studio in a real browser: strokes, the front, handles, files, other windows, and who may not come in."""

from __future__ import annotations

import dataclasses
import http.client
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import painted
import pytest
from browsers import serious
from scipy.spatial import KDTree
from studios import (
    Running,
    camera,
    facts,
    front,
    get,
    hint,
    place,
    problem,
    running,
    saved_as,
    settled,
    stroke,
    typed,
    until,
    window,
)

from rbfevo.meshes import opened as opened_mesh
from rbfevo.recorded.record import read
from rbfevo.studio import keeping
from rbfevo.studio.brush import Brush
from rbfevo.studio.choices import Choices
from rbfevo.studio.keeping import State
from rbfevo.studio.painting import Painting
from rbfevo.studio.picking import Camera, Surface
from rbfevo.studio.searching import write_mesh

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytest.importorskip("trame", reason="trame is not installed: pip install 'rbfevo[studio]'")

MIDDLE = ((0.45, 0.5), (0.55, 0.48))


def blank(directory: Path, **choices: object) -> Path:
    """A directory with an unpainted ellipsoid, and few control points, so that searches take seconds."""
    directory.mkdir(parents=True)
    state = painted.state(Choices(**{"centers": 4, **choices}))  # pyright: ignore[reportArgumentType]
    state = dataclasses.replace(state, field=np.zeros_like(state.vertices), held=np.zeros_like(state.held))
    keeping.keep(directory, state)
    return directory


def kept(directory: Path, page: Page) -> State:
    """The state on disk, once it is written, and as painted as the page."""

    def found() -> State | None:
        """It, or None while it is older."""
        state = keeping.kept(directory)
        painted_now = state is not None and bool(state.field.any() or state.held.any())
        return state if state is not None and painted_now == bool(get(page, "painted")) else None

    page.wait_for_timeout(3500)
    return until(page, found)


@pytest.fixture(scope="module")
def painted_page(
    browser: Browser, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Page, Running, Path, list[str]]]:
    """A window on a studio in which one stroke was painted, and its search is done."""
    directory, complaints = blank(tmp_path_factory.mktemp("studio") / "ball"), []
    with running(directory, "--directory", directory) as studio, window(browser, studio) as page:
        stroke(page, *MIDDLE)
        settled(page)
        yield page, studio, directory, complaints


Painted = tuple["Page", Running, Path, list[str]]


def test_a_stroke_changes_the_field_where_it_was(painted_page: Painted) -> None:
    page, _, directory, _ = painted_page
    state = kept(directory, page)
    seen = Camera.of(*camera(page))
    surface, painting = Surface(state.vertices, state.triangles), Painting(state.vertices, state.triangles)
    diagonal = painting.diagonal
    painting.begin(Brush("pull", 0.08 * diagonal, 0.02 * diagonal, 1.0))
    for t in np.linspace(0.0, 1.0, 60):
        painting.touch(surface.hit(*seen.ray(0.45 + 0.1 * t, 0.5 - 0.02 * t)))
    painting.end()
    assert painting.field.any()
    np.testing.assert_allclose(state.field, painting.field, atol=0.03 * np.abs(painting.field).max())
    hit = surface.hit(*seen.ray(0.5, 0.49))
    assert hit is not None
    row = int(np.linalg.norm(state.vertices - hit.point, axis=1).argmin())
    assert state.field[row] @ painting.normals[row] > 0.01 * diagonal  # outwards, most of the strength


def test_the_front_follows(painted_page: Painted) -> None:
    page, _, _, _ = painted_page
    shown = front(page)
    assert len(shown) > 10
    assert (np.diff(shown[:, 0]) > 0).all()
    assert (np.diff(shown[:, 1]) < 0).all()
    assert f"{len(shown)} setups" in hint(page)
    assert get(page, "progress") == 1
    assert get(page, "busy") is False


def test_a_click_selects_and_keys_walk(painted_page: Painted) -> None:
    page, _, _, _ = painted_page
    shown = front(page)
    page.locator("#front").scroll_into_view_if_needed()
    places = np.array(page.evaluate(
        "(shown) => { const plot = document.querySelector('#front .js-plotly-plot'), f = plot._fullLayout;"
        " const box = plot.getBoundingClientRect();"
        " return shown.map(([x, y]) => [box.x + f._size.l + f.xaxis.d2p(x), box.y + f._size.t + f.yaxis.d2p(y)]); }",
        shown.tolist(),
    ))  # fmt: skip
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    row = 1 + int(np.minimum(steps[:-1], steps[1:]).argmax())  # where no neighbour is clicked in its place
    at = places[row].tolist()
    for _ in range(100):  # a busy browser may draw the plot anew under the mouse
        page.mouse.move(at[0] - 3, at[1])
        page.mouse.move(*at)
        page.wait_for_timeout(200)
        if page.locator(".hoverlayer .hovertext").count():
            break
    page.wait_for_selector(".hoverlayer .hovertext")
    page.mouse.click(*at)
    chosen = until(page, lambda: abs(int(facts(page)["setup"].split()[0]) - 1 - row) <= 3 and facts(page))
    here = int(chosen["setup"].split()[0]) - 1
    assert chosen["regularity R"] == f"{shown[here, 0]:.4g}"
    assert chosen["improvement potential P"] == f"{shown[here, 1]:.4g}"
    page.locator("h1").click()
    for key, expected in (
        ("ArrowRight", here + 1),
        ("ArrowLeft", here),
        ("r", len(shown) - 1),
        ("ArrowRight", len(shown) - 1),
        ("p", 0),
    ):
        page.keyboard.press(key)
        until(page, lambda expected=expected: facts(page)["setup"] == f"{expected + 1} of {len(shown)}")
    page.keyboard.press("k")
    until(page, lambda: facts(page)["setup"] != f"1 of {len(shown)}")
    page.get_by_label("letter keys").uncheck()
    before = facts(page)["setup"]
    page.keyboard.press("r")
    page.wait_for_timeout(400)
    assert facts(page)["setup"] == before
    page.get_by_label("letter keys").check()


def test_a_drag_of_a_handle_deforms(painted_page: Painted) -> None:
    page, _, directory, _ = painted_page
    page.keyboard.press("p")
    page.keyboard.press("g")
    until(page, lambda: get(page, "mode") == "pull" and "largest displacement" in facts(page))
    state = kept(directory, page)
    assert state.chosen == 0
    seen = Camera.of(*camera(page))
    from rbfevo.studio.searching import Search, Task  # with torch

    search = Search(state.vertices, state.triangles, directory / "other.vtp")
    record = search.take(Task(1, state.field, state.held, state.choices, state.centers)).record
    from rbfevo.studio.pulling import Chosen

    shown = Chosen(state.share)

    def farther() -> tuple[int, int]:
        """A setup of the front, and a control point in view whose pull raises the largest displacement."""
        for row in reversed(range(len(state.centers))):
            shown.take(record, float(np.linalg.norm(state.field)), state.centers[row])
            assert shown.shape is not None
            before = shown.shape.look(shown.pulls).farthest
            for center, (x, y) in enumerate(seen.places(shown.places()[0])):
                grip = shown.grip(seen, x, y)
                if grip is None or grip.center != center or max(abs(x - 0.5), abs(y - 0.5)) > 0.35:
                    continue
                shown.drag(grip, x + 0.03, y - 0.06)
                after = shown.shape.look(shown.pulls).farthest
                shown.let_go()
                if after > 1.05 * before:
                    return row, center
        raise AssertionError("no pull has an effect")

    row, center = farther()
    page.locator("h1").click()
    page.keyboard.press("r")
    for place_on_front in range(len(state.centers), row, -1):
        until(page, lambda at=place_on_front: facts(page)["setup"].startswith(f"{at} of "))
        if place_on_front > row + 1:
            page.keyboard.press("ArrowLeft")
    before = facts(page)
    x, y = seen.places(shown.places()[0])[center]
    stroke(page, (x, y), (x + 0.03, y - 0.06))
    after = until(page, lambda: facts(page) if facts(page) != before else None)
    assert float(after["largest displacement"].split()[0]) > float(before["largest displacement"].split()[0])
    moved = kept(directory, page).moved
    until(page, lambda: get(page, "pulled"))
    page.wait_for_timeout(3500)
    moved = keeping.kept(directory).moved  # pyright: ignore[reportOptionalMemberAccess]
    assert np.count_nonzero(moved.any(axis=1)) == 1
    pulled = int(np.flatnonzero(moved.any(axis=1))[0])
    old = shown.places()[0][pulled]
    expected = seen.dragged(old, *(seen.places(old[None])[0] + (0.03, -0.06))) - old
    np.testing.assert_allclose(moved[pulled], expected, atol=0.03 * float(np.linalg.norm(expected)))
    page.get_by_role("button", name="Let go of all").click()
    until(page, lambda: facts(page) == before)


def test_the_slider_says_how_far(painted_page: Painted) -> None:
    page, _, _, _ = painted_page
    page.keyboard.press("g")
    until(page, lambda: facts(page).get("largest displacement"))

    def farthest() -> float:
        """The largest displacement that the page shows."""
        return float(facts(page)["largest displacement"].split()[0])

    full = farthest()
    for share in (50, 100, 200, 0, 100):
        page.get_by_label("How far").fill(str(share))
        page.wait_for_timeout(1500)
        assert farthest() == pytest.approx(share / 100 * full, rel=2e-3)


def test_beside_the_surface_the_view_turns(painted_page: Painted) -> None:
    page, _, _, _ = painted_page
    page.keyboard.press("b")
    until(page, lambda: get(page, "mode") == "paint")
    before, line = camera(page)[0], hint(page)
    stroke(page, (0.05, 0.9), (0.2, 0.8))
    until(page, lambda: not np.allclose(camera(page)[0]["position"], before["position"]))
    assert hint(page) == line
    page.keyboard.press("v")
    until(page, lambda: np.allclose(camera(page)[0]["position"], before["position"]))


def test_undo_and_redo(painted_page: Painted) -> None:
    page, _, directory, _ = painted_page
    field = kept(directory, page).field
    page.keyboard.press("Control+z")
    until(page, lambda: not get(page, "painted"))
    assert not kept(directory, page).field.any()
    assert "Nothing is painted" in hint(page)
    page.get_by_role("button", name="Redo").click()
    until(page, lambda: get(page, "painted"))
    settled(page)
    np.testing.assert_array_equal(kept(directory, page).field, field)


def test_two_windows_show_the_same_and_do_not_mix_their_strokes(painted_page: Painted, browser: Browser) -> None:
    page, studio, directory, _ = painted_page
    page.keyboard.press("b")
    with window(browser, studio) as other:
        assert front(other).tolist() == front(page).tolist()
        page.get_by_label("must stay").check()
        until(other, lambda: get(other, "action") == "hold")
        before = kept(directory, page).field
        page.mouse.move(*place(page, 0.35, 0.52))
        page.mouse.down()
        page.mouse.move(*place(page, 0.37, 0.52), steps=3)
        stroke(other, (0.6, 0.5), (0.62, 0.5))  # while the first has its brush on the surface: it turns the view
        page.mouse.move(*place(page, 0.38, 0.52), steps=3)
        page.mouse.up()
        until(other, lambda: settled(other))
        state = kept(directory, page)
        assert state.held.any()
        np.testing.assert_array_equal(state.field, before)
        seen = Camera.of(*camera(page))
        assert seen.places(state.vertices[state.held])[:, 0].max() < 0.5
        page.get_by_label("pull out").check()
        other.keyboard.press("Control+z")
        until(page, lambda: not get(page, "redoable") or True)
        until(other, lambda: get(other, "redoable"))
        assert get(page, "redoable")
    settled(page)


def test_a_stroke_during_a_search_takes_its_place(painted_page: Painted) -> None:
    page, _, directory, _ = painted_page
    page.keyboard.press("b")
    stroke(page, (0.4, 0.45), (0.42, 0.45))
    stroke(page, (0.6, 0.5), (0.62, 0.5))
    settled(page)
    state = kept(directory, page)
    record_of = front(page)
    from rbfevo.studio.searching import Search, Task

    search = Search(state.vertices, state.triangles, directory / "other.vtp")
    record = search.take(Task(1, state.field, state.held, state.choices, state.centers)).record
    np.testing.assert_allclose(record_of[:, 0], record.regularity, rtol=1e-8)
    np.testing.assert_allclose(record_of[:, 1], record.improvement_potential, rtol=1e-8)


def test_choices_change_what_is_searched(painted_page: Painted) -> None:
    page, _, directory, _ = painted_page
    typed(page, "Control points", "3")
    until(page, lambda: get(page, "busy"))
    settled(page)
    page.get_by_label("Kernel").select_option("gaussian")
    until(page, lambda: get(page, "length") == "Scale")
    until(page, lambda: get(page, "busy"))
    settled(page)
    vertices = kept(directory, page).vertices
    sides = np.ptp(vertices, axis=0)
    support = 0.15 * np.linalg.norm(sides + 0.1 * np.linalg.norm(sides))  # of the box, 5 % wider on each side
    assert get(page, "kernel_length") == f"{support / 2:.4g}"  # of a Gaussian: half of it
    typed(page, "Scale", "nonsense")
    until(page, lambda: "give numbers" in problem(page))
    typed(page, "Scale", "0.5")
    until(page, lambda: problem(page) == "")
    settled(page)
    state = kept(directory, page)
    assert state.choices == Choices(kernel="gaussian", radius=0.5, centers=3)
    assert state.centers.shape[1:] == (3, 3)
    page.get_by_label("Kernel").select_option("wendland")
    typed(page, "Control points", "5000")
    until(page, lambda: "5000" in problem(page))
    typed(page, "Control points", "4")
    until(page, lambda: problem(page) == "")
    settled(page)


def test_save_and_open_again(painted_page: Painted, browser: Browser, tmp_path: Path) -> None:
    page, _, directory, _ = painted_page
    page.keyboard.press("k")
    shown, state = front(page), kept(directory, page)
    saved_as(page, tmp_path / "saved")
    record = read(tmp_path / "saved")
    np.testing.assert_allclose(record.regularity, shown[:, 0], rtol=1e-8)
    assert (tmp_path / "saved" / "report.html").exists()
    assert [str(line).split()[:3] for line in get(page, "commands")] == [["python", "-m", "rbfevo"]] * 2
    with (
        running(tmp_path / "saved", "--directory", tmp_path / "work") as studio,
        window(browser, studio) as again,
    ):
        until(again, lambda: len(front(again)))
        first = front(again)
        np.testing.assert_allclose(first[[0, -1]], shown[[0, -1]], rtol=0.2)
        settled(again)
        assert front(again)[:, 0].max() >= shown[:, 0].max() - 1e-9
        assert front(again)[:, 1].max() >= shown[:, 1].max() - 1e-9
        for name in ("radius", "strength", "action", "kernel", "centers", "manipulation", "symmetry", "share"):
            assert get(again, name) == get(page, name), name
        other = kept(tmp_path / "work", again)
    np.testing.assert_array_equal(other.field, state.field)
    np.testing.assert_array_equal(other.held, state.held)


def test_no_serious_violation_of_accessibility(painted_page: Painted) -> None:
    assert serious(painted_page[0]) == []


def test_all_but_painting_can_be_done_with_the_keyboard(painted_page: Painted) -> None:
    page, _, _, _ = painted_page
    page.locator("h1").click()
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(
            page.evaluate("() => document.activeElement.labels?.[0]?.innerText || document.activeElement.innerText")
        )
    names = " ".join(str(name) for name in reached)
    for name in (
        *("Undo", "Keys", "Paint", "Handles", "Radius", "Strength", "Direction", "Symmetry", "Kernel", "Manipulation"),
        *("Control points", "How far", "Directory", "Save", "Export", "Knee", "Best R"),
    ):
        assert name in names, name
    page.keyboard.press("?")
    page.wait_for_selector("dialog[open]")
    page.keyboard.press("Escape")


# The program


def test_a_killed_studio_offers_what_it_kept(browser: Browser, tmp_path: Path) -> None:
    mesh = painted.mesh_file(tmp_path / "ball.vtp")
    directory = tmp_path / "kept"
    with running(mesh, "--directory", directory) as studio:
        with window(browser, studio, []) as page:
            typed(page, "Control points", "3")
            stroke(page, *MIDDLE)
            settled(page)
            before, shown = kept(directory, page), front(page)
        studio.process.kill()
        assert studio.stop() == -signal.SIGKILL
    with running(mesh, "--directory", directory) as studio:
        with window(browser, studio) as page:
            page.get_by_role("button", name="Go on with it").click()
            settled(page)
            assert not get(page, "offer")
            assert front(page)[:, 1].max() >= shown[:, 1].max() - 1e-9
            np.testing.assert_array_equal(kept(directory, page).field, before.field)
            page.keyboard.press("p")
            until(page, lambda: facts(page)["setup"].startswith("1 of "))
            for name, made in (("Export", "exported: "), ("Apply", "written: ")):
                page.get_by_role("button", name=name).click()
                until(page, lambda made=made: str(get(page, "written")).startswith(made) or problem(page))
                assert problem(page) == ""
            with opened_mesh(directory / "run" / "deformed.vtp") as deformed:
                moved = np.linalg.norm(deformed.points - before.vertices, axis=1).max()
            page.keyboard.press("g")
            until(page, lambda: "largest displacement" in facts(page))
            assert facts(page)["largest displacement"].split()[0] == f"{moved:.4g}"
        assert studio.stop(signal.SIGTERM) == 143
    with running(mesh, "--directory", directory) as studio:
        with window(browser, studio) as page:
            until(page, lambda: get(page, "offer"))
            page.get_by_label("Start from").select_option("sensitivity")  # paints anew: the kept one is put aside
            until(page, lambda: get(page, "painted"))
            until(page, lambda: not get(page, "offer"))
            field = kept(directory, page).field
            vertices, triangles = painted.ball()
            nothing = np.zeros_like(vertices), np.zeros(len(vertices), bool)
            write_mesh(tmp_path / "target.vtp", vertices + np.array([0.0, 0.0, 0.02]), triangles, *nothing)
            typed(page, "Target shape", str(tmp_path / "none.vtp"))
            until(page, lambda: "no such file" in problem(page))
            typed(page, "Target shape", str(tmp_path / "target.vtp"))
            until(page, lambda: get(page, "target") == "")
            to_target = kept(directory, page).field
        assert studio.stop(signal.SIGINT) == 130
    assert (directory / "studio-1.npz").exists()
    normals = Painting(before.vertices, before.triangles).normals
    expected = painted.bump(before.vertices, (0.5, 0.0, 0.3))[:, 2:] * normals
    np.testing.assert_allclose(field, expected, atol=1e-12)
    shares = np.array([(i, j, 20 - i - j) for i in range(21) for j in range(21 - i)]) / 20.0
    target = (before.vertices + np.array([0.0, 0.0, 0.02]))[before.triangles]
    points = np.einsum("sc,fcd->fsd", shares, target).reshape(-1, 3)  # a fine grid on each triangle of the target
    away = KDTree(points).query(before.vertices)[0]
    closest = np.linalg.norm(to_target, axis=1)
    assert (closest < away + 1e-9).all()
    assert (away - closest).max() < 5e-3
    assert (away - closest)[closest > 0.01].max() < 1.2e-3
    assert np.abs(to_target).max() > 0.015


def test_who_has_no_token_or_comes_from_elsewhere_is_refused(tmp_path: Path) -> None:
    with running("--directory", tmp_path / "kept") as studio:
        host, port = studio.origin.removeprefix("http://").split(":")

        def status(path: str, **headers: str) -> int:
            """What a request is answered with."""
            connection = http.client.HTTPConnection(host, int(port), timeout=30)
            connection.putrequest("GET", path, skip_host="Host" in headers)
            for name, value in headers.items():
                connection.putheader(name.replace("_", "-"), value)
            connection.endheaders()
            answer = connection.getresponse()
            answer.read()
            connection.close()
            return answer.status

        upgrade = {
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec_WebSocket_Version": "13",
            "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
        }
        page, token = f"/index.html?token={studio.token}", f"?token={studio.token}"
        assert status(page) == 200
        assert status("/index.html") == 403
        assert status("/index.html?token=wrong") == 403
        assert status("/rbfevo_studio/studio.js") == 403
        assert status("/rbfevo_studio/studio.js", Cookie=f"rbfevo-studio-{port}={studio.token}") == 200
        assert status(page, Host=f"localhost:{port}") == 200
        assert status(page, Host=f"evil.example:{port}") == 403
        assert status(page, Origin="http://evil.example") == 403
        assert status(page, Origin=f"http://{host}:{port}") == 200
        assert status(f"/ws{token}", **upgrade) == 403  # a browser always sends an origin
        assert status(f"/ws{token}", **upgrade, Origin="http://evil.example") == 403
        assert status("/ws", **upgrade, Origin=studio.origin) == 403
        connection = http.client.HTTPConnection(host, int(port), timeout=30)
        connection.request("GET", f"/ws{token}", headers={
            **{name.replace("_", "-"): value for name, value in upgrade.items()}, "Origin": studio.origin,
        })  # fmt: skip
        assert connection.getresponse().status == 101
        connection.close()
        listening = subprocess.run(["ss", "-ltn"], capture_output=True, text=True, check=False).stdout
        assert not listening or f"127.0.0.1:{port}" in listening


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mesh.txt"], "unknown ending"),
        (["none.stl"], "no such file"),
        (["empty"], "setups.npz"),
        (["mesh.vtp", "--port", "99999"], "--port 99999: give a number from 0"),
        (["mesh.vtp", "--patch", "wing"], "wing"),
        (["mesh.vtp", "--directory", "other"], "keeps a painting of another surface"),
    ],
)
def test_a_mistake_is_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    painted.mesh_file(tmp_path / "mesh.vtp", 1)
    (tmp_path / "mesh.txt").write_text("no mesh")
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    keeping.keep(tmp_path / "other", painted.state())
    command = [sys.executable, "-m", "rbfevo.studio", *arguments]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False, env=os.environ
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("rbfevo.studio: ")
    assert message in done.stderr


@pytest.mark.slow
def test_a_mesh_of_many_vertices(browser: Browser, tmp_path: Path) -> None:
    mesh = painted.mesh_file(tmp_path / "big.vtp", 7)  # 163,842 vertices
    with running(mesh, "--directory", tmp_path / "kept") as studio, window(browser, studio) as page:
        stroke(page, *MIDDLE, steps=2)
        until(page, lambda: len(front(page)), 300.0)
        until(page, lambda: hint(page).startswith("Done"), 900.0)
        assert problem(page) == ""
        state = kept(tmp_path / "kept", page)
        assert len(state.vertices) == 163_842
        assert state.field.any()
