"""Whole runs that search bounded potential: their files against plain NumPy, resume, and mistakes."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from designs import certified_potential
from scipy.spatial.distance import cdist
from test_contracts import settings
from test_mesh_runs import METHODS, egg

from rbfevo import figures
from rbfevo.__main__ import main
from rbfevo.figures.front import picture
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, knee, read
from rbfevo.recorded.sweep import lines, members
from rbfevo.runs import run
from rbfevo.runs.config import criterion_norm
from rbfevo.scoring.bounded_evaluator import BoundedEvaluator

P = 16.0
SUPPORT = 1.5
HELD = ["scenario.hold=[-1.2,null,null,0.3,null,null]", "scenario.hold_width=1.0"]
MIRRORED = ["scenario.symmetry=y", "scenario.symmetry_at=0", "scenario.weights=area"]


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small egg, and a symmetric sensitivity in a file: three values a vertex."""
    return egg(tmp_path_factory.mktemp("egg"), subdivisions=2)


def searched(out: Path, template: Path, *overrides: str) -> Record:
    fixed = [f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}", "evaluator=eager"]
    settled = ["quiet=true", "figures=false", "centers=5", f"kernel.support={SUPPORT}", f"criterion.norm={P:g}"]
    assert main([f"hydra.run.dir={out}", "scenario=mesh", *fixed, *settled, *overrides]) == 0
    return read(out)


