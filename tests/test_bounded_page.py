"""report.html of runs that search bounded potential, in a browser: what it names, picks and residuals; both norms.

As in `test_report_page.py` every page also fails if it writes to the console, raises, or asks for anything (`opened`).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from browsers import chosen, hovered, opened, settled
from test_mesh_runs import egg

from rbfevo import collect
from rbfevo.__main__ import main
from rbfevo.figures import __main__ as figures
from rbfevo.figures.local_error import reached
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, knee, read

if TYPE_CHECKING:
    from playwright.sync_api import Page

BOUNDED = "bounded potential (p = 16)"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory of two runs, `2` and `16`, that differ in the norm alone."""
    template, directory = egg(tmp_path_factory.mktemp("egg"), subdivisions=2), tmp_path_factory.mktemp("runs")
    fixed = [f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}", "scenario=mesh"]
    fixed += ["evaluator=eager", "quiet=true", "figures=false", "centers=4", "kernel.support=1.5", "method=nsga2"]
    fixed += ["method.population=24", "method.generations=5", "seed=2"]
    for norm in ("2", "16"):
        assert main([f"hydra.run.dir={directory / norm}", f"criterion.norm={norm}", *fixed]) == 0
    return directory


@pytest.fixture(scope="module")
def record(runs: Path) -> Record:
    """The run of bounded potential, whose best setup in P is another one, so that neither is taken for the other."""
    found = read(runs / "16")
    assert found.bounded_potential is not None
    assert found.bounded_potential.argmax() != found.improvement_potential.argmax()
    return found


@pytest.fixture(scope="module")
def page(browser, runs: Path, record: Record) -> Iterator[Page]:
    """Its page."""
    assert figures.main([str(runs / "16"), "--only", "report"]) == 0
    with opened(browser, runs / "16" / "report.html") as made:
        yield made


def text(page: Page, selector: str) -> str:
    return page.text_content(selector) or ""


def test_axis_and_hover_name_the_bounded_potential(page: Page, record: Record) -> None:
    assert BOUNDED in text(page, "#front .ytitle")
    assert (page.get_attribute("#front", "aria-label") or "").startswith("Bounded potential")
    labels = page.evaluate("() => document.getElementById('front').data.flatMap((trace) => trace.text || [])")
    assert len(labels) == len(record.usable)
    assert all("P_16 " in label and "· P " not in label for label in labels)
    row = int(np.argmax(record.potential))
    hovered(page, record.regularity[row], record.potential[row])
    shown = text(page, ".hoverlayer")
    assert f"P_16 {float(f'{record.potential[row]:.4g}')}" in shown
    heads = page.locator("#setups thead th").all_text_contents()
    assert any(head.startswith("P_16") for head in heads)


def test_knee_and_picks_are_those_of_the_recorded_run(page: Page, record: Record) -> None:
    assert page.evaluate("() => rbfevo.state.knee.row") == knee(record) == pick(record, "knee")
    assert page.evaluate("() => rbfevo.state.front.map((setup) => setup.row)") == record.front.tolist()
    for key, choice in (("k", "knee"), ("r", "best-regularity"), ("p", "best-improvement-potential")):
        page.keyboard.press(key)
        settled(page)
        assert chosen(page) == pick(record, choice)
        assert page.evaluate("() => rbfevo.state.chosen.P") == record.potential[chosen(page)]
        assert f"P_16 = {float(f'{record.potential[chosen(page)]:.4g}')}" in text(page, "#caption-a")
    page.check("#weighted")
    for preference in (0.0, 0.25, 0.5, 0.75, 1.0):
        page.fill("#preference", str(preference))
        assert chosen(page) == pick(record, f"preference:{preference}")
    page.uncheck("#weighted")


def test_the_residual_that_is_shown_is_that_of_the_least_squares_fit(page: Page, record: Record) -> None:
    for row in record.front[[0, -1]].tolist():
        page.evaluate("(row) => { location.hash = `#setup=${row}`; }", row)
        page.wait_for_function("(row) => rbfevo.state.chosen.row === row", arg=row)
        page.check('input[name="color"][value="left"]')
        settled(page)
        colours = page.evaluate("() => Array.from(document.getElementById('space-a').data[0].intensity)")
        left = np.linalg.norm(record.gradient - reached(record, row), axis=1)
        np.testing.assert_allclose(colours, left, atol=1e-7)  # single precision
        found = page.evaluate("() => rbfevo.leftOf(rbfevo.state.chosen, rbfevo.state.mesh).potential")
        assert found == pytest.approx(record.improvement_potential[row], abs=1e-9)
        assert 1 - (record.weights * left**2).sum() == pytest.approx(record.improvement_potential[row], abs=1e-9)
        assert abs(found - record.potential[row]) > 0.01
        assert "least-squares fit" in text(page, "#view-hint")
        page.check('input[name="color"][value="wanted"]')
        settled(page)
        assert "least-squares fit" not in text(page, "#view-hint")


def test_words_are_about_the_bounded_step(page: Page, record: Record) -> None:
    page.keyboard.press("k")
    settled(page)
    share = 100 * np.sqrt(record.potential[chosen(page)])
    assert f"gains {share:.3g} % of what a step with all vertices free gains" in text(page, "#cards")
    assert "Bounded potential (p = 16)." in text(page, "#cards")
    page.keyboard.press("c")
    page.keyboard.press("p")
    settled(page)
    ratio = record.potential[chosen(page)] / record.potential[pick(record, "knee")]
    assert f"{float(f'{ratio:.3g}')} times its bounded potential" in text(page, "#next")
    page.keyboard.press("c")


def test_a_sweep_keeps_both_norms_apart(browser, runs: Path) -> None:
    assert collect.main([str(runs)]) == 0
    records = {name: read(runs / name) for name in ("2", "16")}
    with opened(browser, runs / "report.html") as page:
        names = page.locator("#filter-mesh option").all_text_contents()
        assert [BOUNDED in name for name in names] in ([True, False], [False, True])
        assert page.locator("[data-setting]").count() == 0  # nothing else differs
        for index, name in enumerate(names):
            which = "16" if BOUNDED in name else "2"
            record, symbol = records[which], "P_16" if which == "16" else "P"
            page.select_option("#filter-mesh", str(index))
            page.wait_for_function("(index) => rbfevo.state.meshIndex === index", arg=index)
            settled(page)
            assert page.evaluate("() => rbfevo.state.visible.map((setup) => setup.run.name)") == [which] * len(
                record.usable
            )
            assert page.evaluate("() => rbfevo.state.front.map((setup) => setup.row)") == record.front.tolist()
            assert page.evaluate("() => rbfevo.state.knee.row") == pick(record, "knee")
            assert record.potential_name in text(page, "#front .ytitle")
            assert page.locator("#measure option").all_text_contents()[2] == f"best {symbol}"
            page.select_option("#measure", "best_improvement_potential")
            medians = page.evaluate("() => document.getElementById('spread').data[1].x")
            assert medians == [record.potential.max()]
            assert f"best {symbol}" == text(page, "#spread .xtitle")
            assert any(head.startswith(f"best {symbol}") for head in page.locator("#groups th").all_text_contents())
        sentences = page.locator("#sentences li").all_text_contents()
    for which, name in (("2", "improvement potential"), ("16", BOUNDED)):
        best = f"est {name}: {records[which].potential.max():.4g} (1 seed)"
        assert sum(best in sentence for sentence in sentences) == 1
    assert not any("beats" in sentence for sentence in sentences)
