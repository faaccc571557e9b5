"""report.html of runs with several objectives, in a browser: which one is shown, its residual, and what setups are.

As in `test_report_page.py` every page also fails if it writes to the console, raises, or asks for anything (`opened`).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from browsers import chosen, hovered, opened, settled

from rbfevo import collect
from rbfevo.figures import __main__ as figures
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from tests import several

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SEARCH = ["method=nsga2", "method.population=24", "method.generations=4", "centers=4"]
SEVERAL = {"mean": ["scenario.objective_weights=[2,1]"], "worst": ["scenario.combine=worst"]}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory of three runs: `mean` and `worst` of two objectives, `alone` of the first of them."""
    template, directory = several.eggs(tmp_path_factory.mktemp("egg")), tmp_path_factory.mktemp("runs")
    for name, more in SEVERAL.items():
        several.searched(directory / name, template, *SEARCH, *more)
    several.searched(directory / "alone", template, *SEARCH, names=("s",))
    return directory


@pytest.fixture(scope="module")
def record(runs: Path) -> Record:
    return read(runs / "mean")


@pytest.fixture(scope="module")
def page(browser: Browser, runs: Path) -> Iterator[Page]:
    assert figures.main([str(runs / "mean"), "--only", "report"]) == 0
    with opened(browser, runs / "mean" / "report.html") as made:
        yield made


def text(page: Page, selector: str) -> str:
    return page.text_content(selector) or ""


def colours(page: Page, what: str) -> np.ndarray:
    page.check(f'input[name="color"][value="{what}"]')
    settled(page)
    return np.array(page.evaluate("() => Array.from(document.getElementById('space-a').data[0].intensity)"))


def left(record: Record, row: int, index: int) -> np.ndarray:
    """Lengths [n] of what is left of an objective's field, by plain least squares."""
    if record.gradients is None:
        raise AssertionError("one objective")
    g, roots = record.gradients[index], np.sqrt(record.weights)[:, None]
    remaining = g.copy()
    for components, U in several.blocks(record, record.centers[row]):
        weights = np.linalg.lstsq(roots * U, roots * g[:, components], rcond=None)[0]
        remaining[:, components] -= U @ weights
    return np.linalg.norm(remaining, axis=1)


def test_radio_buttons_and_a_key_switch_what_is_wanted_and_what_is_left(page: Page, record: Record) -> None:
    assert record.gradients is not None
    assert record.potentials is not None
    assert page.locator("#objective-choices label").all_text_contents() == [" s", " lift"]
    row = int(record.front[-1])
    page.evaluate("(row) => { location.hash = `#setup=${row}`; }", row)
    page.wait_for_function("(row) => rbfevo.state.chosen.row === row", arg=row)
    for step, index in enumerate((0, 1, 0)):
        if step == 1:
            page.check('input[name="objective"][value="1"]')
        if step == 2:
            page.keyboard.press("n")
        settled(page)
        assert page.is_checked(f'input[name="objective"][value="{index}"]')
        np.testing.assert_allclose(colours(page, "wanted"), np.linalg.norm(record.gradients[index], axis=1), atol=1e-7)
        np.testing.assert_allclose(colours(page, "left"), left(record, row, index), atol=1e-6)
        found = page.evaluate("() => rbfevo.leftOf(rbfevo.state.chosen, rbfevo.state.mesh).potential")
        assert found == pytest.approx(record.potentials[row, index], abs=1e-9)
    assert abs(record.potentials[row, 0] - record.potentials[row, 1]) > 0.01  # neither is taken for the other


def test_the_address_remembers_the_objective(browser: Browser, runs: Path, record: Record) -> None:
    row = int(record.front[0])
    with opened(browser, runs / "mean" / "report.html", f"#setup={row}&objective=lift") as page:
        assert chosen(page) == row
        assert page.is_checked('input[name="objective"][value="1"]')
        page.keyboard.press("n")
        settled(page)
        assert "objective=" not in page.evaluate("() => location.hash")
        page.keyboard.press("n")
        settled(page)
        assert page.evaluate("() => location.hash").endswith("&objective=lift")


def test_setups_show_the_potential_of_each(page: Page, record: Record) -> None:
    assert record.potentials is not None
    page.keyboard.press("k")
    settled(page)
    row = pick(record, "knee")
    assert chosen(page) == row
    each = [float(f"{value:.4g}") for value in record.potentials[row]]
    assert f"(s {each[0]}, lift {each[1]})" in text(page, "#caption-a")
    hovered(page, record.regularity[row], record.potential[row])
    shown = text(page, ".hoverlayer")
    assert f"s {each[0]} · lift {each[1]}" in shown
    gains = [float(f"{100 * np.sqrt(value):.3g}") for value in record.potentials[row]]
    assert f"s {gains[0]:g} %, lift {gains[1]:g} %" in text(page, "#cards")
    heads = [head.rstrip(" ↓↑") for head in page.locator("#setups thead th").all_text_contents()]
    column = heads.index("P lift")
    page.click('#setups button[data-key="objective-1"]')
    settled(page)
    cells = page.locator(f"#setups tbody tr td:nth-child({column + 1})").all_text_contents()
    best = np.sort(record.potentials[record.usable, 1])[::-1][: len(cells)]
    assert [float(cell) for cell in cells] == [float(f"{value:.4g}") for value in best]


def test_a_sweep_shows_each_run_with_its_own_objectives(browser: Browser, runs: Path) -> None:
    assert collect.main([str(runs)]) == 0
    with opened(browser, runs / "report.html") as page:
        names = page.locator("#filter-mesh option").all_text_contents()
        assert len(names) == 3  # the mean and the least are not compared, nor several with one
        seen = set()
        for index in range(3):
            page.select_option("#filter-mesh", str(index))
            page.wait_for_function("(index) => rbfevo.state.meshIndex === index", arg=index)
            settled(page)
            (name,) = set(page.evaluate("() => rbfevo.state.visible.map((setup) => setup.run.name)"))
            seen.add(name)
            record = read(runs / name)
            assert page.evaluate("() => rbfevo.state.front.map((setup) => setup.row)") == record.front.tolist()
            assert page.evaluate("() => rbfevo.state.knee.row") == pick(record, "knee")
            assert page.evaluate("() => rbfevo.state.visible.map((setup) => setup.P)") == pytest.approx(
                record.potential[record.usable].tolist(), abs=1e-12
            )
            assert record.potential_name in text(page, "#front .ytitle")
            assert page.is_visible("#objectives") == (name != "alone")
            heads = " ".join(page.locator("#setups thead th").all_text_contents())
            assert ("P lift" in heads) == (name != "alone")
            if name != "alone":
                assert record.potentials is not None
                for other in (0, 1):
                    page.check(f'input[name="objective"][value="{other}"]')
                    settled(page)
                    row = chosen(page)
                    found = page.evaluate("() => rbfevo.leftOf(rbfevo.state.chosen, rbfevo.state.mesh).potential")
                    assert found == pytest.approx(record.potentials[row, other], abs=1e-6)
        assert seen == {"mean", "worst", "alone"}
