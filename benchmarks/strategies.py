"""Compares strategies for tracing a front by gradients: those tried during the development of `method=gradient`.

All strategies use the same coarse design, the same number of gradient evaluations and an archive of the setups that
they evaluate. The 100 archived setups that keep most of its hypervolume are scored by definition on all vertices.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.bench_fronts import gradient_front
from benchmarks.fronts import Reference
from benchmarks.panels import Panel, chosen
from rbfevo.errors import UserError
from rbfevo.methods.gradient.lbfgs import LBFGS
from rbfevo.methods.gradient.tracing import (
    Aim,
    Archive,
    Preference,
    Tchebycheff,
    WeightedSum,
    climbs,
    exponents,
    front_normals,
    soft_regularity,
)
from rbfevo.methods.lloyd import LloydHeuristic
from rbfevo.methods.ols import OlsHeuristic
from rbfevo.runs import storage
from rbfevo.runs.run import Run
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.pareto import hypervolume, ranks, well_spread
from rbfevo.scoring.threads import coarse

OUTPUT = Path(__file__).parent / "strategies.csv"
POPULATION, STEPS, COARSE = 96, 185, 2000


class Trial:
    """One strategy on one panel: the coarse problem, its box as a unit box, and the archive."""

    def __init__(self, panel: Panel, seed: int) -> None:
        self.panel, self.seed = panel, seed
        sizes = (f"method.starts={POPULATION}", f"method.population={POPULATION}")
        self.run = Run(panel.settings("method=gradient", *sizes, f"seed={seed}"))
        self.problem = self.run.problem().coarsened(COARSE)
        self.side = self.problem.space.upper - self.problem.space.lower
        self.archive = Archive(self.random(), limit=1000)

    def random(self) -> Tensor:
        """The run's initial population [POPULATION, D]."""
        return self.points(self.problem.initial.centers)

    def points(self, centers: Tensor) -> Tensor:
        """Centers [p, m, d] as points [p, D] of the unit box."""
        return ((centers - self.problem.space.lower) / self.side).flatten(1).clamp(0.0, 1.0)

    def centers(self, points: Tensor) -> Tensor:
        """Points as centers."""
        return self.problem.space.lower + self.side * self.problem.unflatten(points)

    def heuristics(self) -> Tensor:
        """Points [POPULATION, D]: a third random, a third scattered around Lloyd's setup, a third around OLS's."""
        points = self.random()
        generator = self.problem.stream("strategies")
        lloyd = self.points(LloydHeuristic().place(self.problem))
        ols = self.points(OlsHeuristic(30 if self.side.shape[1] == 2 else 15).place(self.problem))
        noise = 0.05 * torch.rand(POPULATION, 1, generator=generator, dtype=points.dtype)
        noise = noise * torch.randn(points.shape, generator=generator, dtype=points.dtype)
        points[1::3], points[2::3] = lloyd + noise[1::3], ols + noise[2::3]
        return points.clamp(0.0, 1.0)

    def look(self, points: Tensor) -> Spectrum:
        """The spectrum of points [p, D], which are added to the archive."""
        spectrum = self.problem.spectrum(self.centers(points))
        self.archive.add(points, torch.stack((spectrum.regularity, spectrum.potential), 1))
        return spectrum

    def slopes(self, spectrum: Spectrum, q: Tensor, aim: Aim) -> tuple[Tensor, Tensor, Tensor]:
        """log of the soft R, the values of the aim, and their gradients [p, D] in the unit box."""
        log_regularity, slope = soft_regularity(spectrum, q)
        values, first, second = aim(log_regularity, spectrum.potential)
        gradient = spectrum.backward(first[:, None] * slope, second) * self.side
        return log_regularity, values, gradient.flatten(1)

    def result(self) -> Tensor:
        """Objectives [at most 100, 2] of the archive's best-spread setups, on all vertices by definition."""
        rows = well_spread(self.archive.objectives, 100)
        return self.run.evaluator.definition(self.centers(self.archive.points[rows])).objectives


