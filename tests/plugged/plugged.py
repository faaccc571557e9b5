"""A kernel, a representation and a search method from outside the package (tests/test_plugins.py)."""

from __future__ import annotations

import json
import os
import time
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rbfevo.methods.method import Method, Problem, Rows, no_preference, unscored
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.representations import Representation, Space


class Bell(Kernel):
    name = "bell"
    positive_definite = True

    def __init__(self, width: float) -> None:
        self.width = width

    def numbers(self) -> dict[str, float]:
        return {"width": self.width}

    def phi(self, r: Any) -> Any:
        xp: Any = np if isinstance(r, np.ndarray) else torch
        return xp.exp(-((r / self.width) ** 2))

    def slope(self, r: Any) -> Any:
        return -2.0 / self.width**2 * self.phi(r)


def bell(dimension: int, default_support: float, diagonal: float, width: float = 0.3) -> Kernel:
    return Bell(width)


class Modes(Representation):
    """Waves cos(k_j x + a_j) of the wave vectors k in a file; a setup is the phases a [m]."""

    name = "modes"

    def __init__(self, file: str) -> None:
        self.file = file
        self.waves = np.load(file)
        self.shape = (len(self.waves),)

    def phi(self, points: Any, setups: Any) -> Any:
        xp: Any = np if isinstance(points, np.ndarray) else torch
        waves = self.waves if xp is np else torch.from_numpy(self.waves)
        return xp.cos(points @ waves.T + setups[..., None, :])

    def columns(self, setups: Any) -> int:
        return len(self.waves)

    def spec(self) -> dict[str, Any]:
        return {"target": "plugged.Modes", "file": self.file}

    def space(self, scenario: Any, centers: int) -> Space:
        lower = torch.zeros(len(self.waves), dtype=torch.float64)

        def sample(count: int, generator: torch.Generator) -> torch.Tensor:
            return 3.0 * torch.rand(count, len(lower), generator=generator, dtype=torch.float64)

        return Space(lower, lower + 3.0, sample, lambda points: points, lambda points, gradient: gradient)


def modes(scenario: Any, kernel: Kernel, centers: int, file: str) -> Modes:
    return Modes(file)


class Walk(Method):
    """Random steps from the best initial setups, each kept where R + P rises."""

    name = "walk"

    def __init__(self, population: int = 8, generations: int = 5) -> None:
        self.population = self.initial = population
        self.steps = generations

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        return self.population * self.steps

    def start(self, problem: Problem) -> None:
        self.problem, self.generator = problem, problem.stream("walk")
        self.genotypes = problem.initial.centers.flatten(1)
        self.objectives = problem.initial.scores.objectives

    def step(self) -> None:
        lower, upper = self.problem.flat_box
        noise = torch.randn(self.genotypes.shape, generator=self.generator, dtype=torch.float64)
        trial = (self.genotypes + 0.05 * (upper - lower) * noise).clamp(lower, upper)
        found = self.problem.evaluate(self.problem.unflatten(trial)).objectives
        better = found.sum(1) > self.objectives.sum(1)
        self.genotypes = torch.where(better[:, None], trial, self.genotypes)
        self.objectives = torch.where(better[:, None], found, self.objectives)

    def rows(self) -> list[Rows]:
        centers = self.problem.unflatten(self.genotypes)
        return [no_preference(self.name, centers, unscored(centers, self.objectives))]

    def state_dict(self) -> dict[str, Any]:
        return {"genotypes": self.genotypes, "objectives": self.objectives, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.genotypes, self.objectives = state["genotypes"], state["objectives"]
        self.generator.set_state(state["generator"])

    def fits(self, steps: int) -> bool:
        """A step does not know how many there will be."""
        return True


def witness(dimension: int, default_support: float, diagonal: float, place: str) -> Kernel:
    """A kernel that writes down which GPU its job sees, and lets others begin meanwhile."""
    time.sleep(2)
    seen = {"gpu": os.environ.get("CUDA_VISIBLE_DEVICES"), "process": os.getpid()}
    Path(place, f"seen-{uuid.uuid4().hex}.json").write_text(json.dumps(seen))
    return Bell(0.3)
