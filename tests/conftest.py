"""Settings of every test session: one thread for torch and NumPy, and no clock in what passes."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is first imported

import hypothesis
import pytest
import torch


def pytest_configure() -> None:
    hypothesis.settings.register_profile("rbfevo", deadline=None, derandomize=True)
    hypothesis.settings.load_profile("rbfevo")


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Start every test with one thread, whatever the one before has set."""
    torch.set_num_threads(1)
