"""Settings of every test session: one thread for torch and NumPy, and no clock in what passes."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is first imported

from collections.abc import Iterator
from typing import TYPE_CHECKING

import browsers
import hypothesis
import pytest
import torch

if TYPE_CHECKING:
    from playwright.sync_api import Browser


def pytest_configure() -> None:
    hypothesis.settings.register_profile("rbfevo", deadline=None, derandomize=True)
    hypothesis.settings.load_profile("rbfevo")


@pytest.fixture(autouse=True)
def threads() -> None:
    """Start every test with one thread, or with RBFEVO_TEST_THREADS, whatever the one before has set."""
    torch.set_num_threads(int(os.environ.get("RBFEVO_TEST_THREADS", "1")))


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    """A browser without a window; tests that want one skip where there is none."""
    yield from browsers.started()
