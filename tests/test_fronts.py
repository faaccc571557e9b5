"""NSGA-II's reference fronts: a stopped search goes on bit for bit, and what is on disk can be read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import bench_fronts
from benchmarks.fronts import DIRECTORY, Reference, reference_front
from benchmarks.panels import PANELS, Panel, chosen
from benchmarks.strategies import Constrained, hypervolume_aim
from rbfevo.errors import UserError
from rbfevo.methods.gradient.tracing import Preference
from rbfevo.runs.run import Run
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.pareto import hypervolume, nondominated

SMALL = ("scenario.resolution=[12,12]", "centers=4", "evaluator=eager", "method.population=12")
PANEL = PANELS[0]


def quiet(_: str) -> None:
    """Print nothing."""


def test_a_stopped_reference_goes_on_bit_for_bit(tmp_path: Path) -> None:
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    Reference(PANEL, 3, tmp_path / "whole", *SMALL).compute(20, quiet)
    Reference(PANEL, 3, tmp_path / "parts", *SMALL).compute(7, quiet)
    parts = Reference(PANEL, 3, tmp_path / "parts", *SMALL)
    parts.compute(20, quiet)
    states = []
    for name in ("whole", "parts"):
        with np.load(tmp_path / name / f"{PANEL.name}-seed3.npz") as file:
            states.append(dict(file))
    for key in ("population", "objectives", "generator", "generation"):
        np.testing.assert_array_equal(states[0][key], states[1][key])
    fronts = [reference_front(PANEL, 21 * 12, 3, tmp_path / name) for name in ("whole", "parts")]
    torch.testing.assert_close(*fronts, rtol=0, atol=0)
    assert nondominated(fronts[0]).all()
    assert parts.population(252)[0].shape == (12, 8)
    head = parts.csv(21 * 12).read_text().splitlines()
    assert "# evaluations: 252" in head
    assert f"# hypervolume: {hypervolume(fronts[0])}" in head


def test_missing_fronts_and_unknown_panels_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"scripts/fronts {PANEL.name}"):
        reference_front(PANEL, 1, 0, tmp_path)
    with pytest.raises(UserError, match="no panel has this name; choose from plane"):
        chosen(["nowhere"])
    assert len(chosen([])) == 12
    assert [panel.name for panel in chosen(["face-triharmonic"])] == [
        "face-triharmonic-indirect",
        "face-triharmonic-direct",
    ]


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel.name)
def test_every_panel_has_its_reference_front(panel: Panel) -> None:
    front = reference_front(panel, 250_000)
    assert nondominated(front).all()
    assert ((front >= 0) & (front <= 1)).all()
    # The committed setups still have their scores: neither the panel nor what scores it has changed.
    genotypes, objectives = Reference(panel, 0, DIRECTORY).population(250_000)
    run = Run(panel.settings("method=random", "evaluator=fused"))
    found = run.evaluator(genotypes[::40].unflatten(1, (25, -1)))
    torch.testing.assert_close(found.regularity, objectives[::40, 0], rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(found.improvement_potential, objectives[::40, 1], rtol=0.0, atol=1e-8)


def test_rows_of_the_benchmark(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    overrides = ("scenario.resolution=[16,16]", "centers=4", "method.starts=16", "method.population=16")
    overrides += ("method.generations=6", "method.polish=2", "evaluator=eager")
    rows = list(bench_fronts.one_front(PANEL, 0, *overrides))
    assert [row.name.strip() for row in rows] == [PANEL.name, "hypervolume", "best R", "best P"]
    assert all(row.ratio is not None and row.met is not None for row in rows[1:])
    monkeypatch.setattr(bench_fronts, "DIRECTORY", tmp_path)
    rows = list(bench_fronts.one_front(PANEL, 0, *overrides))
    assert [row.peer for row in rows[1:]] == [None] * 3


def test_the_hypervolumes_gradient_is_that_of_finite_differences() -> None:
    spectrum = object.__new__(Spectrum)
    spectrum.sigma = torch.tensor([[1.0, 0.2], [1.0, 0.6], [1.0, 0.4]], dtype=torch.float64)
    spectrum.regular = torch.ones(3, dtype=torch.bool)
    spectrum.potential = torch.tensor([0.9, 0.3, 0.7], dtype=torch.float64)
    aim = hypervolume_aim(spectrum)
    assert isinstance(aim, Preference)
    objectives = torch.stack((spectrum.regularity, spectrum.potential), 1)
    slopes = torch.zeros(3, 2, dtype=torch.float64)
    for i in range(3):
        for j in range(2):
            moved = objectives.clone()
            moved[i, j] += 1e-6
            slopes[i, j] = (hypervolume(moved) - hypervolume(objectives)) / 1e-6
    torch.testing.assert_close(aim.preferences, slopes[:, 0] / slopes.sum(1), rtol=1e-5, atol=1e-7)


def test_the_augmented_lagrangian_and_its_gradient() -> None:
    aim = Constrained(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 4.0)
    aim.multipliers = torch.tensor([0.5, 0.0, 1.0], dtype=torch.float64)
    log_regularity = torch.tensor([-1.0, -0.5, -0.2], dtype=torch.float64).requires_grad_()
    potential = torch.tensor([0.9, 0.5, 0.94], dtype=torch.float64).requires_grad_()
    pull = (aim.multipliers + 4.0 * (aim.thresholds + (1 - potential).log())).clamp_min(0.0)
    expected = log_regularity - (pull**2 - aim.multipliers**2) / 8.0
    value, first, second = aim(log_regularity.detach(), potential.detach())
    torch.testing.assert_close(value, expected.detach())
    slopes = torch.autograd.grad(expected.sum(), [log_regularity, potential])
    torch.testing.assert_close((first, second), slopes)
    aim.update(log_regularity.detach(), potential.detach())
    torch.testing.assert_close(aim.multipliers, pull.detach())
