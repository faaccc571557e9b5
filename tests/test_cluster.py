"""Sweeps and long runs on a real SLURM (tests/clusters.py): what happens to jobs there, and what they leave."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import clusters
import numpy as np
import pytest
from clusters import ROOT, Cluster, until

from rbfevo.commands import jobs
from rbfevo.errors import UserError
from rbfevo.runs import checkpoint

SMALL = ("scenario=plane", "centers=4", "figures=false", "method=nsga2", "method.population=8")
LAUNCHER = ("hydra/launcher=submitit_slurm", "hydra.launcher.timeout_min=60", "hydra.launcher.cpus_per_task=1")
LARGE = "[600,600]"  # takes some 550 MB, the others 350


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    with clusters.running() as made:
        yield made


def step(run: Path) -> int:
    """How far a run is, by its checkpoint."""
    try:
        progress = checkpoint.load(run).get("progress")
    except UserError:
        return 0
    return 0 if progress is None else int(progress["step"])


def arrays(run: Path) -> dict[str, np.ndarray]:
    with np.load(run / "setups.npz") as archive:
        return dict(archive)


def assert_same(one: Path, other: Path) -> None:
    """Assert that two runs have found the same, bit for bit, in the same generations."""
    here, there = arrays(one), arrays(other)
    assert here.keys() == there.keys()
    for name, array in here.items():
        assert np.array_equal(array, there[name], equal_nan=array.dtype.kind == "f"), name
    assert generations(one) == generations(other)


def generations(run: Path) -> list[int]:
    """The generations that history.csv has."""
    with (run / "history.csv").open() as file:
        return [int(line["generation"]) for line in csv.DictReader(file)]


# --- sweeps ----------------------------------------------------------------------------------------------------------


def sweep(cluster: Cluster, directory: Path, resolutions: Sequence[str], memory: str, *more: str) -> list[str]:
    """The command of a sweep over resolutions."""
    memory = f"+hydra.launcher.additional_parameters.mem={memory}"
    over = f"scenario.resolution={','.join(resolutions)}"
    words = [*SMALL, *LAUNCHER, "quiet=true", "checkpoint.every=0", over, memory, f"hydra.sweep.dir={directory}"]
    return cluster.command(sys.executable, "-m", "rbfevo", "-m", *words, *more)


class Leader:
    """The main process of a sweep."""

    def __init__(self, cluster: Cluster, command: Sequence[str], log: Path) -> None:
        self.log = log
        before = set(cluster.states())
        with log.open("w") as file:
            self.process = subprocess.Popen(command, env=cluster.environment, stderr=file, stdout=file, cwd=log.parent)
        cluster.processes.append(self.process)
        self._cluster, self._before = cluster, before

    def jobs(self) -> dict[int, str]:
        """The states of its jobs, by their places in SLURM's array."""
        found = {job: state for job, state in self._cluster.states().items() if job not in self._before and "_" in job}
        return {int(job.partition("_")[2]): state for job, state in found.items()}

    def array(self) -> str:
        """The id of SLURM's array."""
        (found,) = {job.partition("_")[0] for job in set(self._cluster.states()) - self._before if "_" in job}
        return found

    def ended(self) -> tuple[int, str]:
        """The exit code and what it printed, once it has ended."""
        code = self.process.wait(timeout=900)
        return code, self.log.read_text()


def failures(text: str) -> dict[int, str]:
    """What a sweep's list of failures has about each job, by its number."""
    return {int(number): reason for number, reason in re.findall(r"^  (\d+) \(\S+\): (.+)$", text, re.MULTILINE)}


def finished(directory: Path) -> dict[str, str]:
    """The directories of the runs that are done, by their resolution."""
    found: dict[str, str] = {}
    for path in sorted(directory.glob("*/summary.json")):
        if checkpoint.head(path.parent)["finished"]:
            words = (path.parent / ".hydra" / "overrides.yaml").read_text()
            (name,) = re.findall(r"resolution=(\[\d+,\d+\])", words)
            assert name not in found, "done twice"
            found[name] = path.parent.name
    return found


def times(directory: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in directory.glob("*/setups.npz")}


