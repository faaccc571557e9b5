"""Settings of every test session: two threads for torch, one for NumPy, and no clock in what passes."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is first imported; more crawl on a busy machine

import hypothesis
import torch


def pytest_configure() -> None:
    torch.set_num_threads(2)
    hypothesis.settings.register_profile("rbfevo", deadline=None, derandomize=True)
    hypothesis.settings.load_profile("rbfevo")
