"""`python -m rbfevo.collect DIR`: its files, its words and its exit codes, on synthetic runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from test_sweep import a_run, square

from rbfevo import collect


@pytest.fixture
def sweep_directory(tmp_path) -> Path:
    """Two manipulations, two seeds."""
    for number, (manipulation, seed) in enumerate([("direct", 0), ("direct", 1), ("indirect", 0), ("indirect", 1)]):
        area = {"direct": 0.25, "indirect": 0.16}[manipulation]
        square(tmp_path / "sweep" / str(number), area, manipulation=manipulation, seed=seed)
    return tmp_path / "sweep"


def rows(path: Path) -> list[str]:
    return path.read_text().splitlines()[1:]


def test_a_sweep_is_collected_into_two_tables_a_page_and_a_few_sentences(sweep_directory, capsys):
    assert collect.main([str(sweep_directory)]) == 0
    assert len(rows(sweep_directory / "runs.csv")) == 8  # all and gradient
    assert len(rows(sweep_directory / "medians.csv")) == 4
    out, err = capsys.readouterr()
    assert err == ""
    assert "manipulation, by median hypervolume: direct beats indirect in the only pair, by a factor of 1.56" in out
    assert out.splitlines()[-1] == f"4 runs; written in {sweep_directory}: runs.csv, medians.csv, report.html"


def test_a_sweep_that_grows_is_collected_again(sweep_directory):
    assert collect.main([str(sweep_directory)]) == 0
    square(sweep_directory / "4", 0.09, manipulation="indirect", seed=2)
    assert collect.main([str(sweep_directory)]) == 0
    assert len(rows(sweep_directory / "runs.csv")) == 10
    assert ",2,3," not in rows(sweep_directory / "medians.csv")[0]
    assert sorted(path.name for path in sweep_directory.iterdir()) == [
        "0",
        "1",
        "2",
        "3",
        "4",
        "medians.csv",
        "report.html",
        "runs.csv",
    ]


def test_the_tables_can_go_elsewhere(sweep_directory, tmp_path):
    out = tmp_path / "made" / "here"
    assert collect.main([str(sweep_directory), "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["medians.csv", "report.html", "runs.csv"]
    assert not (sweep_directory / "runs.csv").exists()


def test_runs_that_cannot_be_read_or_are_there_twice_are_warned_of(sweep_directory, capsys):
    (sweep_directory / "3" / "summary.json").write_text("{")
    a_run(sweep_directory / "again", manipulation="direct")
    assert collect.main([str(sweep_directory)]) == 0
    out, err = capsys.readouterr()
    first, second = err.splitlines()
    assert first.startswith("warning: left out: 3: ")
    assert second == "warning: 0, again: these runs have the same settings and seed; each of them counts"
    assert "4 runs; " in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "there is no such directory"),
        (["."], "there is no run here or below"),
        ([], "the following arguments are required: DIR; see python -m rbfevo.collect --help"),
        (["sweep", "--out", "file"], "--out file cannot be created: File exists"),
        (["sweep", "--pick", "knee"], "unrecognized arguments: --pick knee"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(arguments, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    if "sweep" in arguments:
        a_run(Path("sweep/0"))
        Path("file").write_text("")
    assert collect.main(arguments) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert err.startswith("rbfevo.collect: ")
    assert message in err


def test_torch_is_not_waited_for(sweep_directory):
    code = (
        "import sys; from rbfevo import collect; code = collect.main([sys.argv[1]]); "
        "sys.exit(code or len({'torch', 'pyvista', 'pandas'} & set(sys.modules)))"
    )
    arguments = [sys.executable, "-c", code, str(sweep_directory)]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