def test_a_sweep_goes_on_whatever_slurm_does_to_its_jobs(cluster, tmp_path):
    resolutions = ["[12,12]", LARGE, "[14,14]", "[15,15]"]
    long = ("method.generations=300",)
    directory = tmp_path / "sweep"
    leader = Leader(cluster, sweep(cluster, directory, resolutions, "450M", *long), tmp_path / "first.log")
    until(lambda: len(leader.jobs()) == 4, "the jobs are in the queue")
    array = leader.array()
    cluster.ask("scancel", f"{array}_3")
    until(lambda: step(directory / "0") > 10, "the first job is in the middle")
    cluster.ask("scontrol", "requeue", f"{array}_0")
    cluster.start_again_now(f"{array}_0")
    code, text = leader.ended()
    assert code == 1, text
    found = failures(text)
    assert "2 of 4 jobs failed:" in text
    assert found.keys() == {1, 3}
    assert "was killed for memory" in found[1]
    assert found[3] == f"SLURM's job {array}_3 was cancelled before it began"
    assert finished(directory).keys() == {"[12,12]", "[14,14]"}
    assert not (directory / jobs.STATUS).exists()

    before = times(directory)
    code, text = Leader(
        cluster, sweep(cluster, directory, resolutions, "1500M", *long), tmp_path / "second.log"
    ).ended()
    assert code == 0, text
    assert "2 of 4 jobs were already done" in text
    assert finished(directory).keys() == set(resolutions)
    after = times(directory)
    assert {name: after[name] for name in ("0", "2")} == {name: before[name] for name in ("0", "2")}
    words = [*SMALL, *long, "scenario.resolution=[12,12]", "quiet=true", f"hydra.run.dir={tmp_path / 'calm'}"]
    subprocess.run([sys.executable, "-m", "rbfevo", *words], env=cluster.environment, check=True, timeout=300)
    assert_same(directory / "0", tmp_path / "calm")


def test_a_sweep_on_slurm_makes_its_page(cluster, tmp_path):
    words = ["scenario=plane", "scenario.resolution=[12,12]", "centers=4", "method=lloyd", "seed=0,1", "quiet=true"]
    memory = "+hydra.launcher.additional_parameters.mem=1500M"
    command = cluster.command(sys.executable, "-m", "rbfevo", "-m", *words, *LAUNCHER, memory)
    code, text = Leader(cluster, [*command, f"hydra.sweep.dir={tmp_path / 'sweep'}"], tmp_path / "log").ended()
    assert code == 0, text
    with (tmp_path / "sweep" / "runs.csv").open() as file:
        assert {line["run"] for line in csv.DictReader(file)} == {"0", "1"}
    page = (tmp_path / "sweep" / "report.html").read_text()
    assert all(f"seed={seed}" in page for seed in (0, 1))
    assert all((tmp_path / "sweep" / run / "front.png").stat().st_size > 10_000 for run in "01")


@pytest.mark.slow
def test_a_job_whose_node_fails_goes_on_elsewhere(cluster, tmp_path):
    before, directory = set(cluster.states()), tmp_path / "sweep"
    leader = Leader(cluster, sweep(cluster, directory, ["[12,12]"], "1G", "method.generations=500"), tmp_path / "log")
    job = alone(cluster, before)
    until(lambda: step(directory / "0") > 10, "the job is in the middle")
    node = cluster.ask("squeue", "--noheader", f"--jobs={job}", "--format=%N").strip()
    cluster.cut_power(node)
    try:
        until(lambda: cluster.states()[job] == "PENDING", "it is in the queue again")
        assert 10 < step(directory / "0") < 500
        cluster.start_again_now(job)
        until(lambda: cluster.states()[job] == "RUNNING", "it runs again")
        assert cluster.ask("squeue", "--noheader", f"--jobs={job}", "--format=%N").strip() not in ("", node)
        code, text = leader.ended()
    finally:
        cluster.start_node(node)
    assert code == 0, text
    assert finished(directory) == {"[12,12]": "0"}
    assert generations(directory / "0") == list(range(1, 501))
    words = [*SMALL, "method.generations=500", "scenario.resolution=[12,12]", "quiet=true"]
    command = [sys.executable, "-m", "rbfevo", *words, f"hydra.run.dir={tmp_path / 'calm'}"]
    subprocess.run(command, env=cluster.environment, check=True, timeout=300)
    assert_same(directory / "0", tmp_path / "calm")


