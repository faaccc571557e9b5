"""A kernel, a representation and a method from outside the package: one file and one yaml each (tests/plugged)."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from called import command
from scipy.spatial.distance import cdist

from rbfevo.figures.processes import FIGURES
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup
from rbfevo.scenarios import plane
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.gradients import differentiable_scores
from rbfevo.scoring.representations import Reduced

PLUGGED = Path(__file__).parent / "plugged"
ROOT = Path(__file__).parents[1]
SMALL = ["scenario=plane", "scenario.resolution=[20,20]", "centers=6", "figures=false"]
SEARCH = ["method=gradient", "method.starts=16", "method.population=16", "method.generations=10", "method.front=10"]


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, which finds the plug-in as a user's does."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(PLUGGED)])}
    arguments = (sys.executable, "-m", *arguments)
    return subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=300, check=False)


def words(directory: Path, *overrides: str) -> list[str]:
    return ["rbfevo", f"hydra.searchpath=[file://{PLUGGED}]", *SMALL, *overrides, f"hydra.run.dir={directory}"]


def run(directory: Path, *overrides: str) -> Path:
    made = command(*words(directory, *overrides))
    assert made.returncode == 0, made.stdout + made.stderr
    return directory


@pytest.fixture(scope="module", autouse=True)
def _importable() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(PLUGGED))
        yield


@pytest.fixture(scope="module")
def gaussian(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The only run in a process of its own."""
    directory = tmp_path_factory.mktemp("gaussian") / "run"
    made = python(*words(directory, "kernel=bell", "kernel.width=0.4", "manipulation=direct", *SEARCH))
    assert made.returncode == 0, made.stdout + made.stderr
    return directory


@pytest.fixture(scope="module")
def modes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("modes")
    np.save(folder / "waves.npy", np.random.default_rng(0).normal(scale=3.0, size=(5, 2)))
    return run(folder / "run", "representation=modes", f"representation.file={folder / 'waves.npy'}", *SEARCH)


def potential(U: np.ndarray, g: np.ndarray) -> float:
    left = np.linalg.svd(U, full_matrices=False)[0]
    return float((left.T @ g).__pow__(2).sum())


def test_scores_with_a_kernel_from_outside_are_those_of_its_formula(gaussian: Path) -> None:
    record = read(gaussian)
    assert record.summary["kernel"] == "bell"
    assert record.title == "plane · bell kernel · direct manipulation"
    for row in record.front[[0, -1]]:
        c = record.centers[row]
        phi, psi = (np.exp(-((cdist(points, c) / 0.4) ** 2)) for points in (record.vertices, c))
        U = np.linalg.solve(psi, phi.T).T
        sigma = np.linalg.svd(U, compute_uv=False)
        assert record.regularity[row] == pytest.approx(sigma[-1] / sigma[0], rel=1e-6)
        assert record.improvement_potential[row] == pytest.approx(potential(phi, record.gradient), abs=1e-8)
        np.testing.assert_allclose(setup(record, int(row)).columns(record.vertices), phi, atol=1e-14)


def test_scores_in_a_representation_from_outside_are_those_of_its_columns(modes: Path) -> None:
    record = read(modes)
    assert record.genotype is not None
    assert record.genotype.shape[1] == 5
    assert record.centers.shape[1:] == (0, 2)
    assert record.title == "plane · representation modes · indirect manipulation"
    waves = np.load(modes.parent / "waves.npy")
    for row in record.front[[0, -1]]:
        U = np.cos(record.vertices @ waves.T + record.genotype[row])
        sigma = np.linalg.svd(U, compute_uv=False)
        assert record.regularity[row] == pytest.approx(sigma[-1] / sigma[0], rel=1e-6)
        assert record.improvement_potential[row] == pytest.approx(potential(U, record.gradient), abs=1e-8)
    searched = record.method == "gradient"  # by gradients through autograd
    assert record.improvement_potential[searched].max() > record.improvement_potential[~searched].max() - 1e-6


