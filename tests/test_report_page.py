"""report.html in a real browser without a window: clicks, keys, slider, downloads, sizes of the window, darkness.

Every test also fails if the page writes to the console, raises, or asks for anything outside its file (`opened`).
"""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from browsers import WINDOW, chosen, hovered, opened, serious, settled
from PIL import Image
from test_figures import change, write

from rbfevo import collect, export
from rbfevo.figures import __main__ as figures
from rbfevo.figures.local_error import reached
from rbfevo.geometry.holding import Hold
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import read
from rbfevo.scoring import pareto

if TYPE_CHECKING:
    from playwright.sync_api import Page

PHONE = {"width": 360, "height": 740}


def drawn(run: Path) -> Path:
    """report.html of a run."""
    assert figures.main([str(run), "--only", "report"]) == 0
    return run / "report.html"


def scored(run: Path, R: Any, P: Any) -> Path:
    """A run with these scores instead, and the front that they make."""
    objectives = torch.tensor(np.stack([R, P], axis=1))
    return change(run, regularity=R, improvement_potential=P, nondominated=pareto.nondominated(objectives).numpy())


RUNS: dict[str, dict[str, Any]] = {
    "plane": {"d": 2},
    "sphere": {"d": 3},
    "symmetric": {"d": 3, "symmetry": {"axis": "y", "at": 0.0}, "uniform": False, "gradient_is": "direction"},
    "triharmonic": {"d": 3, "kernel": "triharmonic", "uniform": False},
    "thin-plate": {"d": 2, "kernel": "triharmonic"},
    "heights": {"d": 3, "k": 1},
    "cloud": {"d": 3, "faces": False},
}


@pytest.fixture(scope="module")
def run_of(tmp_path_factory):
    """Run directories with their pages, by name."""
    made: dict[str, Path] = {}

    def give(name: str) -> Path:
        if name not in made:
            made[name] = write(tmp_path_factory.mktemp(name) / name, **RUNS[name])
            drawn(made[name])
        return made[name]

    return give


@pytest.fixture(scope="module")
def sphere(browser, run_of) -> Iterator[Page]:
    """The page of the sphere, which many tests share; each begins at the knee, with nothing kept."""
    with opened(browser, run_of("sphere") / "report.html") as page:
        yield page


@pytest.fixture(scope="module")
def shared_plane(browser, run_of) -> Iterator[Page]:
    """The page of the plane, opened at a setup beside another one."""
    with opened(browser, run_of("plane") / "report.html", "#setup=7&kept=11") as page:
        yield page


@pytest.fixture(scope="module")
def symmetric(browser, run_of) -> Iterator[Page]:
    """The page of a symmetric run with a sensitivity."""
    with opened(browser, run_of("symmetric") / "report.html") as page:
        yield page


@pytest.fixture
def plane(shared_plane) -> Page:
    """That page in the usual window, by day."""
    shared_plane.set_viewport_size(WINDOW)
    shared_plane.emulate_media(color_scheme="light")
    shared_plane.evaluate("() => { location.hash = '#setup=7&kept=11'; }")
    shared_plane.wait_for_function("() => rbfevo.state.chosen.row === 7 && rbfevo.state.kept?.row === 11")
    settled(shared_plane)
    return shared_plane


@pytest.fixture
def page(sphere) -> Page:
    """That page as it was at first."""
    if sphere.evaluate("() => rbfevo.state.kept !== null"):
        sphere.keyboard.press("c")
    sphere.evaluate("() => document.activeElement?.blur()")
    sphere.keyboard.press("k")
    for name, value in (("color", "wanted"), ("shape", "template")):
        sphere.check(f'input[name="{name}"][value="{value}"]')
    settled(sphere)
    sphere.evaluate("() => document.activeElement?.blur()")
    return sphere


def wait_for_row(page: Page, row: int) -> None:
    page.wait_for_function("(row) => rbfevo.state.chosen.row === row", arg=row)


