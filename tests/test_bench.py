"""The benchmark's peer and floor do the work they claim, and its rows are well-formed; no time is looked at."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from rich.console import Console

from benchmarks import bench, bench_searches
from benchmarks.bench_cases import Case, kernel
from benchmarks.bench_floor import Floor
from benchmarks.bench_heuristics import lloyd_row, ols_row
from benchmarks.bench_memory import peaks, size_row
from benchmarks.bench_numpy import numpy_scores
from benchmarks.bench_rows import Row, Screen, at_least, at_most
from benchmarks.bench_scoring import floor_rows, gradient_row, scoring_row
from benchmarks.bench_searches import OurNSGA2, PymooNSGA2, cmaes_row, nsga2_row
from benchmarks.measure import in_child, interleaved, one_blas_thread, peak_memory
from rbfevo.scenarios import face, plane
from rbfevo.scoring.deformation import MANIPULATIONS
from rbfevo.scoring.kernels import Cubic, ThinPlate, Wendland

PLANE, FACE = plane((24, 24)), face(subdivisions=3)
CASES = [
    *(Case(PLANE, kernel(support, 2)) for support in (0.25, 0.5, None)),
    *(Case(FACE, kernel(support, 3)) for support in (0.5, 1.0, None)),
]
SMALL = CASES[0]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.parametrize("manipulation", MANIPULATIONS)
def test_numpy_peer_scores_as_the_definition(case: Case, manipulation: str) -> None:
    setups = case.population(8, m=9)
    X, g = case.scenario.vertices.numpy(), case.scenario.gradient.numpy()
    found = torch.from_numpy(numpy_scores(X, g, setups.numpy(), case.kernel.support, manipulation))
    exact = case.evaluator(manipulation).definition(setups)
    assert bool(((found[:, 0] - exact.regularity).abs() <= 1e-6 * exact.regularity + 1e-12).all())
    assert bool(((found[:, 1] - exact.improvement_potential).abs() <= 1e-8).all())
    assert bool((exact.regularity > 0).all())


@pytest.mark.parametrize("phi", [Wendland(0.5), ThinPlate(), Cubic()])
def test_floor_does_the_products_and_one_pass_over_all_entries(phi: Wendland | ThinPlate | Cubic) -> None:
    floor = Floor(n=100, m=3, k=2, kernel=phi, block=32)  # blocks of 32, 32, 32 and 4
    floor(5)
    source = torch.linspace(0.1, 2.0, 96, dtype=torch.float64).view(3, 32)
    entries = source.log() if isinstance(phi, ThinPlate) else source.sqrt()
    rows = torch.cat([torch.cat([part, torch.ones(2, part.shape[1])]) for part in (*[entries] * 3, entries[:, :4])], 1)
    steps, M = floor._scratch()
    assert sum(target.numel() for _, target, _, _ in steps) == 100 * 3
    torch.testing.assert_close(M, rows @ rows.T)


def test_both_nsga2_advance_alike() -> None:
    """From random populations both bring the mean of ZDT1's second objective down about as far."""
    means = []
    for search in (OurNSGA2(40, 10), PymooNSGA2(40, 10)):
        for _ in range(40):
            assert search() > 0
        F = -search.algorithm.objectives.numpy() if isinstance(search, OurNSGA2) else search.algorithm.pop.get("F")
        assert F.shape == (40, 2)
        means.append(F.sum(1).mean())
    assert means[0] == pytest.approx(means[1], rel=0.25)


def tiny(quick: bool) -> Iterator[Row]:
    """All kinds of rows on sizes that take no time."""
    assert quick
    yield scoring_row(SMALL, "direct", 1, population=8, m=4)
    yield from floor_rows(SMALL, 1, population=8, m=4)
    yield gradient_row(SMALL, "indirect", 1, population=8, m=4)
    yield size_row(0.5, 1, large=(30, 30), setups=1)
    yield nsga2_row(2, population=8, variables=4)
    yield cmaes_row(4, 1)
    yield lloyd_row(SMALL, 1, m=4)
    yield ols_row(SMALL, 1, m=4, per_axis=6)
    yield Row("cuda", "nothing here", None, "setups/s", note="not measured")


def test_rows_and_file_are_well_formed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "GROUPS", {"tiny": tiny})
    monkeypatch.setattr(bench_searches, "STRETCH", 1)
    text = io.StringIO()
    rows = bench.run(["tiny"], True, Screen(Console(file=text)), tmp_path / "bench.json")
    found = json.loads((tmp_path / "bench.json").read_text())
    assert found["quick"] is True
    assert found["groups"] == ["tiny"]
    assert {"processor", "cores", "threads", "versions"} <= set(found["machine"])
    assert found["targets_met"] + found["targets_missed"] == sum(row.met is not None for row in rows)
    assert len(found["rows"]) == len(rows) == 10
    for row, line in zip(rows, found["rows"], strict=True):
        assert set(line) == set(Row._fields)
        assert (line["value"] is None) == (row.value is None)
        assert row.value is None or row.value > 0
        assert (row.peer is None) == (row.ratio is None)
        assert bool(row.target) == (row.met is not None)
        assert row.name in text.getvalue()


@pytest.mark.parametrize("manipulation", MANIPULATIONS)
def test_peaks_of_memory(manipulation: str) -> None:
    before, after = peaks(0.5, manipulation, setups=10, resolution=[12, 12])
    assert 0 < before <= after


def test_a_child_has_a_peak_of_its_own() -> None:
    assert 0 < in_child(peak_memory) < peak_memory()


def test_interleaved_rounds_go_forth_and_back() -> None:
    calls = []

    def task(name: str, seconds: float) -> float:
        calls.append(name)
        return seconds

    tasks = [lambda: task("a", 1.0), one_blas_thread(lambda: task("b", 2.0))]
    assert interleaved(tasks, 3, pause=0.0).tolist() == [[1.0] * 3, [2.0] * 3]
    assert "".join(calls) == "ba" + "abbaab"


def test_targets() -> None:
    assert at_most(1.6, 1.6) == {"target": "<= 1.6", "met": True}
    assert at_most(1, 1.2, " s") == {"target": "<= 1 s", "met": False}
    assert at_least(40, 39.0) == {"target": ">= 40", "met": False}


def test_unknown_group_is_a_mistake(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as error:
        bench.main(["--only", "nothing"])
    assert error.value.code == 2
    assert "choose from" in capsys.readouterr().err
