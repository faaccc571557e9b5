"""A running studio, and a browser's window on it, for the tests of its page."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import browsers
import numpy as np

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page

PATIENCE = 120.0  # seconds: on a busy machine
LAUNCHER = "/paraview/"  # which trame's page asks for, where there is none


class Running:
    """A studio in a process of its own."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, "-m", "rbfevo.studio", *map(str, arguments)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )
        self.lines: list[str] = []
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line)
            if found := re.search(r"http://\S+", line):
                self.address = found[0]
                break
        else:
            raise AssertionError(f"the studio did not start: {''.join(self.lines)}")
        self.origin, self.token = self.address.split("/?token=")

    def stop(self, how: signal.Signals = signal.SIGINT) -> int:
        """End the studio; return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        code = self.process.wait(60)
        if self.process.stdout is not None and not self.process.stdout.closed:
            self.lines += self.process.stdout.readlines()
            self.process.stdout.close()
        return code


@contextlib.contextmanager
def running(*arguments: object) -> Iterator[Running]:
    """A studio that runs until the block is done."""
    studio = Running(*arguments)
    try:
        yield studio
    finally:
        studio.stop()


@contextlib.contextmanager
def window(browser: Browser, studio: Running, complaints: list[str] | None = None, **options: Any) -> Iterator[Page]:
    """A window on a studio; that it neither complained nor asked another machine is checked at the end."""
    heard: list[str] = [] if complaints is None else complaints
    context: BrowserContext = browser.new_context(**{"viewport": browsers.WINDOW, **options})
    try:
        page = context.new_page()
        page.set_default_timeout(1000 * PATIENCE)
        page.on("console", lambda message: heard.append(f"{message.type}: {message.text} {message.location['url']}"))
        page.on("pageerror", lambda error: heard.append(f"error: {error}"))
        page.on("request", lambda request: heard.append(f"request: {request.url}"))
        page.goto(studio.address)
        page.wait_for_selector("#stage canvas")
        page.wait_for_function("() => window.trame?.refs?.view?.getCamera")
        yield page
        own = (f"request: {studio.origin}/", "request: data:", "request: blob:", "info: Vue.use")
        wrong = [line for line in heard if not line.startswith(own) and LAUNCHER not in line]
        wrong = [line for line in wrong if browsers.HARMLESS not in line and "GPU stall" not in line]
        assert wrong == [] or complaints is not None, wrong
    finally:
        context.close()


def until(page: Page, true: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """Wait for something to be true, and return it."""
    end = time.monotonic() + patience
    while not (found := true()):
        if time.monotonic() > end:
            raise AssertionError(f"it did not come: {problem(page)!r}, {hint(page)!r}")
        page.wait_for_timeout(50)
    return found


def hint(page: Page) -> str:
    """The line about the search."""
    return str(page.evaluate("() => trame.state.get('searching')"))


def problem(page: Page) -> str:
    """The complaint on the page, if any."""
    return str(page.evaluate("() => trame.state.get('problem')"))


def get(page: Page, name: str) -> Any:
    """A variable of the page."""
    return page.evaluate("(name) => trame.state.get(name)", name)


def settled(page: Page) -> str:
    """Wait until the search is done; return its line."""
    until(page, lambda: hint(page).startswith("Done"))
    return hint(page)


def place(page: Page, x: float, y: float) -> tuple[float, float]:
    """A place on the stage, in pixels of the window: (0, 0) is its upper left corner."""
    box = page.locator("#stage").bounding_box()
    assert box is not None
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def stroke(page: Page, *places: tuple[float, float], steps: int = 5) -> None:
    """Drag the pointer along places on the stage, and wait until the server has heard of all."""
    page.mouse.move(*place(page, *places[0]))
    page.mouse.down()
    for one in places[1:]:
        page.mouse.move(*place(page, *one), steps=steps)
    page.mouse.up()
    page.wait_for_timeout(300)


def camera(page: Page) -> tuple[dict[str, Any], float]:
    """The camera of the view, and width over height."""
    box = page.locator("#stage").bounding_box()
    assert box is not None
    return page.evaluate("() => trame.refs.view.getCamera()"), box["width"] / box["height"]


def front(page: Page) -> np.ndarray:
    """R and P [p, 2] of the front on the page."""
    plotted = page.evaluate("() => { const { x, y } = trame.state.get('front').data[0]; return [x, y]; }")
    return np.array(plotted, np.float64).T


def facts(page: Page) -> dict[str, str]:
    """What the page says of the chosen setup."""
    return dict(get(page, "facts"))


def typed(page: Page, label: str, text: object) -> None:
    """Type into a field and leave it, which is when the page takes it."""
    page.get_by_label(label).fill(str(text))
    page.get_by_label(label).press("Tab")


def saved_as(page: Page, directory: Path) -> None:
    """Save into a directory, and wait until that is done."""
    typed(page, "Directory", directory)
    until(page, lambda: get(page, "directory") == str(directory))
    page.get_by_role("button", name="Save").click()
    until(page, lambda: str(get(page, "written")).startswith("saved") or problem(page))
    assert problem(page) == ""