# --- what it computes ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def everything(browser, tmp_path_factory) -> Iterator[tuple[Page, dict[str, Path]]]:
    """One page of all kinds of runs, each on a mesh of its own, as a sweep's page."""
    directory = tmp_path_factory.mktemp("everything")
    runs = {name: write(directory / name, **settings) for name, settings in RUNS.items()}

    def spoiled(centers):
        centers = centers.copy()
        centers[0, 1] = centers[0, 0]
        centers[9, 2] = 50.0
        centers[17, 1] = centers[17, 0] + 1e-9
        return centers

    runs["spoiled"] = change(write(directory / "spoiled", d=3), centers=spoiled)
    for name, uniform in (("held", True), ("held and weighted", False)):
        runs[name] = write(directory / name, d=3, uniform=uniform, hold_width=0.5)
        with np.load(runs[name] / "scenario.npz") as archive:
            vertices = archive["vertices"]
        held = vertices[vertices[:, 0] > 0.8]
        change(runs[name], "scenario.npz", held=held, blend=Hold(held, 0.5)(vertices))
    assert collect.main([str(directory)]) == 0
    with opened(browser, directory / "report.html") as page:
        yield page, runs


@pytest.mark.parametrize("name", [*RUNS, "spoiled", "held", "held and weighted"])
def test_what_a_setup_leaves_is_what_numpy_says(everything, name):
    page, runs = everything
    record = read(runs[name])
    for row in (0, 9, 17):
        left, potential = page.evaluate(
            "([name, row]) => { const { setups, content } = rbfevo.state;"
            " const setup = setups.find((found) => found.run.name === name && found.row === row);"
            " const found = rbfevo.leftOf(setup, content.meshes[setup.run.mesh]);"
            " return [Array.from(found.left), found.potential]; }",
            [name, row],
        )
        residual = record.gradient - reached(record, row)
        expected = 1 - (record.weights[:, None] * residual**2).sum()
        close = 1e-6 if name == "spoiled" else 1e-9  # two centers 1e-9 apart are told apart by rounding alone
        assert np.abs(np.reshape(left, residual.shape) - residual).max() < close
        assert potential == pytest.approx(expected, abs=close)


def evaluated(page: Page, scores: Any, act: str) -> Any:
    """What the page's own functions make of setups with these scores [p, 2]."""
    return page.evaluate(
        "([scores, flags]) => {"
        " const setups = scores.map(([R, P], index) => ({ R, P, index, nondominated: flags[index] }));"
        f" const front = rbfevo.frontOf(setups, true); return ({act}); }}",
        [np.asarray(scores).tolist(), pareto.nondominated(torch.tensor(scores)).tolist()],
    )


@pytest.mark.parametrize("digits", [1, 16])
def test_picks_are_those_of_the_command_line(page, run_of, digits):
    rng = np.random.default_rng(digits)
    for _ in range(5):
        scores = np.round(rng.uniform(size=(24, 2)), digits)  # one digit: with ties
        front = pareto.nondominated(torch.tensor(scores)).numpy()
        record = dataclasses.replace(
            read(run_of("sphere")), regularity=scores[:, 0], improvement_potential=scores[:, 1], nondominated=front
        )
        assert evaluated(page, scores, "rbfevo.kneeOf(front).index") == pick(record, "knee")
        assert evaluated(page, scores, "front.map((setup) => setup.index)") == record.front.tolist()
        for criterion, order in (("best-regularity", "'R', 'P'"), ("best-improvement-potential", "'P', 'R'")):
            assert evaluated(page, scores, f"rbfevo.bestOf(setups, {order}).index") == pick(record, criterion)
        for preference in (0.0, 0.3, 0.5, 0.81, 1.0):
            found = evaluated(page, scores, f"rbfevo.preferred(setups, {preference}).index")
            assert found == pick(record, f"preference:{preference}")


def test_preferences_of_a_setup_are_those_that_choose_it(page):
    scores = np.random.default_rng(5).uniform(size=(24, 2))
    ranges = evaluated(page, scores, "setups.map((setup) => rbfevo.preferencesOf(setup, setups))")
    assert sum(found is not None for found in ranges) > 2
    for row, found in enumerate(ranges):
        if found is not None:
            for preference in (0.99 * found[0] + 0.01 * found[1], 0.01 * found[0] + 0.99 * found[1]):
                assert evaluated(page, scores, f"rbfevo.preferred(setups, {preference}).index") == row


