"""Gains of setups of one design: nested, optimized and Lloyd's, for some kernels and radii, by number of centers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.advice.choice import Trial
from rbfevo.methods.gradient.lbfgs import LBFGS
from rbfevo.methods.lloyd import lloyd
from rbfevo.methods.method import random_stream
from rbfevo.methods.nested import nested_of
from rbfevo.scenarios.coarse import coarsened
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.fronts import ENOUGH
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.representations import RBF

COARSE = 1500  # weighted vertices on which setups are found
SCORED = 20_000  # weighted vertices, at most, on which they are scored
NARROWEST, WIDEST = 0.08, 0.64  # radii, of the diagonal
EDGES = 3.0  # mean edges: no radius is below that many
SCATTER = 0.05  # of the box: standard deviation of a copy of a setup from which another climb starts
COPIES = 2  # scattered, of each start
CLIMB = 25  # steps
RIVAL = 0.95  # of the best gain with a number: kernels and radii below are not refined
SPREAD = 3  # starts of k-means


class Found(NamedTuple):
    """What one kernel and radius gain.

    Attributes:
        picked: [most, d] the nested sequence; trials: one for each number of centers, from 1 on.
        setups: the best setup [m, d] of each number.
    """

    kernel: Kernel
    picked: Tensor
    trials: list[Trial]
    setups: dict[int, Tensor]


def edge(scenario: Scenario) -> float:
    """The mean edge of the template's triangles, model units; 0 where there are none."""
    faces, vertices = scenario.faces, scenario.vertices
    if not len(faces):
        return 0.0
    return float((vertices[faces] - vertices[faces.roll(1, 1)]).norm(dim=2).mean())


def radii(scenario: Scenario) -> list[float]:
    """Support radii to try, model units: steps of sqrt(2) between two shares of the diagonal, none near the edges."""
    count = round(2.0 * math.log2(WIDEST / NARROWEST)) + 1
    tried = [NARROWEST * scenario.diagonal * 2.0 ** (0.5 * i) for i in range(count)]
    return [radius for radius in tried if radius >= EDGES * edge(scenario)] or tried[-1:]


