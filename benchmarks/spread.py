"""Differences between the results of one seed on several processors: scores of the same setups, ends of searches."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import OmegaConf

from benchmarks.processors import Processor, environment
from rbfevo.runs.config import check
from rbfevo.runs.run import Run
from rbfevo.scenarios import plane
from rbfevo.scoring.fronts import preferred
from rbfevo.scoring.kernels import triharmonic, wendland
from rbfevo.scoring.pareto import hypervolume
from rbfevo.scoring.symmetric import evaluator_of

OUTPUT = Path(__file__).parent / "spread.csv"
SETUPS, CENTERS = 100, 25
METHODS: dict[str, dict[str, Any]] = {
    "nsga2": {"_target_": "rbfevo.methods.Nsga2Search", "population": 40, "generations": 100},
    "cmaes": {"_target_": "rbfevo.methods.CmaesSearch", "generations": 100},
    "gradient": {"_target_": "rbfevo.methods.GradientSearch", "starts": 40, "population": 40, "front": 40},
    "lloyd": {"_target_": "rbfevo.methods.LloydHeuristic"},
    "ols": {"_target_": "rbfevo.methods.OlsHeuristic"},
}


class Line(NamedTuple):
    """A processor compared with the first: `what` differs by at most `largest` `unit`; `equal` if bitwise identical."""

    processor: str
    what: str
    largest: float
    unit: str
    equal: bool


def scores() -> dict[str, np.ndarray]:
    """R and P of setups drawn uniformly in the plane's box, the same ones on every processor."""
    scenario = plane(resolution=(60, 60))
    generator = torch.Generator().manual_seed(0)
    centers = scenario.lower + (scenario.upper - scenario.lower) * torch.rand(
        SETUPS, CENTERS, 2, generator=generator, dtype=torch.float64
    )
    found: dict[str, np.ndarray] = {"centers": centers.numpy()}
    for kernel in (wendland(2, 0.5), triharmonic(2)):
        for manipulation in ("indirect", "direct"):
            for backend in ("fused", "eager"):
                evaluate = evaluator_of(scenario, kernel, manipulation, backend)
                found[f"scores, {kernel.name}, {manipulation}, {backend}"] = evaluate(centers).objectives.numpy()
    return found


def ends() -> dict[str, np.ndarray]:
    """The final objectives [p, 2] of each method on the plane, seed 0."""
    found = {}
    for name, method in METHODS.items():
        config = {
            "scenario": {"_target_": "rbfevo.scenarios.plane", "resolution": [60, 60], "support": 0.5},
            "kernel": {"_target_": "rbfevo.scoring.kernels.wendland", "support": None},
            "manipulation": {"name": "direct"},
            "method": method,
            "centers": CENTERS,
            "evaluator": "fused",
        }
        run = Run(check(OmegaConf.create(config)))
        (stage,) = run.stages
        stage.start(run.problem())
        for _ in range(stage.steps):
            stage.step()
        found[f"end of {name}"] = torch.cat([rows.scores.objectives for rows in stage.rows()]).numpy()
    return found


def measured(processors: Sequence[Processor], directory: Path) -> list[Line]:
    """Compute the results on each simulated processor, in a separate process, and compare them with the first's.

    Raises:
        RuntimeError: if a process failed; the message is the end of its stderr.
    """
    files = []
    for index, processor in enumerate(processors):
        file = directory / f"results-{index}.npz"
        settings = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
        settings |= environment(processor, directory)
        command = [sys.executable, "-m", "benchmarks.spread", str(file)]
        done = subprocess.run(command, env=settings, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"{processor.name}: {done.stderr[-500:]}")
        with np.load(file) as archive:
            files.append(dict(archive))
    lines = []
    for processor, found in zip(processors[1:], files[1:], strict=True):
        lines += compared(processor.name, files[0], found)
    return lines


def compared(name: str, first: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> list[Line]:
    """The largest differences between two processors' results.

    Raises:
        ValueError: if they scored different setups.
    """
    if not np.array_equal(first["centers"], other["centers"]):
        raise ValueError(f"{name}: the scored setups are not the same")
    lines = []
    for what in (key for key in first if key.startswith("scores")):
        one, two = first[what], other[what]
        relative = np.abs(two[:, 0] - one[:, 0]) / np.maximum(one[:, 0], 1e-12)
        lines.append(Line(name, what, float(relative.max()), "of R", np.array_equal(one[:, 0], two[:, 0])))
        gap = float(np.abs(two[:, 1] - one[:, 1]).max())
        lines.append(Line(name, what, gap, "in P", np.array_equal(one[:, 1], two[:, 1])))
    for what in (key for key in first if key.startswith("end of")):
        one, two = (torch.from_numpy(found[what]) for found in (first, other))
        equal = torch.equal(one, two)
        if len(one) == 1 or "cmaes" in what:
            values = [float(preferred(torch.tensor(0.5), objectives).max()) for objectives in (one, two)]
            unit = "in (R + P) / 2"
        else:
            values = [hypervolume(objectives) for objectives in (one, two)]
            unit = "of the hypervolume"
        gap = abs(values[1] - values[0])
        lines.append(Line(name, what, gap / values[0] if unit == "of the hypervolume" else gap, unit, equal))
    return lines


def table(lines: Sequence[Line]) -> str:
    """The largest difference of each kind over all processors, and how many of them are bitwise identical."""
    rows = []
    for what, unit in dict.fromkeys((line.what, line.unit) for line in lines):
        these = [line for line in lines if (line.what, line.unit) == (what, unit)]
        worst = max(these, key=lambda line: line.largest)
        same = sum(line.equal for line in these)
        rows.append(
            f"{what:44} {worst.largest:8.1e} {unit:20} ({worst.processor}; same bits on {same} of {len(these)})"
        )
    return "\n".join(rows)


def written(lines: Sequence[Line]) -> None:
    """Write the differences as CSV."""
    with OUTPUT.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Line._fields)
        writer.writerows(lines)


if __name__ == "__main__":
    np.savez(sys.argv[1], **scores(), **ends())  # pyright: ignore[reportArgumentType]
