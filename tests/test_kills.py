"""The short form of `python -m benchmarks.kills`: every search method is killed and goes on to the same end."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked and killed here")
def test_killed_searches_go_on_to_the_same_end(tmp_path):
    words = [
        sys.executable,
        "-m",
        "benchmarks.kills",
        "--kills",
        "1",
        "--seed",
        "7",
        "--output",
        str(tmp_path / "kills.csv"),
    ]
    done = subprocess.run(words, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "kills.csv").open() as file:
        reports = list(csv.DictReader(file))
    assert len(reports) == 5
    for report in reports:
        assert (report["kills"], report["damaged"], report["different"]) == ("1", "0", "0")


def test_the_page_tells_what_the_table_says():
    with (ROOT / "benchmarks" / "kills.csv").open() as file:
        reports = list(csv.DictReader(file))
    total = {key: sum(int(report[key]) for report in reports) for key in reports[0] if key != "method"}
    assert (total["damaged"], total["different"]) == (0, 0)
    page = (ROOT / "docs" / "reliability.md").read_text()
    assert f"{total['kills']} processes killed" in page
    assert f"| {total['while_writing']}; before the first checkpoint: {total['before_first']}" in page
