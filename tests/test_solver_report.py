"""What docs/solver.md tells of descents: reductions, adjoint solutions, and what was aimed at, on made-up lines."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from benchmarks.solver import __main__ as command
from benchmarks.solver.report import Descent, Verdict, correlations, descents, strategies, table, verdicts, write

FIRST = 200.0


def lines(
    setup: str, size: str, best: list[float], radius: float = 2.0, rule: str = "max-norm"
) -> list[dict[str, Any]]:
    of = {"case": "diffuser", "setup": setup, "size": size, "centers": {"few": 5, "many": 16}[size], "radius": radius}
    quality = [{"non_orthogonality": 40.0 + i, "skewness": 1.0 + 0.1 * i, "J": J + 1.0} for i, J in enumerate(best)]
    return [of | {"rule": rule, "solution": i, "best": J} | quality[i] for i, J in enumerate(best)]


def steady(last: float, at: int = 3) -> list[float]:
    """J that falls evenly within `at` solutions, and stays."""
    return [FIRST + (last - FIRST) * min(i, at) / at for i in range(11)]


@pytest.fixture
def made() -> list[Descent]:
    """The recommendation falls by 9.5 %, Lloyd by 8 and 6, grids by 5, sixteen by 10."""
    entries = [
        *lines("advised", "few", steady(181.0)),
        *lines("advised", "few", steady(170.0), radius=1.0),  # not the recommended radius
        *lines("Lloyd 0", "few", steady(188.0)),
        *lines("Lloyd 1", "few", steady(184.0), radius=1.0),
        *lines("2x2x1", "few", steady(190.0)),
        *lines("advised", "few", steady(186.0, 6), rule="steepest"),
        *lines("Lloyd 0", "many", steady(180.0, 9)),
    ]
    return descents([{key: str(value) for key, value in entry.items()} for entry in entries])


def test_reductions_and_solutions_are_counted_from_the_first_design(made: list[Descent]) -> None:
    advised = made[0]
    assert advised.reduction() == pytest.approx(9.5)
    assert advised.reduction(1) == pytest.approx(9.5 / 3)
    assert [advised.solutions_to(J) for J in (200.0, 194.0, 193.0, 181.0)] == [0, 1, 2, 3]
    assert math.isinf(advised.solutions_to(180.9))
    assert advised.worst == pytest.approx((50.0, 2.0))
    shown = table(made, "diffuser").splitlines()
    assert len(shown) == 2 + len(made)
    cells = [cell.strip() for cell in shown[2].split("|")[1:-1]]
    assert cells[:7] == ["advised", "5", "2", "max-norm", "3.17", "9.50", "9.50"]
    assert cells[7] == "more than 10"  # 90 % of 15 % are 13.5 %
    assert [cell.strip() for cell in shown[3].split("|")[1:-1]][7] == "3"


def test_where_lloyds_few_are_ahead_of_all_sixteen_these_are_what_counts(made: list[Descent]) -> None:
    ahead = [one for one in made if one.setup != "Lloyd 0"]
    best, worse = (
        [*ahead, *descents(lines("Lloyd 0", "few", steady(179.0)) + lines("Lloyd 0", "many", steady(last)))]
        for last in (182.0, 180.0)
    )
    judged = [verdicts(found, "diffuser")[2] for found in (best, worse)]  # the recommendation is at 181
    assert [gap.reached for gap in judged] == [True, False]
    assert all("there is no gap" in gap.numbers for gap in judged)


def test_aims_are_judged_by_the_recommended_radius_and_the_best_of_the_others(made: list[Descent]) -> None:
    lloyd, grid, gap, rule = verdicts(made, "diffuser")
    assert lloyd == Verdict("diffuser", "few: above the best of Lloyd", True, "9.50 % against 8.00 % (Lloyd 1, r 1)")
    assert grid.reached is True
    assert gap.reached is True  # 8, 9.5, 10
    assert "75 % of it" in gap.numbers
    assert rule.reached is True
    assert "3 against 6" in rule.numbers  # 186 is reached after 2.33 of 3 even steps
    worse = [one._replace(best=tuple(steady(185.0))[1:]) if one is made[0] else one for one in made]
    lloyd, grid, gap, rule = verdicts(worse, "diffuser")
    assert (lloyd.reached, grid.reached, gap.reached) == (False, True, False)
    slower = [one._replace(best=tuple(steady(182.0, 8))[1:]) if one is made[0] else one for one in made]
    assert verdicts(slower, "diffuser")[3].reached is False  # 7 against 6
    assert [v.reached for v in verdicts(made[2:3], "diffuser")] == [None, None, None, None]


def test_an_evolution_strategy_is_judged_by_medians() -> None:
    def evolved(size: str, seed: int, at: int) -> list[dict[str, Any]]:
        return [{"size": size, "seed": str(seed), "best": str(9.0 if i < at else 5.0)} for i in range(1, 101)]

    few = [line for seed, at in ((1, 30), (2, 40), (3, 90)) for line in evolved("few", seed, at)]
    many = [line for seed, at in ((1, 80), (2, 100), (3, 85)) for line in evolved("many", seed, at)]
    verdict = strategies([*few, *many])
    assert verdict.reached is True
    assert "40 to 5" in verdict.numbers
    assert "85 to 5" in verdict.numbers
    assert strategies([*evolved("few", 1, 43), *many]).reached is False
    assert strategies(few).reached is None


def test_correlations_are_those_of_ranks(made: list[Descent]) -> None:
    own = [one for one in made if one.rule == "max-norm"]
    known = [
        {"case": one.case, "setup": one.setup, "size": one.size, "radius": str(one.radius), "R": str(-one.reduction()),
         "P_raw": str(one.reduction() ** 2), "P_smooth": "1", "P16_raw": "0.5", "P16_smooth": str(one.reduction())}
        for one in own
    ]  # fmt: skip
    (line,) = [line for line in correlations(made, known, after=(10,)).splitlines() if line.startswith("| diffuser")]
    cells = [cell.strip() for cell in line.split("|")[1:-1]]
    assert cells == ["diffuser", "6", "10", "-1.00", "1.00", "nan", "nan", "1.00"]


def test_the_page_has_the_tables_between_its_markers(made: list[Descent], tmp_path: Path) -> None:
    page = tmp_path / "solver.md"
    names = ("aims", "descents of diffuser", "correlations")
    page.write_text("".join(f"<!-- {name} -->\nold\n<!-- end of {name} -->\nkept\n" for name in names))
    write(made, [], [], page)
    text = page.read_text()
    assert "old" not in text
    assert text.count("kept") == 3
    assert "| diffuser | few: above the best of Lloyd | reached |" in text
    assert "| elastic | evolution strategy" in text
    page.write_text("none")
    with pytest.raises(SystemExit, match="no marker"):
        write(made, [], [], page)


def test_the_tables_of_the_page_are_those_on_disk(tmp_path: Path) -> None:
    text = command.PAGE.read_text(encoding="utf-8")
    page = tmp_path / "solver.md"
    page.write_text(text, encoding="utf-8")
    found = descents(command.read_table(command.TABLE))
    assert found
    write(found, command.read_table(command.KNOWN), command.read_table(command.STRATEGIES), page)
    assert page.read_text(encoding="utf-8") == text


def test_lines_of_the_table_stay_where_no_file_has_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "RUNS", tmp_path / "runs")
    kept, replaced = lines("Lloyd 0", "few", steady(188.0)), lines("advised", "few", steady(182.0))
    command.write(tmp_path / "solver.csv", [*kept, *replaced])
    (tmp_path / "runs" / "diffuser").mkdir(parents=True)
    command.write(tmp_path / "runs" / "diffuser" / "advised.csv", lines("advised", "few", steady(170.0)))
    found = descents(command.collected("*.csv", tmp_path / "solver.csv"))
    assert {one.setup: one.best[-1] for one in found} == {"advised": 170.0, "Lloyd 0": 188.0}
    assert all(len(one.best) == 10 for one in found)