def quasi_newton(trial: Trial, points: Tensor, aim: Aim, steps: int, sharpness: float = 64.0, every: int = 20) -> None:
    """L-BFGS with one aim; every `every` steps the smoothing is fitted to R and multipliers are updated."""
    climb = LBFGS(points)
    q = torch.ones_like(points[:, 0])
    for step in range(steps):
        if step % every == 0:
            climb.revalue()
        spectrum = trial.look(climb.ask())
        if step % every == 0:
            q = exponents(spectrum.regularity, sharpness)
            if isinstance(aim, Constrained):
                aim.update(soft_regularity(spectrum, q)[0], spectrum.potential)
        _, values, gradient = trial.slopes(spectrum, q, aim)
        climb.tell(values, gradient)


def adam(trial: Trial, points: Tensor, aim: Aim | None, steps: int, rate: float = 0.01) -> None:
    """Adam with a step size for each setup and a cosine schedule; without an aim it maximizes the hypervolume."""
    first, second = torch.zeros_like(points), torch.zeros_like(points[:, :1])
    for step in range(steps):
        spectrum = trial.look(points)
        q = exponents(spectrum.regularity, 16.0 * 16.0 ** (step / steps))
        now = hypervolume_aim(spectrum) if aim is None else aim
        _, _, gradient = trial.slopes(spectrum, q, now)
        first = 0.9 * first + 0.1 * gradient
        second = 0.99 * second + 0.01 * gradient.square().mean(1, keepdim=True)
        mean, spread = first / (1 - 0.9 ** (step + 1)), (second / (1 - 0.99 ** (step + 1))).sqrt()
        pace = rate * (0.5 * (1 + math.cos(math.pi * step / steps)) + 0.02)
        points = (points + pace * mean / spread.clamp_min(1e-12)).clamp(0.0, 1.0)


def hypervolume_aim(spectrum: Spectrum) -> Aim:
    """Gradient of the hypervolume of the setups' own dominance rank, as weights of R and P."""
    objectives = torch.stack((spectrum.regularity, spectrum.potential), 1)
    rank = ranks(objectives)
    weights = torch.zeros_like(objectives)
    for level in range(int(rank.max()) + 1):
        rows = (rank == level).nonzero().squeeze(1)
        rows = rows[objectives[rows, 0].argsort()]
        R, P = objectives[rows].unbind(1)
        weights[rows, 0] = P - torch.cat((P[1:], P.new_zeros(1)))
        weights[rows, 1] = R - torch.cat((R.new_zeros(1), R[:-1]))
    share = weights[:, 0] / weights.sum(1).clamp_min(1e-300)
    return Preference(share)


