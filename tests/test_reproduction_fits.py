"""The fits that ask whether it pays: which setups, tables that are made once, and what is made of them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import rankdata
from studies import TINY, began, full_study, put

from benchmarks.panels import PANELS
from rbfevo.fit import MANIPULATIONS, STRATEGIES
from rbfevo.runs.storage import csv_text, write_whole
from reproduction import fits, measures, pays, pays_page, runs
from reproduction.claims import CLAIMS
from reproduction.figures import fitted
from reproduction.fits import Group
from reproduction.study import KINDS, Setups, Study

GROUP = Group("plane", "wide")


def test_setups_are_spread_along_a_front() -> None:
    x = np.concatenate([np.linspace(0, 0.1, 50), np.linspace(0.2, 1, 9)])
    R, nothing = x, np.zeros_like(x)
    setups = Setups(np.zeros((len(x), 1, 2)), R, 1 - x, nothing, nothing)
    np.testing.assert_allclose(fits.spread(setups, 5).regularity, [0, 0.25, 0.5, 0.75, 1], atol=0.06)
    assert len(fits.spread(setups[np.arange(3)], 5).regularity) == 3


def test_fits_of_one_group_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    budget = TINY._replace(seeds=(0,), search_seeds=(0,), full=())
    out = began(tmp_path, monkeypatch, budget)
    panels = tuple(panel for panel in PANELS if panel.name.startswith("plane-wendland-0.5"))
    assert runs.carry_out(budget, out, lambda line: None, panels) == 0
    study = Study(out)
    centers, origins = fits.setups(study, GROUP)
    assert set(origins) == {"indirect front", "direct front", "random", "lloyd", "ols"}
    assert len(centers) == len(origins)

    (out / "fits").mkdir()
    assert "6 tables" in fits.carry_out_group(out, GROUP)
    assert fits.carry_out_group(out, GROUP) == "fits of plane wide: complete"
    mark = out / "fits" / "plane-wide.sha256"
    fits.forget_others(out, GROUP, study, centers + 1.0)  # the setups have changed: nothing of this is of use
    assert not list((out / "fits").glob("*.csv"))
    assert len(mark.read_text()) == 64
    assert "6 tables" in fits.carry_out_group(out, GROUP)
    rows = list(fits.tables(study))
    assert len(rows) == len(MANIPULATIONS) * len(STRATEGIES) * len(centers) * TINY.fit_seeds[0]
    for row in rows:
        if row["stop"] == "reached":
            assert float(row["error"]) <= 1.05 * float(row["optimum"])
        if row["manipulation"] == "orthogonalized":
            assert float(row["regularity"]) == pytest.approx(1.0, rel=1e-10)
    # the least error is the setup's own, whatever moves it
    optima: dict[str, set[float]] = {}
    for row in rows:
        if not row["stop"].startswith("not fitted"):
            optima.setdefault(row["setup"], set()).add(float(row["optimum"]))
    assert all(len(values) == 1 for values in optima.values())


def test_the_rank_correlation_is_spearman_with_an_interval_around_it() -> None:
    generator = np.random.default_rng(1)
    one = generator.normal(size=40).round(1)
    other = one + generator.normal(size=40).round(1)
    found = pays.rank(one, other)
    assert found.value == pytest.approx(measures.spearman(one, other), rel=1e-12)
    assert -1 <= found.low < found.value < found.high <= 1
    # a normal approximation for Fisher's z, whose variance is about 1.06 / (q - 3)
    width = np.arctanh(found.high) - np.arctanh(found.low)
    assert width == pytest.approx(2 * 1.96 * np.sqrt(1.06 / 37), rel=0.5)
    assert math.isnan(pays.rank(np.ones(9) + 1e-15 * np.arange(9), np.arange(9.0)).value)


def test_the_partial_rank_correlation_is_that_of_the_residuals() -> None:
    generator = np.random.default_rng(2)
    given = generator.normal(size=60)
    one, other = given + 0.3 * generator.normal(size=60), given + 0.3 * generator.normal(size=60)
    ranks = [rankdata(scores) for scores in (one, other, given)]
    r = np.corrcoef(ranks)
    expected = (r[0, 1] - r[0, 2] * r[1, 2]) / np.sqrt((1 - r[0, 2] ** 2) * (1 - r[1, 2] ** 2))
    assert pays.rank(one, other).value > 0.7
    assert pays.rank(one, other, given).value == pytest.approx(expected, rel=1e-10)


def table(out: Path, scenario: str, manipulation: str, strategy: str, R: np.ndarray, generations: np.ndarray) -> None:
    """Fits of three kernels as a table would hold them; P falls and the error rises with the number of the setup."""
    for i, kind in enumerate(KINDS):
        rows = []
        for setup, (r, g) in enumerate(zip(R, generations, strict=True)):
            for seed in (0, 1):
                key = (scenario, kind, manipulation, strategy, "random", setup, seed)
                error = 0.1 * (i + 1) + 0.01 * setup
                rows.append((*key, r / (i + 1), 1 - error, g * (i + 1) + seed, "reached", 1.0, error, error, 100))
        write_whole(Group(scenario, kind).path(out, manipulation, strategy), csv_text(fits.COLUMNS, rows))


def test_ranks_ratios_and_the_plain_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = full_study(tmp_path, monkeypatch)
    (study.out / "fits").mkdir()
    R = np.linspace(0.1, 0.9, 8)
    for scenario in ("plane", "face"):
        for strategy in STRATEGIES:
            table(study.out, scenario, "indirect", strategy, R, 100 / R)
            table(study.out, scenario, "direct", strategy, R, 50 / R)
            table(study.out, scenario, "orthogonalized", strategy, np.ones(8), np.array([9, 4, 7, 5, 8, 3, 6, 10]))
    study = Study(study.out)
    lines = {line[:4]: line for line in pays.correlations(study)}
    speed = lines["face", pays.ALL, "isotropic", "indirect"].speed
    assert speed.value == pytest.approx(-1.0)
    assert speed.setups == 24
    assert lines["face", "local", "cmaes", "indirect"].speed.value == -1.0
    assert math.isnan(lines["plane", "local", "cmaes", "orthogonalized"].speed.value)
    reach = lines["face", pays.ALL, "isotropic", "orthogonalized"].reach
    assert reach.low <= reach.value == pytest.approx(-1.0)
    changes = {line[:5]: line for line in pays.changes(study)}
    change = changes["plane", pays.ALL, "isotropic", "direct", "indirect"]
    assert change.ratio == pytest.approx(0.5, abs=0.01)
    assert (change.fewer, change.more, change.setups) == (1.0, 0.0, 24)

    text = "\n".join(pays_page.section(study))
    assert "could not be otherwise" in text
    assert "| face | all kernels | isotropic | indirect | -1.00" in text
    verdicts = {claim.key: claim.find(study).verdict for claim in CLAIMS}
    assert verdicts["regularity-predicts-speed"] == "holds"
    assert verdicts["direct-converges-faster"] == "holds"
    assert verdicts["potential-predicts-error"] == "holds"


def test_setups_that_cannot_be_fitted_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = full_study(tmp_path, monkeypatch)
    (study.out / "fits").mkdir()
    table(study.out, "plane", "direct", "cmaes", np.linspace(0.1, 0.9, 8), np.arange(8) + 5.0)
    path = Group("plane", "local").path(study.out, "direct", "cmaes")
    lines = path.read_text().splitlines()
    lines[1] = lines[1].replace("reached", "not fitted: Psi is numerically singular")
    path.write_text("\n".join(lines) + "\n")
    found = pays.fitted(Study(study.out), "plane", "direct", "cmaes")
    assert len(found.of("local").R) == 7
    assert len(found.R) == 23


def test_a_group_without_its_runs_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = Study(began(tmp_path, monkeypatch))
    put(study.out, PANELS[0], "lloyd", 0, Setups(*(np.zeros((1, 5, 2)), *np.zeros((4, 1)))))
    with pytest.raises(Exception, match="there is no run of gradient"):
        fits.setups(study, Group("plane", "local"))
    assert "There are no fits: `scripts/reproduce --only fits` makes them." in "\n".join(pays_page.section(study))


def test_the_picture_shows_every_fit_and_who_was_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = full_study(tmp_path, monkeypatch)
    (study.out / "fits").mkdir()
    R = np.linspace(0.1, 0.9, 8)
    for manipulation in MANIPULATIONS:
        table(study.out, "plane", manipulation, "isotropic", R, 100 / R)
    path = Group("plane", "wide").path(study.out, "direct", "isotropic")
    path.write_text(path.read_text().replace("reached", "generations"))
    picture = fitted.picture(Study(study.out), "caption")
    marks = [sum(np.shape(part.get_offsets())[0] for part in axes.collections) for axes in picture.axes]
    assert marks == [24, 24, 24, 0, 0, 0]
    texts = [text.get_text() for axes in picture.axes for text in axes.texts]
    assert texts == ["no fits there"] * 3
