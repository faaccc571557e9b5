"""The cases of the benchmark: a scenario, a kernel, and random setups for them."""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.panels import SUPPORTS
from rbfevo.scenarios import face, plane
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.deformation import MANIPULATIONS
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import Kernel, Wendland, triharmonic

CENTERS = 25
__all__ = ["CENTERS", "MANIPULATIONS", "Case", "cases", "kernel", "scenario"]


class Case(NamedTuple):
    """A scenario and a kernel."""

    scenario: Scenario
    kernel: Kernel

    @property
    def name(self) -> str:
        """Such as `plane, Wendland 0.25`."""
        return f"{self.scenario.name}, {self.kernel_name}"

    @property
    def kernel_name(self) -> str:
        """Such as `Wendland 0.25` or `r^3`."""
        if self.kernel.support is not None:
            return f"Wendland {self.kernel.support:g}"
        return {2: "r^2 log r", 3: "r^3"}[self.scenario.vertices.shape[1]]

    def evaluator(self, manipulation: str) -> Evaluator:
        """The evaluator that a run uses."""
        s = self.scenario
        return Evaluator(s.vertices, s.gradient, self.kernel, manipulation, s.weights)

    def population(self, count: int, m: int = CENTERS, seed: int = 0) -> Tensor:
        """Random setups [count, m, d], drawn like a run's initial population."""
        device = self.scenario.vertices.device
        return self.scenario.sample(count, m, torch.Generator(device).manual_seed(seed))


@functools.cache
def scenario(name: str, resolution: tuple[int, int] = (150, 150)) -> Scenario:
    """The plane, or the built-in face."""
    return plane(resolution) if name == "plane" else face()


def kernel(support: float | None, dimension: int) -> Kernel:
    """Wendland's kernel, or the triharmonic one if `support` is None."""
    return triharmonic(dimension) if support is None else Wendland(support)


def cases(name: str) -> list[Case]:
    """The paper's three kernels on `plane` or `face`."""
    s = scenario(name)
    return [Case(s, kernel(support, s.vertices.shape[1])) for support in (*SUPPORTS[name], None)]
