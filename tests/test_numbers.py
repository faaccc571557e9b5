"""The numbers of docs/reliability-numbers.md: the many digits are mpmath's, and the page is what the tables say."""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path

import pytest
import torch
from designs import EPS, Design, exact_scores

from benchmarks import numbers
from benchmarks.digits import exact
from rbfevo.scoring.deformation import MANIPULATIONS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", numbers.KERNELS)
@pytest.mark.parametrize(("case", "h"), [("spread", 0.0), ("pair", 1e-9), ("three", 1e-5)])
def test_many_digits_are_those_of_mpmath(name: str, case: str, h: float) -> None:
    kernel = numbers.KERNELS[name]
    some = numbers.design(numbers.dimension(kernel), 36)
    C = numbers.setup(kernel, 4, case, h)
    assert C is not None
    found = exact(kernel, C, some)
    weighted = Design(some.vertices, some.gradient, torch.ones(36, dtype=torch.float64))
    for manipulation in MANIPULATIONS:
        R, P = exact_scores(weighted, kernel, manipulation, C)
        assert getattr(found, manipulation) == pytest.approx(R, rel=1e-15)
        assert found.potential == pytest.approx(P, rel=1e-15)
    assert found.of_phi == pytest.approx(1.0 / found.indirect, rel=1e-15)


@pytest.mark.parametrize("name", numbers.KERNELS)
def test_a_center_twice_counts_once(name: str) -> None:
    kernel = numbers.KERNELS[name]
    some = numbers.design(numbers.dimension(kernel), 36)
    C = numbers.setup(kernel, 5, "duplicate")
    assert C is not None
    found = exact(kernel, C, some)
    assert (found.indirect, found.direct, found.of_phi) == (0.0, 0.0, math.inf)
    assert found.potential == exact(kernel, C[:4], some).potential


def lines() -> list[dict[str, str]]:
    with numbers.TABLE.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_cells_of_the_table_are_measured_again() -> None:
    """A part of the table, measured anew on this processor: what the page says of it holds here too."""
    saved = {(line["kernel"], line["manipulation"], line["m"], line["case"], line["wanted"]): line for line in lines()}
    kernels = list(numbers.KERNELS)
    cells = [(kernels[0], 25, "pair", "1e6"), (kernels[1], 5, "three", "1e10"), (kernels[2], 5, "pair", "1e13")]
    for name, m, case, wanted in cells:
        C = numbers.conditioned(numbers.KERNELS[name], m, case, float(wanted))
        assert C is not None
        for found in numbers.measured(name, m, case, wanted, C):
            line = saved[name, found["manipulation"], str(m), case, wanted]
            # The bisection ends on the roundings of this machine's SVD: the same setup but for its last digits.
            assert found["cond_Phi"] == pytest.approx(float(line["cond_Phi"]), rel=0.1)
            now = {key: str(value) for key, value in found.items()}
            for path in numbers.PATHS:
                assert numbers.cut(now, path) == numbers.cut(line, path)
                assert numbers.within(now, path) or numbers.condition(now) > 1e9
                if not numbers.cut(now, path):  # beyond, a rounding of eps turns the range of Phi by eps cond(Phi)
                    of_R, of_P = numbers.error(now, path)
                    assert of_R <= 10 * EPS * numbers.condition(now)
                    assert of_P <= 10 * EPS * numbers.condition(now)


def test_units_change_only_the_thin_plate() -> None:
    found = list(numbers.in_units(exponents=(0, -6, 5)))
    for one, *others in (found[i : i + 3] for i in range(0, len(found), 3)):
        assert one["exponent"] == 0
        for entry in others:
            for score in (f"{score}_{path}" for score in "RP" for path in numbers.PATHS):
                change = abs(entry[score] / one[score] - 1.0)
                assert change > 1e-4 if entry["kernel"] == "r^2 log r" else change <= 1e-9


def test_the_tables_of_the_page_are_those_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = numbers.PAGE.read_text(encoding="utf-8")
    page = tmp_path / "page.md"
    page.write_text(wanted, encoding="utf-8")
    monkeypatch.setattr(numbers, "PAGE", page)
    monkeypatch.setattr(sys, "argv", ["numbers", "--page"])
    assert numbers.main() == 0
    assert page.read_text(encoding="utf-8") == wanted
    assert "| r^2 log r | direct |" in wanted