class Constrained(Aim):
    """max log R subject to -log(1 - P) >= t, by an augmented Lagrangian; `update` updates the multipliers."""

    def __init__(self, thresholds: Tensor, stiffness: float) -> None:
        self.thresholds, self.stiffness = thresholds, stiffness
        self.multipliers = torch.zeros_like(thresholds)

    def state_dict(self) -> dict[str, Any]:
        """Thresholds, stiffness and multipliers."""
        tensors = {"thresholds": self.thresholds.clone(), "multipliers": self.multipliers.clone()}
        return {"kind": "constrained", "stiffness": self.stiffness, **tensors}

    def update(self, log_regularity: Tensor, potential: Tensor) -> None:
        """Update the multipliers after a round of climbs."""
        self.multipliers = self._pull(climbs(torch.stack((log_regularity.exp(), potential), 1))[:, 1])

    def _pull(self, lift: Tensor) -> Tensor:
        return (self.multipliers + self.stiffness * (self.thresholds - lift)).clamp_min(0.0)

    def __call__(self, log_regularity: Tensor, potential: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The values, and their derivatives by log R and by P."""
        lift = climbs(torch.stack((log_regularity.exp(), potential), 1))[:, 1]
        pull = self._pull(lift)
        value = log_regularity - (pull.square() - self.multipliers.square()) / (2.0 * self.stiffness)
        return value, torch.ones_like(value), pull / (1.0 - potential).clamp_min(1e-9)


def weights() -> Tensor:
    """Weights [POPULATION], evenly spaced over [0, 1]."""
    return torch.linspace(0.0, 1.0, POPULATION, dtype=torch.float64)


def adam_random(trial: Trial) -> None:
    """Adam, weighted sums of the logarithms, random starts."""
    adam(trial, trial.random(), WeightedSum(weights()), STEPS)


def lbfgs_random(trial: Trial) -> None:
    """L-BFGS, weighted sums, random starts."""
    quasi_newton(trial, trial.random(), WeightedSum(weights()), STEPS)


def lbfgs_starts(trial: Trial) -> None:
    """L-BFGS, weighted sums, starts from Lloyd, OLS and at random."""
    quasi_newton(trial, trial.heuristics(), WeightedSum(weights().roll(POPULATION // 2)), STEPS)


def lbfgs_best_start(trial: Trial) -> None:
    """As `lbfgs_starts`, but each weight restarts from the best of all setups after a third and two thirds."""
    points, third = trial.heuristics(), STEPS // 3
    aim = WeightedSum(weights())
    for _ in range(3):
        quasi_newton(trial, points, aim, third)
        lifts = climbs(trial.archive.objectives)
        value = aim.weights[:, None] * lifts[:, 0] + (1 - aim.weights[:, None]) * lifts[:, 1]
        points = trial.archive.points[value.argmax(1)]


def constrained(trial: Trial) -> None:
    """L-BFGS, max R subject to P >= t by an augmented Lagrangian, after a third of weighted sums."""
    third = STEPS // 3
    quasi_newton(trial, trial.heuristics(), WeightedSum(weights().roll(POPULATION // 2)), third)
    front = trial.archive.objectives
    lifts = climbs(front)[:, 1]
    thresholds = lifts[-1] + (lifts[0] - lifts[-1]) * weights()
    rows = (lifts[None] - thresholds[:, None]).abs().argmin(1)
    span = float((lifts[0] - lifts[-1]).clamp_min(1e-3))
    quasi_newton(trial, trial.archive.points[rows], Constrained(thresholds, 10.0 / span), STEPS - third)


def hypervolume_gradient(trial: Trial) -> None:
    """Adam along the gradient of the hypervolume of all setups, starts from Lloyd, OLS and at random."""
    adam(trial, trial.heuristics(), None, STEPS)


def polished_nsga2(trial: Trial) -> None:
    """L-BFGS outwards from NSGA-II's front after 250,000 evaluations."""
    reference = Reference(trial.panel, trial.seed)
    centers = trial.problem.unflatten(reference.population(250_000)[0])
    trial.look(trial.points(centers))
    rows = well_spread(trial.archive.objectives, POPULATION)
    points = trial.archive.points[rows]
    normals, span = front_normals(trial.archive.objectives, rows)
    quasi_newton(trial, points, Tchebycheff(normals, span, 0.1), STEPS, every=STEPS)


STRATEGIES: dict[str, Callable[[Trial], None]] = {
    "adam": adam_random,
    "weighted": lbfgs_random,
    "starts": lbfgs_starts,
    "shared": lbfgs_best_start,
    "constrained": constrained,
    "hypervolume": hypervolume_gradient,
    "polished": polished_nsga2,
}
METHOD = "gradient"


def attempt(panel: Panel, name: str, seed: int) -> tuple[float, ...]:
    """Hypervolume, best R, best P and seconds of one strategy."""
    if name == METHOD:
        _, objectives, seconds = gradient_front(panel, seed)
    else:
        start, trial = time.perf_counter(), Trial(panel, seed)
        STRATEGIES[name](trial)
        objectives = trial.result()
        seconds = time.perf_counter() - start
    return hypervolume(objectives), *objectives.amax(0).tolist(), seconds


def main() -> int:
    """Run the strategies on the panels and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.strategies", description=__doc__)
    parser.add_argument("panels", nargs="*", help="panels, or parts of their names; default: all twelve")
    parser.add_argument("--only", nargs="+", choices=[*STRATEGIES, METHOD], help="only these strategies")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="default: 0")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="CSV file; default: strategies.csv in benchmarks/")
    arguments = parser.parse_args()
    lines: list[tuple] = []
    try:
        with coarse():
            for panel in chosen(arguments.panels):
                for name in arguments.only or [*STRATEGIES, METHOD]:
                    for seed in arguments.seeds:
                        figures = attempt(panel, name, seed)
                        lines.append((panel.name, name, seed, *figures))
                        shown = " ".join(f"{value:.6g}" for value in figures)
                        print(f"{panel.name:32} {name:12} {seed} {shown}", flush=True)
        names = ("panel", "strategy", "seed", "hypervolume", "best_regularity", "best_improvement_potential", "seconds")
        storage.write_whole(arguments.output, storage.csv_text(names, lines))
    except UserError as error:
        print(f"benchmarks.strategies: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
