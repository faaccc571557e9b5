"""Small studies for the tests of the reproduction: files as `scripts/reproduce` leaves them, with chosen numbers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.panels import PANELS, Panel
from rbfevo.runs import storage
from reproduction import budgets, runs
from reproduction.budgets import Budget
from reproduction.study import Setups, Study

TINY = Budget(
    "tiny",
    seeds=(0, 1),
    search_seeds=(0, 1),
    evaluations=200,
    computes_fronts=True,
    generations=2,
    full=(PANELS[0].name, PANELS[-1].name),
    random=8,
    fit_subdivisions=1,
    fit_generations=(40, 10),
    fit_seeds=(2, 1),
    gradient=("method.starts=16", "method.population=16", "method.generations=6", "method.polish=2"),
    plane=("scenario.resolution=[12,12]", "centers=5", "evaluator=eager"),
    face=("scenario.subdivisions=1", "centers=5", "evaluator=eager"),
)


def began(out: Path, monkeypatch: pytest.MonkeyPatch, budget: Budget = TINY) -> Path:
    """A directory that belongs to a budget, without results."""
    monkeypatch.setitem(budgets.BUDGETS, budget.name, budget)
    out.mkdir(parents=True, exist_ok=True)
    facts = {"budget": budget.name, "hardware": "2 cores", "software": "torch", "seconds": {"runs": 1.0}}
    (out / "study.json").write_text(json.dumps(facts))
    return out


def drawn(panel: Panel, method: str, seed: int, m: int = 5) -> Setups:
    """Setups as a method might leave them, at random: a front for the searches, one setup for a heuristic."""
    generator = np.random.default_rng([PANELS.index(panel), seed, *method.encode()])
    count = {"random": 8, "nsga2": 12, "cmaes": 11, "cmaes-full": 11, "gradient": 12}.get(method, 1)
    d = 2 if panel.scenario == "plane" else 3
    centers = generator.uniform(0, 1, (count, m, d))
    if d == 3:
        centers /= np.linalg.norm(centers, axis=-1, keepdims=True)  # on the sphere, where each reaches a vertex
    angle = np.linspace(0.05, 0.45 * np.pi, count)
    R, P = 0.9 * np.sin(angle), 0.95 * np.cos(angle)
    if method == "random":
        centers = np.random.default_rng(seed).uniform(0, 1, (count, m, d))  # the same for both manipulations
        R, P = 0.1 * generator.uniform(size=count), 0.5 * generator.uniform(size=count)
    preference = np.linspace(0, 1, 11) if method.startswith("cmaes") else np.full(count, np.nan)
    return Setups(centers, R, P, np.full(count, m / 144), preference)


def put(out: Path, panel: Panel, method: str, seed: int, setups: Setups, budget: Budget = TINY) -> None:
    """Write setups as the run, or the front, of a method."""
    if method == "nsga2":
        directory = runs.fronts_directory(out)
        directory.mkdir(parents=True, exist_ok=True)
        reference = runs.Reference(panel, seed, directory)
        flat = setups.centers.reshape(len(setups.centers), -1)
        state = {"population": flat, "objectives": setups.objectives}
        state["generation"] = np.array(budget.evaluations // len(flat))
        storage.write_whole(reference.path, storage.npz(state))
        reference.csv(budget.evaluations).write_text("# processor_seconds: 12.5\nregularity,improvement_potential\n")
        return
    task = next(task for task in runs.tasks(budget) if task[:3] == (panel, method, seed))
    directory = task.directory(out)
    directory.mkdir(parents=True)
    table = {**setups._asdict(), "method": np.array([method.split("-")[0]] * len(setups.centers))}
    storage.write_whole(directory / "setups.npz", storage.npz(table))
    summary = {"stop_reason": "budget", "seconds": 2.0, "evaluations": 400}
    (directory / "summary.json").write_text(json.dumps(summary))
    (directory / runs.ARGUMENTS).write_text(json.dumps(task.arguments))


def full_study(out: Path, monkeypatch: pytest.MonkeyPatch) -> Study:
    """A study in which every run is there."""
    # 12 individuals do not divide 200 evaluations
    budget = TINY._replace(evaluations=240)
    began(out, monkeypatch, budget)
    for task in runs.tasks(budget):
        put(out, task.panel, task.series, task.seed, drawn(task.panel, task.series, task.seed), budget)
    for panel in PANELS:
        for seed in budget.seeds:
            put(out, panel, "nsga2", seed, drawn(panel, "nsga2", seed), budget)
    return Study(out)