def test_the_slider_walks_along_the_whole_front(page, run_of):
    record = read(run_of("sphere"))
    front = record.front.tolist()
    for place, row in zip(np.linspace(0, 1, len(front)), front, strict=True):
        page.fill("#preference", str(place))
        assert chosen(page) == row
    assert front[0] == pick(record, "best-improvement-potential")
    assert front[-1] == pick(record, "best-regularity")


def test_the_slider_can_be_that_of_the_command_line(page, run_of):
    record = read(run_of("sphere"))
    page.check("#weighted")
    for preference in (0.0, 0.25, 0.4, 0.5, 0.75, 1.0):
        page.fill("#preference", str(preference))
        assert page.text_content("#preference-value") == f"{preference:.2f}"
        assert chosen(page) == pick(record, f"preference:{preference}")
    page.uncheck("#weighted")


def test_the_slider_says_where_none_of_its_places_leads_to_a_setup(page, run_of):
    page.click('#setups tr[data-index="0"] button')  # dominated
    assert not read(run_of("sphere")).nondominated[0]
    assert page.text_content("#preference-value") == "none"
    page.keyboard.press("r")
    assert page.text_content("#preference-value") == "1.00"
    assert f"row {chosen(page)}, " in (page.get_attribute("#preference", "aria-valuetext") or "")


@pytest.mark.parametrize("digits", [1, 16])
def test_the_page_of_a_sweep_finds_the_front_itself(page, digits):
    scores = np.round(np.random.default_rng(0).uniform(size=(60, 2)), digits)
    found = evaluated(page, scores, "rbfevo.nondominated(setups).map((setup) => setup.index)")
    assert found == np.flatnonzero(pareto.nondominated(torch.tensor(scores)).numpy()).tolist()


# --- choosing --------------------------------------------------------------------------------------------------------


def test_a_click_on_a_setup_shows_its_centers(page, run_of):
    record = read(run_of("sphere"))
    row = int(np.argmin(record.improvement_potential))  # far from all others
    place = hovered(page, record.regularity[row], record.improvement_potential[row])
    assert f"row {row}, " in (page.text_content(".hoverlayer") or "")
    page.mouse.click(*place)
    wait_for_row(page, row)
    settled(page)
    x, y, z = page.evaluate("() => ['x', 'y', 'z'].map((axis) => document.getElementById('space-a').data[1][axis])")
    balls = np.stack([x, y, z], axis=1).reshape(6, -1, 3)
    assert np.abs(balls.mean(axis=1) - record.centers[row]).max() < 0.01
    assert np.allclose(np.ptp(balls, axis=1), np.ptp(balls, axis=1)[0, 0], rtol=0.05)  # round
    assert f"row {row}, " in (page.text_content("#caption-a") or "")


def test_the_arrow_keys_walk_along_the_front(page, run_of):
    front = read(run_of("sphere")).front.tolist()
    page.keyboard.press("p")
    visited = [chosen(page)]
    for row in front[1:]:
        page.keyboard.press("ArrowRight")
        wait_for_row(page, row)
        visited.append(chosen(page))
    assert visited == front
    page.keyboard.press("ArrowRight")
    assert chosen(page) == front[-1]
    page.keyboard.press("ArrowLeft")
    wait_for_row(page, front[-2])
    assert chosen(page) == front[-2]


def test_the_slider_moves_by_the_keyboard(page):
    page.focus("#preference")
    page.keyboard.press("Home")
    assert page.text_content("#preference-value") == "0.00"
    step = float(page.get_attribute("#preference", "step") or 0)
    page.keyboard.press("ArrowRight")
    assert page.text_content("#preference-value") == f"{step:.2f}"
    page.keyboard.press("End")
    assert page.text_content("#preference-value") == "1.00"


def test_everything_can_be_reached_by_the_tab_key(page):
    page.evaluate("() => { document.body.tabIndex = -1; document.body.focus(); }")
    reached_ids = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached_ids.add(page.evaluate("() => ((now) => now.id || now.name || now.dataset.key)(document.activeElement)"))
    controls = "keys-button preference weighted logarithmic best-potential knee best-regularity color shape see-through"
    controls += " keep save-centers save-picture turn-back only-front R P"
    assert reached_ids >= set(controls.split())


