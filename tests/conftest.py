"""Settings of every test session: one thread for torch and NumPy, and no clock in what passes."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is first imported

from collections.abc import Iterator
from typing import TYPE_CHECKING

import browsers
import forked
import hypothesis
import pytest
import torch

if TYPE_CHECKING:
    from playwright.sync_api import Browser


# With two processes (scripts/test) a process takes one file after the other, in this order: files of which a test waits
# or computes for long come first, so that both processes end at about the same time.
FIRST = (
    *("test_studio_page", "test_cluster", "test_report_page", "test_jobs", "test_main", "test_openfoam_examples"),
    *(
        "test_keep",
        "test_step",
        "test_figures",
        "test_evaluator",
        "test_how_many",
        "test_plugins",
        "test_kills",
        "test_docs",
        "test_elastic",
    ),
)


STARTED = ("test_exchange", "test_mesh_files", "test_templates")


def pytest_configure() -> None:
    hypothesis.settings.register_profile("rbfevo", deadline=None, derandomize=True)
    hypothesis.settings.load_profile("rbfevo")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest first."""
    place = {name: number for number, name in enumerate(FIRST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@pytest.fixture(autouse=True)
def threads() -> None:
    """Start every test with one thread, or with RBFEVO_TEST_THREADS, whatever the one before has set."""
    torch.set_num_threads(int(os.environ.get("RBFEVO_TEST_THREADS", "1")))


@pytest.fixture(autouse=True, scope="module")
def worker(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let meshes be read by forks, but in the tests of how the process that reads them is started and ends."""
    with pytest.MonkeyPatch.context() as patch:
        if hasattr(os, "fork") and request.path.stem not in STARTED:
            patch.setattr("rbfevo.meshes.foreign.subprocess", forked.INSTEAD)
        yield


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    """A browser without a window; tests that want one skip where there is none."""
    yield from browsers.started()