def test_export_and_apply_know_what_a_kernel_from_outside_does(gaussian: Path, tmp_path: Path) -> None:
    assert command("rbfevo.export", str(gaussian), "--pick", "knee", "--out", str(tmp_path / "e")).returncode == 0
    saved = np.load(tmp_path / "e" / "setup.npz")
    arguments = [str(gaussian), "--pick", "knee", "--mesh", str(tmp_path / "e" / "template.vtp")]
    for what in ("displacements", "weights"):
        out = tmp_path / f"{what}.vtp"
        done = command("rbfevo.apply", *arguments, f"--{what}", str(tmp_path / "e" / f"{what}.csv"), "--out", str(out))
        assert done.returncode == 0, done.stderr
    import pyvista

    moved = [pyvista.read(tmp_path / f"{what}.vtp").points for what in ("displacements", "weights")]
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-9)
    reached = saved["U"] @ np.linalg.lstsq(saved["U"], read(gaussian).gradient, rcond=None)[0]
    norm = read(gaussian).gradient_norm
    assert norm is not None
    np.testing.assert_allclose(np.asarray(moved[1])[:, 2], norm * reached[:, 0], atol=1e-9)


def test_what_a_representation_from_outside_does_not_offer_is_refused_in_a_line(modes: Path, tmp_path: Path) -> None:
    exported = command("rbfevo.export", str(modes), "--pick", "knee", "--out", str(tmp_path / "e"))
    assert exported.returncode == 0, exported.stderr
    assert "left out: displacements.csv: the control points of representation=modes cannot be moved" in exported.stdout
    arguments = [str(modes), "--pick", "knee", "--mesh", str(tmp_path / "e" / "template.vtp")]
    weights = ["--weights", str(tmp_path / "e" / "weights.csv")]
    assert command("rbfevo.apply", *arguments, *weights, "--out", str(tmp_path / "moved.vtp")).returncode == 0
    fitted = command("rbfevo.fit", str(modes), "--pick", "knee")
    assert (fitted.returncode, fitted.stderr.count("\n")) == (2, 1)
    assert "only setups of centers" in fitted.stderr
    waves = f"representation.file={modes.parent / 'waves.npy'}"
    for more, line in (
        (["method=lloyd"], "method=lloyd places centers, and representation=modes has none"),
        (["method=ols"], "method=ols places centers one by one, and representation=modes has none"),
        (["method=random", "manipulation=direct"], "manipulation=direct: representation=modes offers indirect"),
    ):
        made = command(*words(tmp_path / "refused", "representation=modes", waves, *more))
        assert made.returncode == 2
        assert made.stderr.strip().splitlines()[-1] == f"rbfevo: {line}"


def test_figures_and_the_page_are_drawn_of_plugged_in_runs(gaussian: Path, modes: Path) -> None:
    """One run's by processes of their own, as the command does; the other one's here."""
    import json
    import re

    drawn = [python("rbfevo.figures", str(gaussian))]
    drawn += [command("rbfevo.figures", str(modes), "--only", figure) for figure in FIGURES]
    for done in drawn:
        assert done.returncode == 0, done.stderr
    for directory in (gaussian, modes):
        assert {"front.png", "centers.png", "report.html"} <= {path.name for path in directory.iterdir()}
        page = (directory / "report.html").read_text(encoding="utf-8")
        (content,) = re.findall(r'<script type="application/json" id="content">(.*?)</script>', page, re.DOTALL)
        entry = json.loads(content)["runs"][0]
        assert entry["formula"] is None
        import base64

        record = read(directory)
        left = np.frombuffer(base64.b64decode(entry["embedded"]["left"]), "<f4")
        left = left.reshape(len(entry["embedded"]["rows"]), len(record.vertices), 1)
        for place, one in zip(entry["embedded"]["rows"], left, strict=True):
            row = entry["rows"][place]
            assert 1.0 - float((one.astype(float) ** 2).sum()) == pytest.approx(
                record.improvement_potential[row], abs=1e-5
            )