def phi(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    r = cdist(a, b)
    return np.where(r < SUPPORT, (1 - r / SUPPORT) ** 4 * (4 * r / SUPPORT + 1), 0)


def plain_potential(record: Record, C: np.ndarray) -> float:
    """P_16 of one setup, from a run's own files, by NumPy; bounds below and above agree to 1e-9."""
    X = record.vertices
    blend = 1.0 if record.blend is None else record.blend[:, None]
    blocks: list[tuple[list[int], np.ndarray]] = [([0, 1, 2], blend * phi(X, C))]
    if record.summary["symmetry"] is not None:
        off = C[:, 1] != 0
        plus, minus = (phi(X, C) + phi(X, C * (1, -1, 1))), (phi(X, C[off]) - phi(X, C[off] * (1, -1, 1)))
        blocks = [([0, 2], blend * plus), ([1], blend * minus)]
    below, above = certified_potential(blocks, record.gradient, record.weights / record.weights.sum(), P)
    assert above <= below * (1 + 1e-9)
    return below


def plain_scores(record: Record, C: np.ndarray) -> float:
    """P of one setup without symmetry."""
    roots = np.sqrt(record.weights)[:, None]
    U = phi(record.vertices, C) * (1.0 if record.blend is None else record.blend[:, None])
    g = roots * record.gradient
    left, _, _ = np.linalg.svd(roots * U, full_matrices=False)
    return 1.0 - float(np.square(g - left @ (left.T @ g)).sum())


@pytest.mark.parametrize(
    ("method", "more"),
    [(method, HELD) for method in METHODS]
    + [("nsga2", MIRRORED), ("gradient", [*MIRRORED, *HELD, "manipulation=direct"]), ("cmaes", MIRRORED)]
    + [("nsga2", ["scenario.search_vertices=100"]), ("gradient", ["method.coarse=100"])],
)
def test_saved_potentials_are_certified(method: str, more: list[str], template: Path, tmp_path: Path) -> None:
    record = searched(tmp_path, template, f"method={method}", *METHODS[method], *more)
    summary = record.summary
    assert summary["objectives"] == ["regularity", "bounded_potential"]
    assert summary["criterion_norm"] == P
    found = record.bounded_potential
    assert found is not None
    own = np.flatnonzero(record.method == method)
    assert len(own)
    for row in {*own[:6].tolist(), int(own[found[own].argmax()]), 0}:
        assert found[row] == pytest.approx(plain_potential(record, record.centers[row]), rel=1e-8)
        if summary["symmetry"] is None:
            expected = plain_scores(record, record.centers[row])
            assert record.improvement_potential[row] == pytest.approx(expected, abs=1e-8)
    front = record.nondominated
    for row, (R, potential) in enumerate(zip(record.regularity, found, strict=True)):
        beaten = (record.regularity >= R) & (found >= potential) & ((record.regularity > R) | (found > potential))
        assert front[row] == (not beaten.any())
    best = np.maximum.accumulate(found[record.front][::-1])[::-1]
    volume = (np.diff(record.regularity[record.front], prepend=0.0) * best).sum()
    assert summary["hypervolume"] == pytest.approx(volume, rel=1e-9)
    (all_rows, *_) = lines(members(tmp_path.parent / tmp_path.name)[0])
    assert all_rows.hypervolume == pytest.approx(volume, rel=1e-9)
    assert all_rows.best_improvement_potential == found.max()
    assert found[pick(record, "best-improvement-potential")] == found.max()
    columns = (tmp_path / "setups.csv").read_text().splitlines()[0].split(",")
    assert "bounded_potential" in columns
    assert "improvement_potential" in columns
    if method == "nsga2" and not more[0].startswith("scenario.search"):
        last = (tmp_path / "history.csv").read_text().splitlines()[-1].split(",")
        head = (tmp_path / "history.csv").read_text().splitlines()[0].split(",")
        assert float(last[head.index("best_improvement_potential")]) == pytest.approx(found[own].max(), abs=1e-6)


def test_the_search_finds_more_of_what_it_searches(template: Path, tmp_path: Path) -> None:
    budget = ["method=gradient", "preference=0", "method.generations=30", "method.polish=5", "method.population=16"]
    bounded = searched(tmp_path / "16", template, *budget, "method.starts=16")
    plain = searched(tmp_path / "2", template, *budget, "method.starts=16", "criterion.norm=2")
    assert plain.bounded_potential is None
    assert plain.summary["objectives"] == ["regularity", "improvement_potential"]
    best = bounded.bounded_potential
    assert best is not None
    other = plain.centers[plain.improvement_potential.argmax()]
    assert best.max() > 1.01 * plain_potential(bounded, other)
    assert plain.improvement_potential.max() > bounded.improvement_potential[best.argmax()]


@pytest.mark.parametrize("method", ["gradient", "nsga2"])
def test_a_resumed_run_equals_one_in_one_piece(method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import signal

    from rbfevo.runs.journal import Journal

    asked = settings(method, criterion_norm=P)
    # Of gradient so many that a climb is interrupted within a round, at a warm start.
    longer = {**asked.method, "generations": {"gradient": 20, "nsga2": 7}[method]}
    asked = dataclasses.replace(asked, method=longer)
    assert run.carry_out(asked, tmp_path / "whole") == 0
    write, count = Journal.record, [0]

    def record_and_interrupt(journal: Journal, lines: Any) -> None:
        write(journal, lines)
        count[0] += 1
        if count[0] == 4:
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "record", record_and_interrupt)
        assert run.carry_out(asked, tmp_path / "parts") == 143
    assert run.carry_out(asked, tmp_path / "parts", resume=True) == 0
    whole, parts = read(tmp_path / "whole"), read(tmp_path / "parts")
    for name in ("centers", "regularity", "improvement_potential", "bounded_potential"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))
    assert whole.bounded_potential is not None


def test_a_checkpoint_of_another_criterion_is_refused(tmp_path: Path) -> None:
    from rbfevo.errors import UserError

    assert run.carry_out(settings("nsga2"), tmp_path) == 0
    with pytest.raises(UserError, match="the settings differ from those of its checkpoint"):
        run.carry_out(settings("nsga2", criterion_norm=P), tmp_path, resume=True)


