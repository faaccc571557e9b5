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
    command = [
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
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "kills.csv").open() as file:
        reports = list(csv.DictReader(file))
    assert len(reports) == 5
    for report in reports:
        assert (report["kills"], report["damaged"], report["different"]) == ("1", "0", "0")
