"""One setup of a run, in a word, against plain loops; and no torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rbfevo.errors import UserError
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, knee

ROOT = Path(__file__).parents[1]


def record(regularity: list[float], potential: list[float], nondominated: list[int] | None = None) -> Record:
    p = len(regularity)
    flags = np.zeros(p, dtype=bool)
    flags[nondominated if nondominated is not None else []] = True
    return Record(
        centers=np.zeros((p, 3, 2)),
        regularity=np.array(regularity),
        improvement_potential=np.array(potential),
        method=np.full(p, "nsga2"),
        preference=np.full(p, np.nan),
        nondominated=flags,
        vertices=np.zeros((4, 2)),
        faces=np.zeros((0, 3), np.int64),
        gradient=np.zeros((4, 1)),
        weights=np.ones(4),
        lower=np.zeros(2),
        upper=np.ones(2),
        summary={},
    )


R = [0.1, 0.5, 0.45, 0.5, np.nan, 0.2, 0.9]
P = [0.99, 0.6, 0.9, 0.7, 1.0, 0.99, np.nan]
FOUND = record(R, P, [2, 3, 5])


def test_picks() -> None:
    assert pick(FOUND, "best-regularity") == 3  # 1 has the same R and a lower P
    assert pick(FOUND, "best-improvement-potential") == 5
    assert pick(FOUND, "knee") == knee(FOUND) == 2
    assert pick(FOUND, "index:0") == 0
    assert pick(FOUND, " index:5 ") == 5


@pytest.mark.parametrize(("share", "row"), [("1", 5), ("0.95", 5), ("0.91", 5), ("0.9", 2), ("0.7", 3), ("0", 3)])
def test_the_most_regular_setup_with_a_share_of_the_best_potential(share: str, row: int) -> None:
    """The best P is 0.99; 2 has 0.9, 0.909 of it; 3 has 0.7, 0.707 of it, and the best R."""
    assert pick(FOUND, f"potential:{share}") == row


@pytest.mark.parametrize("preference", [0.0, 0.2, 0.5, 0.77, 1.0])
def test_a_preference_picks_the_best_of_equation_9(preference: float) -> None:
    scores = [(preference * r + (1 - preference) * p, -i) for i, (r, p) in enumerate(zip(R, P, strict=True))]
    best = -max(score for score in scores if score[0] == score[0])[1]
    assert pick(FOUND, f"preference:{preference}") == best


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ("index:7", "choose one from 0 to 6"),
        ("index:-1", "choose one from 0 to 6"),
        ("index:1.5", "choose one from 0 to 6"),
        ("index:", "choose one from 0 to 6"),
        ("index:4", "no finite centers and scores"),
        ("preference:1.5", "a number from 0"),
        ("preference:nan", "a number from 0"),
        ("preference:x", "a number from 0"),
        ("potential:1.01", "a number from 0 to 1, a share of the best"),
        ("potential:", "a number from 0 to 1, a share of the best"),
        ("nee", "choose one of knee, best-regularity, best-improvement-potential, potential:SHARE, index:ROW"),
        ("knee:3", "choose one of"),
        ("index", "choose one of"),
        ("", "choose one of"),
    ],
)
def test_a_pick_that_does_not_exist_is_one_line_with_what_there_is(choice: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        pick(FOUND, choice)
    assert "\n" not in str(error.value)


def test_without_a_front_or_without_scores() -> None:
    with pytest.raises(UserError, match="nondominated"):
        pick(record(R, P), "knee")
    with pytest.raises(UserError, match="no setup has finite centers and scores"):
        pick(record([np.nan], [0.5]), "knee")
    broken = record(R, P)
    broken.centers[3] = np.nan
    assert pick(broken, "best-regularity") == 1


def test_records_and_picks_need_no_torch() -> None:
    heavy = ("torch", "matplotlib", "pyvista")
    code = f"import sys, rbfevo.recorded.picks; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "[]", done.stderr