def test_with_norm_2_nothing_is_new(tmp_path: Path) -> None:
    assert run.carry_out(settings("gradient"), tmp_path) == 0
    record = read(tmp_path)
    assert record.bounded_potential is None
    assert record.summary["criterion_norm"] == 2.0
    assert record.potential is record.improvement_potential
    assert not isinstance(run.Run(settings("gradient")).full_evaluator, BoundedEvaluator)
    with np.load(tmp_path / "setups.npz") as setups:
        assert "bounded_potential" not in setups


def test_setups_that_are_not_finite_score_0_and_leave_the_others_alone() -> None:
    evaluate = run.Run(settings("gradient", criterion_norm=P)).full_evaluator
    assert isinstance(evaluate, BoundedEvaluator)
    C = torch.rand(2, 3, 4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    plain, broken = evaluate(C), C.clone()
    broken[0, 1, 2, 0] = torch.nan
    found = evaluate(broken)
    defined = evaluate.definition(broken)
    for scores in (found, defined):
        assert bool(scores.failed[0, 1])
        assert float(scores.improvement_potential[0, 1]) == 0.0
        assert int(scores.failed.sum()) == 1
    keep = ~found.failed
    torch.testing.assert_close(found.objectives[keep], plain.objectives[keep], rtol=0, atol=0)
    torch.testing.assert_close(found.objectives, defined.objectives, rtol=1e-6, atol=1e-7)
    spectrum = evaluate.spectrum(broken[0])
    assert float(spectrum.potential[1]) == 0.0
    m = C.shape[2]
    slope = spectrum.backward(torch.zeros(3, m, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    assert not slope[1].any()
    torch.testing.assert_close(slope[[0, 2]], evaluate.bounded.values_and_gradients(C[0])[1][[0, 2]])
    sharp = evaluate.spectrum(C[0]).backward(torch.ones(3, m, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    expected = evaluate.plain.spectrum(C[0]).backward(torch.ones(3, m, dtype=torch.float64), 0.0 * slope[:, 0, 0])
    torch.testing.assert_close(sharp, expected, rtol=0, atol=0)


def test_pictures_and_picks_are_of_what_was_searched(template: Path, tmp_path: Path) -> None:
    record = searched(tmp_path / "run", template, "method=random", "method.population=12")
    assert record.bounded_potential is not None
    axes = picture(record).axes[0]
    assert axes.get_ylabel() == "bounded potential (p = 16)"
    row = knee(record)
    assert row is not None
    assert row == pick(record, "knee")
    weighed = 0.3 * record.regularity + 0.7 * record.bounded_potential
    assert pick(record, "preference:0.3") == weighed.argmax()
    assert figures.draw(tmp_path / "run") == []
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert '"potential_name":"bounded potential (p = 16)"' in page.replace('": "', '":"')
    searched(tmp_path / "two", template, "method=random", "method.population=12", "criterion.norm=2")
    found, _ = members(tmp_path)
    assert len({member.settings["mesh"] for member in found}) == 2  # what does not compare


@pytest.mark.parametrize("value", ["1", "1.9", "-16", "inf", "nan", "text", "true", "[2,16]"])
def test_another_norm_is_a_mistake(value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"hydra.run.dir={tmp_path / 'run'}", f"criterion.norm={value}"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "criterion.norm=" in line
    assert "give a number of at least 2" in line


def test_other_forms_of_the_key(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert criterion_norm(None) == 2.0
    assert criterion_norm({"norm": 2}) == 2.0
    assert criterion_norm({"norm": 16}) == 16.0
    assert main([f"hydra.run.dir={tmp_path / 'run'}", "criterion=16"]) == 2
    assert "write criterion.norm=16" in capsys.readouterr().err
    assert main([f"hydra.run.dir={tmp_path / 'run'}", "criterion.nrm=16"]) == 2
    assert "did you mean criterion.norm?" in capsys.readouterr().err
    assert not (tmp_path / "run" / "setups.npz").exists()
    assert json.dumps(criterion_norm({"norm": 2.5})) == "2.5"
