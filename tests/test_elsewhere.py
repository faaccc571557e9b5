"""The measurements of docs/elsewhere.md on tiny meshes: derivatives, scores, descents, correlations, tables."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import spearmanr

from benchmarks.elsewhere import cases, tables
from benchmarks.elsewhere.__main__ import PAGE, TABLE, read
from benchmarks.elsewhere.cases import Case
from benchmarks.elsewhere.descents import at, descend, least_squares
from benchmarks.elsewhere.setups import grid, on_surface, placed, scores, wanted
from rbfevo.__main__ import main as rbfevo
from rbfevo.recorded.moves import RULES
from rbfevo.recorded.record import Record
from rbfevo.recorded.record import read as read_run
from rbfevo.recorded.setup import setup

TINY: dict[str, Callable[[], Case]] = {
    "car": lambda: cases.car(0.2),
    "winged": lambda: cases.winged((12, 8, 4)),
    "lumpy": lambda: cases.lumpy(2),
    "reflector": lambda: cases.reflector(6),
    "plane": lambda: cases.plane(10),
    "face": lambda: cases.face(2),
}


def a_run(case: Case, tmp_path: Path, *overrides: str, count: int = 4) -> Record:
    common = [*case.overrides, f"kernel.support={case.radii[1]}", f"centers={count}", "manipulation=direct"]
    if not case.target:
        case.save(tmp_path / "template.vtp")
        common.append(f"scenario.template={tmp_path / 'template.vtp'}")
    assert rbfevo([*common, *overrides, "figures=false", "quiet=true", f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    return read_run(tmp_path / "run")


@pytest.mark.parametrize("name", TINY)
def test_the_sensitivities_are_derivatives(name: str) -> None:
    case, generator = TINY[name](), np.random.default_rng(0)
    u = 0.02 * case.radii[0] * generator.normal(size=(len(case.vertices), case.components))
    _, s = case.sensitivity(u)
    for _ in range(3):
        direction = generator.normal(size=u.shape)
        step = 1e-6
        above, below = (case.sensitivity(u + sign * step * direction)[0] for sign in (1.0, -1.0))
        assert (above - below) / (2.0 * step) == pytest.approx(float((s * direction).sum()), rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("name", ["car", "plane"])
def test_the_scores_are_those_of_the_run(name: str, tmp_path: Path) -> None:
    case = TINY[name]()
    record = a_run(case, tmp_path, "method=random", "method.population=3", "criterion.norm=16")
    assert record.bounded_potential is not None
    np.testing.assert_allclose(record.vertices, case.vertices, atol=1e-6)
    fields = {"raw": wanted(case, record, smooth=False)}
    for row in range(3):
        found = scores(setup(record, row), record, fields)
        assert found["R"] == pytest.approx(record.regularity[row], rel=1e-6)
        assert found["P_raw"] == pytest.approx(record.improvement_potential[row], rel=1e-6)
        assert found["P16_raw"] == pytest.approx(record.bounded_potential[row], rel=1e-5)


@pytest.mark.parametrize("rule", RULES)
def test_a_descent_lowers_the_objective(rule: str, tmp_path: Path) -> None:
    case = TINY["lumpy"]()
    record = a_run(case, tmp_path, "method=random", "method.population=1")
    found = descend(case, record, setup(record, 0), rule, case.reaches["r/4"])
    assert 0.0 < found["after_1"] < found["after_4"] < found["after_10"] < 100.0
    near = descend(case, record, setup(record, 0), rule, 1e-4)
    assert near["ratio"] == pytest.approx(1.0, abs=1e-2)


def test_the_first_reduction_is_that_of_one_step(tmp_path: Path) -> None:
    from rbfevo.recorded.moves import wanted_move

    case = TINY["reflector"]()
    record = a_run(case, tmp_path, "method=random", "method.population=1")
    start, here = at(case, record, np.zeros((len(case.vertices), 3)))
    diagonal = float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    move = wanted_move(here, setup(record, 0), 0.01 / diagonal, "natural")
    assert np.linalg.norm(move.reached, axis=1).max() == pytest.approx(0.01)
    gained = 100.0 * (1.0 - case.sensitivity(move.reached)[0] / start)
    assert descend(case, record, setup(record, 0), "natural", 0.1)["after_1"] == pytest.approx(gained)


def test_improvement_potential_is_the_reduction_by_least_squares(tmp_path: Path) -> None:
    case = TINY["plane"]()
    record = a_run(case, tmp_path, "method=random", "method.population=1")
    found = least_squares(case, record, setup(record, 0))
    assert found == pytest.approx(100.0 * record.improvement_potential[0], rel=1e-9)


def test_grids_and_centers_on_the_surface_lie_on_their_side(tmp_path: Path) -> None:
    case = TINY["car"]()
    record = a_run(case, tmp_path, "method=lloyd", count=6)
    centers = grid(record, 12)
    assert centers.shape == (12, 3)
    assert len(np.unique(centers.round(9), axis=0)) == 12
    side = np.sign(record.centers[0, :, 1].sum())
    chosen = on_surface(record)
    assert (side * chosen[:, 1] > -1e-6).all()
    assert (np.linalg.norm(record.vertices[:, None] - chosen, axis=2).min(0) == 0.0).all()
    again, found = placed(record, chosen)
    assert found.row == 0
    np.testing.assert_allclose(again.centers[0], chosen)


def test_spearman_is_that_of_scipy() -> None:
    generator = np.random.default_rng(1)
    a, b = generator.integers(0, 6, 30).astype(float), generator.normal(size=30)
    assert tables.spearman(a, a + 3.0 * b) == pytest.approx(float(spearmanr(a, a + 3.0 * b)[0]))  # pyright: ignore
    assert tables.spearman(np.append(a, np.nan), np.append(b, 1.0)) == pytest.approx(tables.spearman(a, b))
    assert np.isnan(tables.spearman(np.ones(5), b[:5]))


def made(setup: str, centers: str, known: float, reduction: float) -> tables.Entry:
    entry = {"case": "car", "reach": "r/4", "setup": setup, "centers": centers, "radius": "1", "least_squares": ""}
    entry |= {key: str(known) for key in tables.KNOWN} | {"P16_smooth": str(-known)}
    for rule in RULES:
        entry |= {f"{rule}_after_{count}": str(reduction) for count in (1, 4, 10)} | {f"{rule}_ratio": "0.5"}
    return entry


def test_tables_by_value() -> None:
    few = [made("Lloyd 0", "4", 0.1, 1.0), made("random 0", "4", 0.2, 2.0), made("P knee", "4", 0.3, 3.0)]
    many = [made("Lloyd 0", "12", 0.5, 9.0), made("random 0", "12", 0.6, 8.0), made("P knee", "12", 0.7, 7.0)]
    entries = [*few, *many, dict(few[0])]  # the last is a duplicate
    assert tables.within(tables.series(entries)["car"], "R", "natural_after_4") == pytest.approx(0.0)
    assert tables.within(few, "P16_smooth", "natural_after_4") == pytest.approx(-1.0)
    assert tables.overall([*few, *many], "R", "natural_after_4") == pytest.approx(
        float(spearmanr([1, 2, 3, 4, 5, 6], [1, 2, 3, 9, 8, 7])[0])  # pyright: ignore
    )
    assert np.isnan(tables.blind(few, "R", "natural_after_4"))  # two setups are left
    found = tables.tables(entries)
    assert found["all"].splitlines()[2] == "| max-norm | car | **0.77** | **0.77** | **0.77** | **0.77** | -0.77 |"
    assert "| car | 6 | 0.50 (0.50 to 0.50) |" in found["steps"]
    assert (
        found["margins"].splitlines()[2] == "| car | +nan / +nan | +nan / +nan | 0 of 0 | 0 of 0 |"
    )  # no searches for P_16
    assert found["families"].splitlines()[2].startswith("| car | 4 | 1 |  |  | 2 |  |  |  | **3** |")
    page = tables.fill("a\n<!-- all -->\nold\n<!-- end of all -->\nb\n", entries)
    assert page == f"a\n<!-- all -->\n{found['all']}\n<!-- end of all -->\nb\n"


def test_the_page_is_that_on_disk() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert tables.fill(text, read(TABLE)) == text
    assert text.count("<!-- end of ") == 11
