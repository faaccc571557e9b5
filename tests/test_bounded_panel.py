"""`method=panel criterion.norm=16` as a whole: its files, its picture, going on after an interruption, and exports."""

from __future__ import annotations

import csv
import json
import signal
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from designs import scipy_potential
from matplotlib.image import imread
from scipy.spatial.distance import cdist
from test_mesh_runs import egg
from test_resume import assert_same

from rbfevo import export
from rbfevo.__main__ import main
from rbfevo.figures import __main__ as figures
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.sweep import hypervolume
from rbfevo.runs.journal import Journal

P, SUPPORT, LAST = 16.0, 1.5, 3 + 3 + 1 + 1  # steps: two searches of three generations, two heuristics
SMALL = [
    *("method.nsga2.population=8", "method.nsga2.generations=3", "method.ols.per_axis=6", "method.lloyd.starts=2"),
    *("method.cmaes.population=6", "method.cmaes.parents=3", "method.cmaes.generations=3", "preference=[0,0.4,1]"),
    *("method.blend.per_axis=6", "method.blend.climbs=2"),
]


def arguments(out: Path, template: Path) -> list[str]:
    """The command line of a small panel on an egg with a sensitivity."""
    mesh = [f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}", "scenario=mesh"]
    settled = ["evaluator=eager", "quiet=true", "figures=false", "centers=4", "checkpoint.every=0"]
    asked = ["method=panel", f"criterion.norm={P:g}", f"kernel.support={SUPPORT}"]
    return [f"hydra.run.dir={out}", *mesh, *settled, *asked, *SMALL]


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small egg, and a sensitivity in a file beside it."""
    return egg(tmp_path_factory.mktemp("egg"), subdivisions=2)


@pytest.fixture(scope="module")
def panel(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was never interrupted."""
    out = tmp_path_factory.mktemp("panel") / "run"
    assert main(arguments(out, template)) == 0
    return out


def plain_potentials(record: Record, row: int) -> tuple[float, float]:
    """P and P_16 of a setup by NumPy and SciPy, from the run's own files."""
    r = cdist(record.vertices, record.centers[row])
    U = np.where(r < SUPPORT, (1 - r / SUPPORT) ** 4 * (4 * r / SUPPORT + 1), 0)
    roots = np.sqrt(record.weights)[:, None]
    left, _, _ = np.linalg.svd(roots * U, full_matrices=False)
    residual = roots * record.gradient - left @ (left.T @ (roots * record.gradient))
    u = record.weights / record.weights.sum()
    return 1 - float((residual**2).sum()), scipy_potential([([0, 1, 2], U)], record.gradient, u, P)


def test_files_hold_both_potentials_and_name_the_one_that_was_searched(panel: Path) -> None:
    record = read(panel)
    assert record.bounded_potential is not None
    assert list(dict.fromkeys(record.method.tolist())) == ["random", "nsga2", "cmaes", "lloyd", "ols", "blend"]
    assert np.abs(record.bounded_potential - record.improvement_potential).max() > 0.01
    for row in range(0, len(record.method), 3):
        found = record.improvement_potential[row], record.bounded_potential[row]
        assert found == pytest.approx(plain_potentials(record, row), abs=1e-7)
    summary = json.loads((panel / "summary.json").read_text())
    assert summary["objectives"] == ["regularity", "bounded_potential"]
    assert summary["criterion_norm"] == P
    assert summary["hypervolume"] == pytest.approx(hypervolume(record.regularity, record.bounded_potential), rel=1e-9)


def test_the_history_is_of_the_searched_potential(panel: Path) -> None:
    record = read(panel)
    last: dict[str, dict[str, dict[str, str]]] = defaultdict(dict)
    for line in csv.DictReader((panel / "history.csv").read_text().splitlines()):
        last[line["method"]][line["preference"]] = line
    assert set(last) == {"nsga2", "cmaes", "lloyd", "ols", "blend"}
    assert set(last["cmaes"]) == {"0.0", "0.4", "1.0"}
    for method, lines in last.items():
        rows = record.method == method
        R, searched = record.regularity[rows], record.potential[rows]
        for preference, line in lines.items():
            mine = record.preference[rows] == float(preference) if preference else np.ones(len(R), bool)
            assert float(line["best_improvement_potential"]) == pytest.approx(searched[mine].max(), abs=1e-7)
            assert float(line["best_regularity"]) == pytest.approx(R[mine].max(), abs=1e-7)
            assert float(line["hypervolume"]) == pytest.approx(hypervolume(R, searched), abs=1e-7)
            assert abs(searched[mine].max() - record.improvement_potential[rows][mine].max()) > 1e-3  # no mistaking


def test_the_front_is_drawn(panel: Path) -> None:
    assert figures.main([str(panel), "--only", "front"]) == 0
    image = imread(panel / "front.png")
    assert image.shape[0] > 300
    assert image[..., :3].std() > 0.02


@pytest.mark.parametrize("step", [2, 3, 5, LAST - 1])
def test_a_panel_that_was_interrupted_ends_as_the_whole_one(
    step: int, panel: Path, template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, count = Journal.record, [0]

    def record_and_interrupt(journal: Journal, lines: Any) -> None:
        write(journal, lines)
        count[0] += 1
        if count[0] == step:
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "record", record_and_interrupt)
        assert main(arguments(tmp_path / "run", template)) == 143
    assert count[0] == step
    assert main([f"resume={tmp_path / 'run'}"]) == 0
    assert_same(tmp_path / "run", panel)


@pytest.mark.parametrize("choice", ["knee", "best-improvement-potential"])
def test_its_knee_and_its_best_setup_are_exported(
    choice: str, panel: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = read(panel)
    assert record.bounded_potential is not None
    row = pick(record, choice)
    if choice != "knee":
        assert record.bounded_potential[row] == record.bounded_potential.max()
    assert export.main([str(panel), "--pick", choice, "--rule", "max-norm", "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert f"{choice}: row {row} of " in said
    found = record.improvement_potential[row], record.bounded_potential[row]
    assert f"P = {found[0]:.4f}, P_16 = {found[1]:.4f}" in said
    with np.load(tmp_path / "out" / "setup.npz") as setup:
        assert int(setup["row"]) == row
        np.testing.assert_array_equal(setup["centers"], record.centers[row])