def test_a_kernel_from_outside_can_be_fitted(gaussian: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])
    done = command("rbfevo.fit", str(gaussian), "--pick", "knee", "--out", str(tmp_path / "fit"))
    assert done.returncode == 0, done.stderr


def test_a_method_from_outside_searches_and_resumes(tmp_path: Path) -> None:
    directory = run(tmp_path / "run", "method=walk", "method.generations=3")
    before = read(directory)
    assert set(before.method.tolist()) == {"random", "walk"}
    longer = command("rbfevo", f"resume={directory}", "method.generations=6")
    assert longer.returncode == 0, longer.stderr
    whole = read(run(tmp_path / "whole", "method=walk", "method.generations=6"))
    np.testing.assert_array_equal(read(directory).centers, whole.centers)


def test_a_kernel_that_is_not_there_any_more_is_told_in_a_line(gaussian: Path) -> None:
    arguments = [sys.executable, "-m", "rbfevo.export", str(gaussian), "--pick", "knee"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "the kernel plugged.Bell of this run cannot be imported" in done.stderr


def test_a_representation_without_closed_form_has_the_gradients_of_its_scores(modes: Path) -> None:
    plugged: Any = importlib.import_module("plugged")

    scenario = plane((15, 30))
    evaluate = Evaluator(scenario.vertices, scenario.gradient, plugged.Modes(str(modes.parent / "waves.npy")))
    setups = torch.rand(3, 5, generator=torch.Generator().manual_seed(5), dtype=torch.float64).requires_grad_()
    regularity, potential = differentiable_scores(evaluate, setups)
    (found,) = torch.autograd.grad((2.0 * regularity + 3.0 * potential).sum(), setups)
    h = 1e-6
    for i in range(5):
        step = torch.zeros(5, dtype=torch.float64)
        step[i] = h
        above, below = (evaluate(setups.detach() + sign * step).objectives for sign in (1.0, -1.0))
        slope = ((above - below) @ torch.tensor([2.0, 3.0], dtype=torch.float64)) / (2 * h)
        torch.testing.assert_close(found[:, i], slope, rtol=1e-5, atol=1e-7)


def test_parameters_that_are_fewer_than_columns_reach_what_their_combinations_do(modes: Path) -> None:
    plugged: Any = importlib.import_module("plugged")

    W = torch.randn(5, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)

    class Coupled(plugged.Modes):
        manipulations = ("indirect", "direct")

        def reduce(self, setups: torch.Tensor, factor: torch.Tensor, manipulation: str) -> Reduced:
            none = torch.zeros(len(setups), dtype=torch.bool)
            return Reduced(W.T @ factor, W.expand(len(setups), 5, 3), none)

        def matrix(self, phi: torch.Tensor, setup: torch.Tensor, manipulation: str) -> torch.Tensor:
            return phi @ W

    scenario, representation = plane((15, 30)), Coupled(str(modes.parent / "waves.npy"))
    waves = representation.waves
    waves[1] = waves[0]
    evaluate = Evaluator(scenario.vertices, scenario.gradient, representation, manipulation="direct")
    setups = torch.rand(4, 5, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    setups[3, 1] = setups[3, 0]  # two columns of Phi alike; their combinations need not be
    fast, exact = evaluate(setups), evaluate.definition(setups)
    every = evaluate.deformation(setups)
    torch.testing.assert_close(every, evaluate.deformation.phi(setups) @ W)
    for row, phases in enumerate(setups.numpy()):
        U = np.cos(scenario.vertices.numpy() @ waves.T + phases) @ W.numpy()
        sigma = np.linalg.svd(U, compute_uv=False)
        for scores in (fast, exact):
            assert float(scores.regularity[row]) == pytest.approx(sigma[-1] / sigma[0], rel=1e-6)
            expected = potential(U, scenario.gradient.numpy())
            assert float(scores.improvement_potential[row]) == pytest.approx(expected, abs=1e-8)
            assert float(scores.variability[row]) == pytest.approx(3 / len(scenario.vertices))