def test_no_serious_violation_of_accessibility(page):
    assert serious(page) == []


def test_keys_are_told_and_do_nothing_else_meanwhile(page):
    before = chosen(page)
    page.keyboard.press("?")
    assert page.locator("#keys").is_visible()
    page.keyboard.press("r")
    assert chosen(page) == before
    page.keyboard.press("Escape")
    assert not page.locator("#keys").is_visible()


def test_letters_can_be_ordinary_letters(page):
    before = chosen(page)
    page.keyboard.press("?")
    page.uncheck("#letters")
    page.keyboard.press("Escape")
    page.keyboard.press("r")
    assert chosen(page) == before
    page.click("#keys-button")
    page.check("#letters")
    page.keyboard.press("Escape")
    page.keyboard.press("R")  # as with Caps Lock
    assert chosen(page) != before


def test_no_button_of_the_library_sends_anything_away(page):
    page.hover("#front .nsewdrag")
    titles = page.eval_on_selector_all(".modebar-btn", "(found) => found.map((button) => button.dataset.title)")
    assert set(titles) <= {"Zoom", "Pan", "Reset axes", "Reset"}
    assert titles


def test_a_button_that_copies_has_its_words_back(page):
    for _ in range(2):
        page.click("#copy-bibtex")
    page.wait_for_function("() => document.getElementById('copy-bibtex').textContent === 'Copied'")
    page.wait_for_function("() => document.getElementById('copy-bibtex').textContent !== 'Copied'")
    assert page.text_content("#copy-bibtex") == "Copy"


def test_a_choice_is_told_to_those_who_listen(page):
    page.keyboard.press("r")
    assert (page.text_content("#announce") or "").startswith(f"row {chosen(page)}, ")


def test_a_choice_is_found_again_by_its_address(plane):
    assert chosen(plane) == 7
    assert plane.evaluate("() => rbfevo.state.kept.row") == 11
    assert plane.locator("#space-b canvas").first.is_visible()
    plane.keyboard.press("x")
    assert plane.evaluate("() => location.hash") == "#setup=11&kept=7"


# --- seeing ----------------------------------------------------------------------------------------------------------


def picture(page: Page, selector: str):
    """What a part of the page shows, [height, width, 3]."""
    return np.asarray(Image.open(io.BytesIO(page.locator(selector).screenshot())).convert("RGB")).astype(int)


def red(image) -> int:
    """Pixels of the balls' colour, in any light."""
    return int(((image[..., 0] > 2 * image[..., 1]) & (image[..., 0] > 2 * image[..., 2]) & (image[..., 0] > 90)).sum())


def blue(image) -> int:
    """Pixels of the lower half of the colours."""
    return int((image[..., 2] > image[..., 0] + 40).sum())


def test_the_views_show_centers_on_a_coloured_surface(page):
    image = picture(page, "#space-a")
    assert red(image) > 100
    assert blue(image) > 10_000


def test_the_colours_change_to_what_the_setup_cannot_reach(page):
    before = picture(page, "#space-a")
    page.keyboard.press("e")
    settled(page)
    assert page.is_checked('input[value="left"]')
    values = page.evaluate("() => Array.from(document.getElementById('space-a').data[0].intensity)")
    expected = page.evaluate("() => Array.from(rbfevo.leftOf(rbfevo.state.chosen, rbfevo.state.mesh).norms)")
    assert values == expected
    after = picture(page, "#space-a")
    assert (np.abs(after - before).max(axis=2) > 20).mean() > 0.02
    assert (page.text_content("#scale-high") or "").startswith("≥ ")


def test_the_shape_becomes_what_is_wanted_and_what_is_reached(page, run_of):
    record = read(run_of("sphere"))
    norm = record.gradient_norm or 0.0
    row = chosen(page)
    shapes = {
        "reached": record.vertices + norm * reached(record, row),
        "wanted": record.vertices + norm * record.gradient,
    }
    for name, expected in shapes.items():
        page.keyboard.press("t")
        settled(page)
        xyz = page.evaluate(
            "() => ['x', 'y', 'z'].map((axis) => Array.from(document.getElementById('space-a').data[0][axis]))"
        )
        assert page.is_checked(f'input[name="shape"][value="{name}"]')
        assert np.abs(np.transpose(xyz) - expected).max() < 1e-6  # single precision


