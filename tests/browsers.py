"""A real browser without a window, for the tests of report.html; they skip, with the reason, where there is none."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge")
ARGUMENTS = (
    *("--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--disable-quic", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL by software
)
WINDOW = {"width": 1400, "height": 900}
HARMLESS = "willReadFrequently"  # advice of Chromium to the plotting library


def executable() -> str | None:
    """The browser to use: RBFEVO_BROWSER, or the first of NAMES that is installed."""
    path = os.environ.get("RBFEVO_BROWSER")
    return path or next((found for name in NAMES if (found := shutil.which(name))), None)


def started() -> Iterator[Browser]:
    """A browser, until the last test is done."""
    path = executable()
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed, and RBFEVO_BROWSER is not set")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        except api.Error as error:
            pytest.skip(f"{path} does not start: {str(error).splitlines()[0]}")
        yield browser
        browser.close()


@contextlib.contextmanager
def opened(browser: Browser, file: Path, place: str = "", **options: Any) -> Iterator[Page]:
    """The page in `file`, ready; that it neither complained nor asked for anything else is checked at the end."""
    options.setdefault("viewport", WINDOW)
    context = browser.new_context(offline=True, **options)
    complaints: list[str] = []
    try:
        page = context.new_page()
        page.set_default_timeout(180_000)  # on a busy machine
        page.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: complaints.append(f"error: {error}"))
        page.on("request", lambda request: complaints.append(f"request: {request.url}"))
        page.goto(file.as_uri() + place)
        page.wait_for_selector("html[data-ready]")
        page.wait_for_selector("#space-a canvas")
        yield page
        own = f"request: {file.as_uri()}"
        wrong = [
            line
            for line in complaints
            if HARMLESS not in line and not line.startswith((own, "request: data:", "request: blob:"))
        ]
        if wrong:
            raise AssertionError(f"the page complained: {wrong}")
    finally:
        context.close()


def serious(page: Page) -> list[tuple[str, list[str]]]:
    """The serious and critical violations of accessibility that axe-core finds on a page, and where they are."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe is not installed").Axe()
    return [
        (violation["id"], [node["html"][:120] for node in violation["nodes"]])
        for violation in axe.run(page).response["violations"]
        if violation["impact"] in ("serious", "critical")
    ]


def settled(page: Page) -> None:
    """Wait until the views show what was chosen last."""
    for _ in range(2):
        page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done)))")


def chosen(page: Page) -> int:
    """The row that is chosen."""
    return int(page.evaluate("() => rbfevo.state.chosen.row"))


def hovered(page: Page, regularity: float, potential: float) -> tuple[float, float]:
    """Put the mouse on a setup of the front until its label shows; return the place, pixels."""
    page.evaluate("() => scrollTo(0, 0)")
    place = page.evaluate(
        "([R, P]) => { const plot = document.getElementById('front'), box = plot.getBoundingClientRect();"
        " const full = plot._fullLayout;"
        " return [box.x + full._size.l + full.xaxis.d2p(R), box.y + full._size.t + full.yaxis.d2p(P)]; }",
        [regularity, potential],
    )
    page.mouse.move(place[0] - 2, place[1])
    page.mouse.move(*place)
    page.wait_for_selector(".hoverlayer .hovertext")
    return place[0], place[1]
