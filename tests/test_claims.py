"""Claims: the rule of the verdicts, claims on numbers whose answer is known, and the page."""

from __future__ import annotations

import csv
import shlex
from pathlib import Path

import numpy as np
import pytest
from studies import TINY, began, drawn, full_study, put

from benchmarks.panels import PANELS
from reproduction import page, runs
from reproduction.claims import CLAIMS, Case, Claim
from reproduction.claims.claim import FAILS, HOLDS, IN_PART, UNTESTED
from reproduction.study import Setups, Study, panels_of

BY_KEY = {claim.key: claim for claim in CLAIMS}


@pytest.mark.parametrize(
    ("good", "verdict"), [(10, HOLDS), (9, HOLDS), (8, IN_PART), (4, IN_PART), (3, FAILS), (0, FAILS)]
)
def test_the_verdict_follows_from_the_share_of_cases(good: int, verdict: str) -> None:
    cases = [Case(f"panel {i}", 0, float(i), i < good) for i in range(10)]
    claim = Claim("key", "1", "Is so.", "a number", "> 0", ("random",), lambda _: cases, {verdict: "of a reason."})
    finding = claim.find(None)  # pyright: ignore[reportArgumentType]
    assert finding.verdict == verdict
    assert f"{good} of 10" in finding.why
    assert (finding.good, finding.places) == (good, 10)
    assert finding.why.endswith("of a reason.")
    assert "panel 9" in finding.why or good in (0, 10) or good < 4


def test_a_place_has_one_vote_and_what_stands_beside_has_none() -> None:
    cases = [Case("a", seed, 1.0, seed < 2) for seed in range(3)] + [Case("b", 0, 1.0, True)]
    cases += [Case("beside", 0, 1.0, False, counts=False)]
    claim = Claim("key", "1", "Is so.", "a number", "> 0", ("random",), lambda _: cases, {})
    finding = claim.find(None)  # pyright: ignore[reportArgumentType]
    assert (finding.verdict, finding.good, finding.places) == (HOLDS, 2, 2)
    assert len(finding.cases) == 5


def test_claims_are_complete_and_told_apart() -> None:
    assert len(CLAIMS) >= 40
    assert len(BY_KEY) == len(CLAIMS)
    for claim in CLAIMS:
        assert claim.statement.endswith(".")
        assert claim.quantity
        assert claim.criterion
        assert claim.section


def test_without_results_nothing_can_be_tested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = Study(began(tmp_path, monkeypatch))
    assert {claim.find(study).verdict for claim in CLAIMS} == {UNTESTED}


def replaced(study: Study, panel, method: str, seed: int, **columns) -> None:
    """Change columns of a series that is there."""
    setups = drawn(panel, method, seed)._replace(**columns)
    directory = runs.Task(panel, method, seed).directory(study.out)
    for file in directory.iterdir():
        file.unlink()
    directory.rmdir()
    put(study.out, panel, method, seed, setups, study.budget)


def test_known_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = full_study(tmp_path, monkeypatch)
    # drawn: Lloyd's R is 0.9 sin(0.05), random setups' at most 0.1
    found = BY_KEY["lloyd-beats-random"].find(study)
    ratio = {(case.where, case.seed): case.value for case in found.cases}
    for panel in PANELS:
        random = drawn(panel, "random", 1).regularity.max()
        assert ratio[panel.name, 1] == pytest.approx(0.9 * np.sin(0.05) / random)
    share = np.mean([case.value > 1 for case in found.cases])
    assert found.verdict == (HOLDS if share >= 0.9 else IN_PART if share >= 1 / 3 else FAILS)

    # the same front for both: CMA-ES's preferred setups cannot be beyond it by more than its own spacing
    reaches = BY_KEY["reaches"].find(study)
    assert all(case.value <= 0.05 for case in reaches.cases)
    assert BY_KEY["smooth"].find(study).verdict == HOLDS
    assert BY_KEY["sphere-like-plane-shape"].find(study).verdict == HOLDS
    assert BY_KEY["lloyd-robust"].find(study).verdict == HOLDS  # the same R for both seeds
    assert BY_KEY["variability-manipulation"].find(study).verdict == HOLDS


def test_a_changed_series_changes_the_verdict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = full_study(tmp_path, monkeypatch)
    for panel in panels_of("face", "triharmonic", "direct"):
        for seed, R in ((0, 0.99), (1, 0.95)):
            replaced(study, panel, "lloyd", seed, regularity=np.array([R]))
    study = Study(study.out)
    assert BY_KEY["lloyd-beats-optimizers"].find(study).verdict == HOLDS
    (panel,) = panels_of("face", "triharmonic", "direct")
    replaced(study, panel, "lloyd", 0, regularity=np.array([0.5]))
    assert BY_KEY["lloyd-beats-optimizers"].find(Study(study.out)).verdict == FAILS


def test_uniform_centers_are_told_from_random_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = full_study(tmp_path, monkeypatch)
    grid = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0], [0.0, 2.0], [1.0, 2.0]])[None]
    for panel in panels_of("plane", manipulation="indirect"):
        for seed in (0, 1):
            replaced(study, panel, "lloyd", seed, centers=grid)
            replaced(
                study, panel, "gradient", seed, centers=np.repeat(grid, 12, 0), regularity=np.linspace(0.1, 0.99, 12)
            )
    found = BY_KEY["regular-indirect-uniform"].find(Study(study.out))
    assert {case.value for case in found.cases if case.where.startswith("plane")} == {1.0}
    assert {case.value for case in found.cases if case.where.startswith("face")}.isdisjoint({1.0})


def test_the_page_has_every_claim_and_every_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = full_study(tmp_path, monkeypatch)
    (tmp_path / "figure3.png").write_bytes(b"")
    findings = page.write(study, {"figure3.png": "Fronts on the plane.", "figure9.png": "Not drawn."})
    text = (tmp_path / "claims.md").read_text()
    for number, claim in enumerate(CLAIMS, 1):
        assert f"### {number}. {claim.statement}" in text
        assert f"(#{claim.key})" in text
        assert f'<a id="{claim.key}"></a>' in text
        assert findings[claim.key].why in text
    assert "![figure3.png](figure3.png)" in text
    assert "figure9" not in text
    assert "--budget tiny" in text
    assert "reference point (0, 0)" in text
    with (tmp_path / "claims.csv").open() as file:
        cases = list(csv.DictReader(file))
    assert len(cases) == sum(len(finding.cases) for finding in findings.values())
    with (tmp_path / "runs.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(runs.tasks(study.budget)) + len(PANELS) * 2
    commands = {row["command"] for row in table}
    assert f"python -m rbfevo {shlex.join(runs.tasks(study.budget)[0].arguments)}" in commands
    with (tmp_path / "setups" / f"{PANELS[3].name}.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["method"] == "cmaes" and row["seed"] == "1"]
    np.testing.assert_array_equal([float(row["regularity"]) for row in rows], drawn(PANELS[3], "cmaes", 1).regularity)


def test_setups_know_their_front_and_its_ends() -> None:
    centers = np.arange(12.0).reshape(6, 1, 2)
    R, P = np.array([0.1, 0.5, 0.5, 0.9, 0.2, 0.9]), np.array([0.8, 0.6, 0.7, 0.1, 0.3, 0.1])
    setups = Setups(centers, R, P, R, R)
    np.testing.assert_array_equal(setups.front.objectives, [[0.1, 0.8], [0.5, 0.7], [0.9, 0.1]])
    assert (setups.most_regular, setups.most_improvable) == (3, 0)
    assert TINY.overrides("plane") == TINY.plane