def test_two_setups_side_by_side_turn_together(page):
    page.keyboard.press("c")
    page.keyboard.press("r")
    settled(page)
    assert page.evaluate("() => rbfevo.state.kept.row !== rbfevo.state.chosen.row")
    assert red(picture(page, "#space-b")) > 40
    box = page.locator("#space-a canvas").first.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 60, box["y"] + box["height"] / 2 + 10, steps=4)
    page.mouse.up()
    camera = "(which) => JSON.stringify(document.getElementById(`space-${which}`)._fullLayout.scene.camera.eye)"
    page.wait_for_function(f"() => ({camera})('a') === ({camera})('b')")
    turned = page.evaluate(camera, "a")
    page.keyboard.press("v")
    settled(page)
    assert page.evaluate(camera, "a") != turned
    assert page.locator("#cards .card").count() == 2
    page.keyboard.press("c")
    assert not page.locator("#view-b").is_visible()


FITS = """() => ["front", "space-a", "space-b"].every((id) => {
  const box = document.getElementById(id), svg = box.querySelector(".main-svg").getBoundingClientRect();
  return Math.abs(svg.width - box.clientWidth) < 2 && Math.abs(svg.height - box.clientHeight) < 2;
})"""


@pytest.mark.parametrize("window", [PHONE, {"width": 768, "height": 1024}, {"width": 1920, "height": 1080}])
def test_everything_fits_into_the_window(plane, window):
    plane.set_viewport_size(window)
    plane.wait_for_function(FITS)
    assert plane.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
    for plot in ("#front", "#space-a", "#space-b"):
        box = plane.locator(plot).bounding_box()
        assert box is not None
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= window["width"]
        assert 200 < box["height"] <= window["height"]


