"""A sweep over the options of a group: keys that some of them lack, and `centers` of methods that bring theirs."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from hydra.core.plugins import Plugins
from omegaconf import OmegaConf

from rbfevo import collect
from rbfevo.__main__ import main
from rbfevo.commands import combinations
from rbfevo.runs.config import CONF

SMALL = ("scenario.resolution=[12,12]", "figures=false", "quiet=true", "evaluator=eager")
POINTS = "x,y\n0.2,0.3\n0.8,0.4\n0.5,1.5\n0.3,0.9\n0.6,1.1\n"


def made(*arguments: str) -> tuple[list[list[str]], list[str]]:
    """The overrides of the jobs of a command line, and what is said about them."""
    kept, held, swept = combinations.held_back(arguments, CONF)
    assert sorted([*kept, *held]) == sorted(arguments)
    combined: list[list[str]] = [[]]
    for argument in arguments:
        key, _, values = argument.partition("=")
        combined = [[*job, f"{key}={value}"] for job in combined for value in values.split(",")]
    return combinations.jobs(combined, swept) if swept.keys else (combined, [])


def overrides(directory: Path) -> dict[str, list[str]]:
    """The overrides of each run of a sweep, without those of `SMALL`."""
    found = {}
    for path in sorted(directory.glob("*/.hydra/overrides.yaml")):
        every = OmegaConf.to_container(OmegaConf.load(path))
        assert isinstance(every, list)
        found[path.parent.parent.name] = [
            str(one) for one in every if not str(one).startswith(("scenario", "figures", "quiet", "evaluator"))
        ]
    return found


def test_a_key_goes_to_the_options_that_have_it_and_no_job_is_there_twice() -> None:
    jobs, notes = made("method=gradient,given,lloyd", "seed=0", "method.centers=a.csv,b.csv", "method.starts=20")
    assert jobs == [
        ["method=gradient", "seed=0", "method.starts=20"],
        ["method=given", "seed=0", "method.centers=a.csv"],
        ["method=given", "seed=0", "method.centers=b.csv"],
        ["method=lloyd", "seed=0", "method.starts=20"],
    ]
    assert notes == [
        "method.centers: left out for method=gradient, method=lloyd, which have no use for it",
        "method.starts: left out for method=given, which has no use for it",
    ]


def test_the_number_of_centers_is_left_out_for_a_method_that_brings_its_own() -> None:
    jobs, notes = made("centers=4,8", "method=random,given", "method.centers=a.csv")
    assert jobs == [
        ["centers=4", "method=random"],
        ["method=given", "method.centers=a.csv"],
        ["centers=8", "method=random"],
    ]
    assert "centers: left out for method=given, which has no use for it" in notes
    assert made("centers=4,8", "method=random,lloyd") == (
        [["centers=4", "method=random"], ["centers=4", "method=lloyd"],
         ["centers=8", "method=random"], ["centers=8", "method=lloyd"]],
        [],
    )  # fmt: skip


def test_other_groups_and_nested_keys_and_several_groups_at_once() -> None:
    jobs, _ = made("kernel=wendland,triharmonic", "kernel.support=15%,30%", "method=panel,nsga2",
                   "method.nsga2.generations=7")  # fmt: skip
    assert jobs == [
        ["kernel=wendland", "kernel.support=15%", "method=panel", "method.nsga2.generations=7"],
        ["kernel=wendland", "kernel.support=15%", "method=nsga2"],
        ["kernel=wendland", "kernel.support=30%", "method=panel", "method.nsga2.generations=7"],
        ["kernel=wendland", "kernel.support=30%", "method=nsga2"],
        ["kernel=triharmonic", "method=panel", "method.nsga2.generations=7"],
        ["kernel=triharmonic", "method=nsga2"],
    ]


def test_a_sweep_over_no_group_is_left_to_hydra() -> None:
    for arguments in (["method=given", "method.centers=a.csv,b.csv"], ["method=lloyd,random", "seed=0,1"], []):
        assert combinations.held_back(arguments, CONF) == (arguments, [], combinations.Swept({}))


def test_searched_and_given_setups_in_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "my points.csv").write_text(POINTS)
    (tmp_path / "theirs.csv").write_text(POINTS.replace("0.2,0.3", "0.25,0.3"))
    files = f"method.centers={tmp_path / 'my points.csv'},{tmp_path / 'theirs.csv'}"
    given = ["-m", *SMALL, f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    assert main([*given, "method=random,given", files, "method.population=6", "centers=4,8"]) == 0
    assert overrides(tmp_path / "sweep") == {
        "0": ["method=random", "method.population=6", "centers=4"],
        "1": ["method=random", "method.population=6", "centers=8"],
        "2": ["method=given", f"method.centers='{tmp_path}/my points.csv'"],
        "3": ["method=given", f"method.centers={tmp_path / 'theirs.csv'}"],
    }
    assert "left out" not in capsys.readouterr().out  # quiet
    assert collect.main([str(tmp_path / "sweep"), "--sequence", "0"]) == 0
    with (tmp_path / "sweep" / "runs.csv").open() as file:
        series = [(row["run"], row["centers"], row["series"]) for row in csv.DictReader(file) if row["series"] != "all"]
    assert series == [
        ("0", "4", "random"), ("1", "8", "random"), ("2", "5", "given (my points)"), ("3", "5", "given (theirs)"),
    ]  # fmt: skip
    loud = [word for word in given if word != "quiet=true"]
    assert main([*loud, "method=random,given", files, "method.population=6", "centers=4,8"]) == 0  # all done already
    out, err = capsys.readouterr()
    assert "method.population, centers: left out for method=given, which has no use for them" in out.splitlines()
    assert "4 of 4 jobs were already done" in err


def test_each_file_of_one_run_has_its_line(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(POINTS)
    (tmp_path / "b.csv").write_text(POINTS.replace("0.5,1.5", "0.9,0.1"))
    files = f"method.centers=[{tmp_path / 'a.csv'},{tmp_path / 'b.csv'}]"
    assert main(["method=given", files, *SMALL, f"hydra.run.dir={tmp_path / 'runs' / 'given'}"]) == 0
    assert collect.main([str(tmp_path / "runs")]) == 0
    with (tmp_path / "runs" / "runs.csv").open() as file:
        lines = {row["series"]: row for row in csv.DictReader(file)}
    assert list(lines) == ["all", "given (a)", "given (b)"]
    with (tmp_path / "runs" / "given" / "setups.csv").open() as file:
        setups = {row["label"]: row for row in csv.DictReader(file)}
    for label in ("a", "b"):
        assert lines[f"given ({label})"]["setups"] == "1"
        assert lines[f"given ({label})"]["best_regularity"] == setups[label]["regularity"]
        assert lines[f"given ({label})"]["best_improvement_potential"] == setups[label]["improvement_potential"]
    text = (tmp_path / "runs" / "report.html").read_text()
    assert "given (a)" in text


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["method=gradient,given", "method.centrs=a.csv"],
            "method.centrs: none of method=gradient,given has such a key (did you mean method.centers?); choose one of "
            "method.centers, method.coarse, method.front, method.generations, method.memory, method.polish, "
            "method.population, method.rough, method.start, method.starts",
        ),
        (
            ["kernel=triharmonic,wendland", "kernel.radius=3"],
            "kernel.radius: none of kernel=triharmonic,wendland has such a key; choose one of kernel.support",
        ),
        (["method=nsga3,lloyd", "method.starts=3"], "method=nsga3: there is no such method; choose one of "),
    ],
)
def test_a_key_that_no_option_has_is_one_line(
    arguments: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["-m", *arguments, f"hydra.sweep.dir={tmp_path / 'sweep'}"]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"rbfevo: {line}")
    assert err.count("\n") == 1
    assert not (tmp_path / "sweep").exists()


def test_the_sweeper_is_hydras_own_again_afterwards(tmp_path: Path) -> None:
    plugin = Plugins.instance().class_name_to_class[combinations.BASIC]
    before = plugin.split_arguments  # pyright: ignore[reportAttributeAccessIssue]
    arguments = ["method=random,lloyd", "method.population=4", "centers=3"]
    assert main(["-m", *arguments, *SMALL, f"hydra.sweep.dir={tmp_path}"]) == 0
    assert plugin.split_arguments is before  # pyright: ignore[reportAttributeAccessIssue]
    assert overrides(tmp_path) == {
        "0": ["method=random", "method.population=4", "centers=3"],
        "1": ["method=lloyd", "centers=3"],
    }