@pytest.mark.slow
def test_twenty_jobs_are_done_once_whatever_happens(cluster, tmp_path):
    """Two cancelled, one killed for memory, one requeued, the controller killed and a node drained."""
    generations = "method.generations=500"
    resolutions = [LARGE, *(f"[{side},{side}]" for side in range(12, 31))]
    directory = tmp_path / "sweep"
    leader = Leader(cluster, sweep(cluster, directory, resolutions, "450M", generations), tmp_path / "log")
    until(lambda: len(leader.jobs()) == 20, "the jobs are in the queue")
    array = leader.array()
    cluster.ask("scancel", f"{array}_19")  # which has not begun
    until(lambda: step(directory / "1") > 10, "the second job is in the middle")
    cluster.ask("scontrol", "requeue", f"{array}_1")
    cluster.start_again_now(f"{array}_1")
    until(lambda: step(directory / "4") > 10, "the fifth job is in the middle")
    cluster.ask("scancel", f"{array}_4")
    until(lambda: step(directory / "6") > 10, "the seventh job is in the middle")
    cluster.kill_controller()
    time.sleep(20)  # jobs end meanwhile, and the leader asks in vain
    cluster.start()
    cluster.ask("scontrol", "update", "NodeName=node2", "State=drain", "Reason=test")
    try:
        until(lambda: step(directory / "12") > 10, "the thirteenth job is in the middle")
        assert "drain" in cluster.ask("sinfo", "--noheader", "--nodes=node2", "--partition=main", "--format=%T")
        code, text = leader.ended()
    finally:
        cluster.ask("scontrol", "update", "NodeName=node2", "State=resume")
    assert code == 1, text
    found = failures(text)
    assert "3 of 20 jobs failed:" in text
    assert found.keys() == {0, 4, 19}
    assert "was killed for memory" in found[0]
    assert found[4] == "SIGTERM stopped it, by scancel or at its time limit; its results so far are saved"
    assert found[19] == f"SLURM's job {array}_19 was cancelled before it began"
    done = finished(directory)
    assert done == {name: str(number) for number, name in enumerate(resolutions) if number not in found}

    before, torn = times(directory), step(directory / "4")
    assert 10 < torn < 500
    again = Leader(cluster, sweep(cluster, directory, resolutions, "1500M", generations), tmp_path / "next")
    until(lambda: bool(again.jobs()), "the other jobs are in the queue")
    assert len(again.jobs()) == 3
    code, text = again.ended()
    assert code == 0, text
    assert "17 of 20 jobs were already done" in text
    assert finished(directory) == {name: str(number) for number, name in enumerate(resolutions)}
    assert {name: when for name, when in times(directory).items() if name in done.values()} == {
        name: when for name, when in before.items() if name in done.values()
    }
    assert sorted(path.name for path in directory.iterdir() if not path.name.startswith(".")) == sorted(
        [*map(str, range(20)), "multirun.yaml"]
    )
    for number in (1, 4):  # requeued, and cancelled in the middle
        calm = tmp_path / f"calm-{number}"
        words = [*SMALL, generations, f"scenario.resolution={resolutions[number]}", "quiet=true"]
        command = [sys.executable, "-m", "rbfevo", *words, f"hydra.run.dir={calm}"]
        subprocess.run(command, env=cluster.environment, check=True, timeout=300)
        assert_same(directory / str(number), calm)

    collect = [sys.executable, "-m", "rbfevo.collect", str(directory)]
    subprocess.run(collect, env=cluster.environment, check=True, timeout=300)
    with (directory / "runs.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert {line["run"] for line in lines} == set(map(str, range(20)))
    page = (directory / "report.html").read_text()
    assert all(f"scenario.resolution={name}" in page for name in resolutions)


def alone(cluster: Cluster, before: set[str]) -> str:
    """The id of the only job since then."""
    until(lambda: len(set(cluster.states()) - before) == 1, "the job is in the queue")
    return next(iter(set(cluster.states()) - before))


@pytest.mark.slow
def test_a_job_that_is_preempted_goes_on(cluster, tmp_path):
    before, directory = set(cluster.states()), tmp_path / "sweep"
    words = ("hydra.launcher.partition=low", "method.generations=500")
    leader = Leader(cluster, sweep(cluster, directory, ["[12,12]"], "1G", *words), tmp_path / "log")
    job = alone(cluster, before)
    until(lambda: step(directory / "0") > 10, "the job is in the middle")
    other = cluster.submit("--partition=high", "--nodes=2", "--exclusive", "--wrap=sleep 1", cwd=tmp_path)
    until(lambda: cluster.states()[other] == "COMPLETED", "the job that comes first has run")
    assert 10 < step(directory / "0") < 500
    assert leader.process.poll() is None  # it waits
    cluster.start_again_now(job)
    code, text = leader.ended()
    assert code == 0, text
    assert finished(directory) == {"[12,12]": "0"}
    assert generations(directory / "0") == list(range(1, 501))


@pytest.mark.slow
def test_a_job_goes_on_after_its_time_limit_as_often_as_it_may(cluster, tmp_path):
    before, directory = set(cluster.states()), tmp_path / "sweep"
    words = ("hydra.launcher.timeout_min=2", "hydra.launcher.signal_delay_s=45", "hydra.launcher.max_num_timeout=1")
    leader = Leader(
        cluster, sweep(cluster, directory, ["[12,12]"], "1G", *words, "method.generations=1000000"), tmp_path / "log"
    )
    job = alone(cluster, before)
    until(lambda: step(directory / "0") > 10, "the job is in the middle")
    until(lambda: cluster.states()[job] == "PENDING", "it is in the queue again")
    at = step(directory / "0")
    cluster.start_again_now(job)
    until(lambda: step(directory / "0") > at, "it goes on")
    code, text = leader.ended()
    assert code == 1, text
    assert "): it reached its time limit, its results so far are saved; hydra.launcher.max_num_timeout=9 would" in text
    assert generations(directory / "0") == list(range(1, step(directory / "0") + 1))


# --- one long run ----------------------------------------------------------------------------------------------------


@pytest.fixture
def script(tmp_path) -> Path:
    """The script of docs/cluster.md, as it stands there."""
    (found,) = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", (ROOT / "docs" / "cluster.md").read_text(), re.DOTALL)
    assert found.count("\n") == 10
    path = tmp_path / "long.sh"
    path.write_text(found)
    return path


LONG = [*SMALL, "scenario.resolution=[12,12]"]
OURS = ("--cpus-per-task=1", "--mem=1G")  # what these nodes have


def test_a_long_run_goes_on_after_it_was_preempted(cluster, script, tmp_path):
    words = [*LONG, "method.generations=400"]
    run = tmp_path / "run"
    job = cluster.submit("--partition=low", *OURS, str(script), "run", *words, "checkpoint.every=0", cwd=tmp_path)
    until(lambda: step(run) > 10, "the run is in the middle")
    other = cluster.submit("--partition=high", "--nodes=2", "--exclusive", "--wrap=sleep 1", cwd=tmp_path)
    until(lambda: cluster.states()[other] == "COMPLETED", "the job that comes first has run")
    at = step(run)
    assert 10 < at < 400
    log = tmp_path / f"long.sh-{job}.log"
    assert log.read_text().count("to continue: python -m rbfevo resume=") == 1
    cluster.start_again_now(job)
    until(lambda: cluster.states()[job] in clusters.ENDED, "the run is done")
    assert cluster.states()[job] == "COMPLETED", log.read_text()
    subprocess.run(
        [sys.executable, "-m", "rbfevo", *words, "quiet=true", f"hydra.run.dir={tmp_path / 'calm'}"],
        env=cluster.environment, check=True, timeout=300,
    )  # fmt: skip
    assert_same(run, tmp_path / "calm")


@pytest.mark.slow
def test_a_long_run_goes_on_after_its_time_limit_and_ends_when_it_is_cancelled(cluster, script, tmp_path):
    run = tmp_path / "run"
    words = [*LONG, "method.generations=1000000", "checkpoint.every=0"]
    job = cluster.submit("--time=2", "--signal=TERM@30", *OURS, str(script), "run", *words, cwd=tmp_path)
    log = tmp_path / f"long.sh-{job}.log"
    until(lambda: log.exists() and "to continue: python -m rbfevo resume=" in log.read_text(), "SLURM has warned")
    at = step(run)
    assert at > 0
    cluster.start_again_now(job)
    until(lambda: step(run) > at, "the run goes on")
    cluster.ask("scancel", job)
    until(lambda: cluster.states()[job] in clusters.ENDED, "the run has ended")
    time.sleep(2)
    assert cluster.states()[job] == "CANCELLED"  # and is not in the queue again
    assert generations(run) == list(range(1, step(run) + 1))
    assert json.loads((run / "summary.json").read_text())["stop_reason"] == "interrupted by SIGTERM"