def luminance(color: str) -> float:
    """Relative luminance of `rgb(...)` (WCAG 2)."""
    parts = np.array([float(part) for part in color[color.index("(") + 1 : -1].split(",")[:3]]) / 255
    return float(np.where(parts <= 0.03928, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_can_be_read_by_day_and_by_night(plane, scheme):
    plane.emulate_media(color_scheme=scheme)
    ink = {"light": "#1c1c1c", "dark": "#ececec"}[scheme]
    plane.wait_for_function("(ink) => document.getElementById('front').layout.font.color === ink", arg=ink)
    paper = plane.evaluate("() => getComputedStyle(document.body).backgroundColor")
    assert (luminance(paper) < 0.1) == (scheme == "dark")
    ground = luminance(plane.evaluate("() => getComputedStyle(document.getElementById('choose')).backgroundColor"))
    color = "(selector) => getComputedStyle(document.querySelector(selector)).color"
    text = [
        plane.evaluate(color, s) for s in ("#title", "#subtitle", "#preference-hint", "#setups td button", "legend")
    ]
    text.append(plane.evaluate("() => getComputedStyle(document.querySelector('#front .xtick text')).fill"))
    for found in map(luminance, text):
        assert (max(found, ground) + 0.05) / (min(found, ground) + 0.05) >= 4.5


# --- the table and the words -----------------------------------------------------------------------------------------


def column(page: Page, title: str) -> list[str]:
    """The cells of a column of the table."""
    titles = [text.split(" ")[0] for text in page.locator("#setups thead th").all_text_contents()]
    return page.locator(f"#setups tbody td:nth-child({titles.index(title) + 1})").all_text_contents()


@pytest.mark.parametrize("title", ["R", "P", "row"])
def test_the_table_sorts_both_ways(page, run_of, title):
    record = read(run_of("sphere"))
    values = {"R": record.regularity, "P": record.improvement_potential, "row": np.arange(24)}[title]
    page.click(f'#setups [data-key="{"method"}"]')
    for _ in range(2):
        page.click(f'#setups [data-key="{title}"]')
        falls = page.get_attribute(f'#setups th:has([data-key="{title}"])', "aria-sort") == "descending"
        rows = [int(row) for row in column(page, "row")]
        assert rows == np.argsort(-values if falls else values, kind="stable").tolist()


def test_the_table_can_show_the_front_alone(page, run_of):
    page.check("#only-front")
    assert sorted(int(row) for row in column(page, "row")) == sorted(read(run_of("sphere")).front.tolist())
    page.uncheck("#only-front")
    assert len(column(page, "row")) == 24


def test_a_row_of_the_table_is_chosen_by_click_and_by_key(page):
    page.click('#setups tr[data-index="5"] td:nth-child(3)')
    wait_for_row(page, 5)
    page.focus('#setups tr[data-index="8"] button')
    page.keyboard.press("Enter")
    wait_for_row(page, 8)
    assert page.get_attribute('#setups tr[data-index="8"]', "aria-current") is not None


def test_words_tell_what_the_scores_mean(page, run_of):
    record = read(run_of("sphere"))
    row = chosen(page)
    text = page.text_content("#cards") or ""
    assert f"{100 * record.improvement_potential[row]:.3g} % of the wanted displacement" in text
    assert f"up to {1 / record.regularity[row]:.3g} times" in text
    assert f"--pick index:{row}" in (page.text_content("#next") or "")


def test_a_sensitivity_has_words_of_its_own(symmetric):
    assert "of the sensitivity" in (symmetric.text_content("#cards") or "")
    assert "rbfevo.fit" not in (symmetric.text_content("#next") or "")
    symmetric.check('input[name="shape"][value="reached"]')
    settled(symmetric)
    assert "not to scale" in (symmetric.text_content("#view-hint") or "")


@pytest.fixture(scope="module")
def odd(browser, tmp_path_factory) -> Iterator[Page]:
    """A run of an unknown kernel with a regularity of 0 among tiny ones, and words that look like HTML."""
    run = tmp_path_factory.mktemp("odd")
    R = np.geomspace(1e-9, 0.5, 24)
    R[3] = 0.0
    scored(write(run, d=3, notes={"template": "car <b>.stl</b>"}, warnings=["too small"]), R, np.linspace(0.9, 0.1, 24))
    summary = json.loads((run / "summary.json").read_text())
    (run / "summary.json").write_text(json.dumps(summary | {"kernel": "gaussian", "versions": {"torch": "2.13.0"}}))
    (run / ".hydra").mkdir()
    (run / ".hydra" / "overrides.yaml").write_text("- scenario=plane\n- seed=3\n")
    with opened(browser, drawn(run), "#setup=3") as page:
        yield page


def test_a_setup_of_regularity_0_is_drawn_and_explained(odd):
    assert odd.is_checked("#logarithmic")
    assert "does not change the design" in (odd.text_content("#cards") or "")
    xs = odd.evaluate(
        "() => document.getElementById('front').data.flatMap((trace) => (trace.customdata ? [...trace.x] : []))"
    )
    assert len(xs) == 24
    assert min(xs) > 0
    assert "R = 0" in (odd.text_content("#front") or "")
    odd.uncheck("#logarithmic")
    assert odd.evaluate("() => document.getElementById('front').layout.xaxis.type") == "linear"


def test_the_slider_goes_with_the_setups_that_are_swapped(page):
    for key in ("p", "c", "r"):
        page.keyboard.press(key)
        settled(page)
    best = page.text_content("#preference-value"), page.text_content("#preference-hint")
    page.keyboard.press("x")
    settled(page)
    other = page.text_content("#preference-value"), page.text_content("#preference-hint")
    assert other != best
    page.keyboard.press("x")
    settled(page)
    assert (page.text_content("#preference-value"), page.text_content("#preference-hint")) == best


def test_an_unknown_kernel_still_shows_its_centers(odd):
    odd.keyboard.press("e")
    settled(odd)
    assert "does not hold the residual" in (odd.text_content("#view-hint") or "")
    assert red(picture(odd, "#space-a")) > 100


def test_how_the_run_was_made_is_told(odd):
    text = odd.text_content("#made") or ""
    for expected in ("python -m rbfevo scenario=plane seed=3", "car <b>.stl</b>", "Warning: too small", "torch 2.13.0"):
        assert expected in text


def test_a_single_setup_has_a_page(browser, tmp_path):
    run = write(tmp_path, methods=("lloyd",))
    with np.load(run / "setups.npz") as archive:
        first: dict[str, Any] = {name: array[:1] for name, array in archive.items()}
    np.savez(run / "setups.npz", **first)
    change(run, nondominated=np.array([True]))
    with opened(browser, drawn(run)) as page:
        for key in ("ArrowLeft", "ArrowRight", "r", "p", "k", "c", "x", "e"):
            page.keyboard.press(key)
            settled(page)
        assert chosen(page) == 0


# --- a sweep ---------------------------------------------------------------------------------------------------------


def test_a_sweep_compares_and_filters_its_runs(browser, tmp_path):
    for number, (kernel, seed) in enumerate(itertools.product(("wendland", "triharmonic"), (0, 1))):
        write(tmp_path / f"50%,{number}", kernel=kernel, seed=seed, methods=("random", "gradient"))
    assert collect.main([str(tmp_path)]) == 0
    with opened(browser, tmp_path / "report.html") as page:
        assert "wendland" in (page.text_content("#sentences") or "")
        groups = page.evaluate("() => rbfevo.state.content.sweep.groups.map((group) => group.label)")
        assert sorted(groups) == ["triharmonic", "wendland"]
        medians = page.evaluate("() => document.getElementById('spread').data[1].x")
        assert sorted(medians) == medians  # the best on top
        assert set(column(page, "run")) <= {f"50%,{number}" for number in range(4)}
        page.select_option('[data-setting="kernel"]', "triharmonic")
        page.wait_for_function("() => rbfevo.state.visible.every((setup) => setup.run.kernel === 'triharmonic')")
        assert set(column(page, "run")) <= {"50%,2", "50%,3"}
        run = read(tmp_path / str(page.evaluate("() => rbfevo.state.chosen.run.name")))
        assert run.summary["kernel"] == "triharmonic"
        page.keyboard.press("p")
        best = max(float(read(tmp_path / name).improvement_potential.max()) for name in ("50%,2", "50%,3"))
        assert page.evaluate("() => rbfevo.state.chosen.P") == best
        page.keyboard.press("c")
        page.select_option('[data-setting="kernel"]', "wendland")
        assert page.evaluate("() => rbfevo.state.kept.run.kernel") == "triharmonic"
        assert page.locator("#view-b").is_visible()
        page.evaluate("() => rbfevo.state.filter('kernel', 'another')")
        assert page.locator("#nothing").is_visible()
        assert not page.locator("#front").is_visible()
        page.evaluate("() => rbfevo.state.filter('kernel', '')")
        assert page.locator("#front").is_visible()
        assert not page.locator("#nothing").is_visible()
        place = page.evaluate("() => location.hash")
        assert "50%25" in place
        page.evaluate("() => { location.hash = '#setup=nothing%20of%20this:1'; }")
        page.evaluate("(place) => { location.hash = place; }", place)
        settled(page)
        page.select_option("#measure", "best_regularity")
        expected = [np.median([read(tmp_path / f"50%,{n}").regularity.max() for n in names]) for names in ("01", "23")]
        assert page.evaluate("() => document.getElementById('spread').data[1].x") == sorted(expected)


def test_a_sweep_over_meshes_shows_one_at_a_time(everything):
    page, runs = everything
    names = page.locator("#filter-mesh option").all_text_contents()
    assert len(names) == len(set(names))
    for index in (0, len(names) - 1):
        page.select_option("#filter-mesh", str(index))
        page.wait_for_function("(index) => rbfevo.state.meshIndex === index", arg=index)
        settled(page)
        vertices = page.evaluate("() => document.getElementById('space-a').data[0].x.length")
        name = page.evaluate("() => rbfevo.state.chosen.run.name")
        assert vertices == len(read(runs[name]).vertices)


# --- downloads -------------------------------------------------------------------------------------------------------


def exported(page: Page, run: Path, row: int, out: Path) -> list[list[str]]:
    """centers.csv of a setup as the page saves it, and as the export writes it."""
    page.evaluate("(row) => { location.hash = `#setup=${row}`; }", row)
    wait_for_row(page, row)
    with page.expect_download() as download:
        page.click("#save-centers")
    assert download.value.suggested_filename == f"row-{row}-centers.csv"
    download.value.save_as(out / "page.csv")
    assert export.main([str(run), "--pick", f"index:{row}", "--out", str(out / "export"), "--quiet"]) == 0
    return [path.read_text().splitlines() for path in (out / "page.csv", out / "export" / "centers.csv")]


def same_numbers(here: list[str], there: list[str]) -> bool:
    ours, theirs = (np.array([line.split(",") for line in table[1:]], float) for table in (here, there))
    return here[0] == there[0] and np.array_equal(ours, theirs)


def test_the_centers_are_those_of_the_export(plane, run_of, tmp_path):
    assert same_numbers(*exported(plane, run_of("plane"), 4, tmp_path))


def test_a_symmetric_setup_shows_its_images(symmetric, run_of):
    record = read(run_of("symmetric"))
    xyz = symmetric.evaluate("() => ['x', 'y', 'z'].map((axis) => document.getElementById('space-a').data[2][axis])")
    images = np.stack(xyz, axis=1).reshape(6, -1, 3).mean(axis=1)
    assert np.abs(images - record.centers[chosen(symmetric)] * [1, -1, 1]).max() < 0.01


def test_images_are_saved_as_the_export_saves_them(symmetric, run_of, tmp_path):
    assert same_numbers(*exported(symmetric, run_of("symmetric"), 4, tmp_path))


def test_the_picture_shows_front_and_centers(page, tmp_path):
    with page.expect_download() as download:
        page.keyboard.press("s")
    assert download.value.suggested_filename == f"row-{chosen(page)}.png"
    download.value.save_as(tmp_path / "page.png")
    image = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
    half = image.shape[1] // 2
    assert image.shape[1] > 2000
    assert red(image[:, half:]) > 400
    assert blue(image[:, :half]) > 500


# --- a browser without WebGL -----------------------------------------------------------------------------------------


def test_without_webgl_the_front_and_the_table_still_work(browser, run_of):
    context = browser.new_context(offline=True)
    page = context.new_page()
    page.add_init_script(
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...more)"
        " { return kind.includes('webgl') ? null : get.call(this, kind, ...more); };"
    )
    page.goto((run_of("sphere") / "report.html").as_uri())
    page.wait_for_selector("html[data-ready]")
    page.keyboard.press("r")
    wait_for_row(page, pick(read(run_of("sphere")), "best-regularity"))
    assert "WebGL" in (page.text_content("#view-hint") or "")
    assert column(page, "row")
    context.close()


# --- far from the origin, and on a phone -----------------------------------------------------------------------------


def test_a_design_far_from_the_origin_on_a_phone(browser, tmp_path):
    """Views have single precision: they draw about the middle. Fingers scroll, the slider is wide, labels are whole."""

    def far(points):
        return points + np.array([1e7, -3e6, 5e5])

    run = write(tmp_path, d=3)
    change(change(run, centers=far), "scenario.npz", vertices=far, lower=far, upper=far)
    record = read(run)
    with opened(browser, drawn(run), viewport=PHONE, has_touch=True, is_mobile=True) as page:
        x, y, z = page.evaluate("() => ['x', 'y', 'z'].map((axis) => document.getElementById('space-a').data[1][axis])")
        middle = (record.vertices.min(axis=0) + record.vertices.max(axis=0)) / 2
        balls = np.stack([x, y, z], axis=1).reshape(6, -1, 3).mean(axis=1)
        assert np.abs(balls + middle - record.centers[chosen(page)]).max() < 0.01
        assert red(picture(page, "#space-a")) > 60
        slider = page.locator("#preference").bounding_box()
        assert slider is not None
        assert slider["width"] > 0.7 * PHONE["width"]
        assert page.locator(".modebar-btn").count() == 0
        actions = page.eval_on_selector_all(
            "#space-a, #space-a *", "(all) => all.map((each) => getComputedStyle(each).touchAction)"
        )
        assert set(actions) <= {"pan-y", "auto"}
        assert page.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