def numbers(most: int) -> tuple[list[int], list[int]]:
    """Numbers of centers up to the most: those of Lloyd's setups, and those of optimized ones among them."""
    climbed = sorted({max(1, -(-most // 4)), max(1, -(-most // 2)), most})
    doubled = {base * 2**i for base in (1, 3) for i in range(most.bit_length()) if base * 2**i <= most}
    return sorted(doubled | set(climbed)), climbed


class Study:
    """Trials of one design.

    Args:
        scenario: the design, with its wanted displacement smoothed as it is to be; norm: p of the bound.
        most: centers of the largest setups; seed: of scattered copies and Lloyd's starts.
    """

    def __init__(self, scenario: Scenario, norm: float, most: int, seed: int = 0) -> None:
        self.scenario, self.norm, self.most, self.seed = scenario, norm, most, seed
        self.coarse, self.scored = coarsened(scenario, COARSE), coarsened(scenario, SCORED)
        self.spread_numbers, self.climbed_numbers = numbers(most)
        self._spreads: dict[int, Tensor] = {}

    def spread(self, m: int) -> Tensor:
        """Lloyd's centers [m, d] on the part of the design that moves, a setup."""
        if m not in self._spreads:
            self._spreads[m] = self._spread(m)
        return self._spreads[m]

    def _spread(self, m: int) -> Tensor:
        design = self.scenario.half(open_only=True)
        vertices, mass = design.vertices, design.weights
        if design.planar is not None:
            vertices = design.planar.pinned(vertices)
        if design.blend is not None:
            moving = design.blend > 0
            vertices, mass = vertices[moving], (mass * design.blend)[moving]
        stream = random_stream(self.seed, "lloyd")
        centers = lloyd(vertices, m, generator=stream, weights=mass, starts=SPREAD)
        return self.scenario.parameterization.settle(centers)

    def _bounded(self, design: Scenario, kernel: Kernel) -> BoundedPotential:
        given = design.vertices, design.gradient, kernel, self.norm
        return BoundedPotential(*given, design.weights, design.blend, design.mirror, design.max_displacement)

    def found(self, kernel: Kernel) -> Found:
        """Nested and Lloyd's setups of all numbers of centers, of one kernel, which has the support radius."""
        picked = nested_of(self.scenario, RBF(kernel), self.norm, self.most).centers
        settle, score = self.scenario.parameterization.settle, self._bounded(self.scored, kernel)
        trials, setups = [], {}
        for m in range(1, self.most + 1):
            setups[m] = settle(picked[:m])
            trials.append(Trial(kernel.name, kernel.support, m, _gain(score, setups[m]), math.nan, math.nan))
        found = Found(kernel, picked, trials, setups)
        for m in self.spread_numbers:
            self._compare(found, m, "lloyd", self.spread(m))
        for m in self.climbed_numbers:
            self.optimize(found, m)
        return found

    def _compare(self, found: Found, m: int, series: str, setup: Tensor) -> None:
        """Add the gain of one more setup of m centers to what was found of a kernel."""
        trial, gain = found.trials[m - 1], _gain(self._bounded(self.scored, found.kernel), setup)
        if gain > trial.gain:
            found.setups[m] = setup
        found.trials[m - 1] = trial._replace(**{series: gain})

    def optimize(self, found: Found, m: int) -> None:
        """Add the best of some climbs with m centers to what was found of a kernel, and Lloyd's beside it."""
        trial, spread = found.trials[m - 1], self.spread(m)
        if math.isfinite(trial.optimized):
            return
        if math.isnan(trial.lloyd):
            self._compare(found, m, "lloyd", spread)
        start = self.scenario.parameterization.settle(found.picked[:m])
        climbed = self._climbed(found.kernel, (start, spread))
        score = self._bounded(self.scored, found.kernel)  # a climb on the coarse design may lose on this one
        self._compare(found, m, "optimized", max((climbed, start, spread), key=lambda setup: _gain(score, setup)))

    def refine(self, everything: Sequence[Found]) -> None:
        """Optimize further numbers, by bisection, until the smallest that gains enough is known.

        Kernels and radii far behind at both ends of the bracket are left out.
        """

        def best(m: int) -> float:
            return max(found.trials[m - 1].gain for found in everything)

        enough = ENOUGH * max(best(m) for m in self.climbed_numbers)
        passing = [m for m in self.climbed_numbers if best(m) >= enough]
        high = passing[0]
        low = max((m for m in self.climbed_numbers if m < high), default=0)
        while high - low > 1:
            ends = [m for m in (low, high) if m]
            rivals = [found for found in everything if any(found.trials[m - 1].gain >= RIVAL * best(m) for m in ends)]
            middle = (low + high) // 2
            for found in rivals:
                self.optimize(found, middle)
            low, high = (low, middle) if best(middle) >= enough else (middle, high)

    def _climbed(self, kernel: Kernel, starts: Sequence[Tensor]) -> Tensor:
        """The best setup [m, d] of some climbs by gradient, on the coarse design."""
        bounded, m = self._bounded(self.coarse, kernel), len(starts[0])
        space = RBF(kernel).space(self.scenario, m)
        side, stream = space.upper - space.lower, random_stream(self.seed, f"climb {m}")
        points = torch.stack(list(starts))
        noise = torch.randn(COPIES, *points.shape, generator=stream, dtype=points.dtype)
        points = torch.cat((points, (points + SCATTER * side * noise).flatten(0, 1)))
        climb = LBFGS(((points - space.lower) / side).flatten(1).clamp(0.0, 1.0))
        near = None
        for _ in range(CLIMB):
            box = space.lower + side * climb.ask().unflatten(1, (m, -1))
            setups = space.place(box)
            found = bounded.optima(setups, near, gradients=True)
            near = found.near
            if found.gradients is None:
                break
            gradient = space.pull(box, found.gradients) * side
            climb.tell(found.values, gradient.flatten(1))
        best = int(climb.values.argmax())
        return space.place(space.lower + side * climb.points[best].unflatten(0, (m, -1)))


def _gain(bounded: BoundedPotential, setup: Tensor) -> float:
    """The gain of one setup [m, d]; NaN where it has none."""
    value = float(bounded.values(setup[None])[0])
    return math.sqrt(value) if value >= 0.0 else math.nan
