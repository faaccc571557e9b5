"""Sweeps that finish: jobs recognized by their settings, taken up, skipped, and told of where they fail."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import filelock
import numpy as np
import pytest
import trimesh
from omegaconf import OmegaConf

from rbfevo.__main__ import main
from rbfevo.commands import jobs
from rbfevo.errors import UserError
from rbfevo.runs import checkpoint, lock

ROOT = Path(__file__).parents[1]
SMALL = ("scenario=plane", "scenario.resolution=[12,12]", "centers=4", "quiet=true", "figures=false", "evaluator=eager")
NSGA2 = (*SMALL, "method=nsga2", "method.population=8", "method.generations=4")


def sweep(directory: Path, *arguments: str) -> int:
    return main(["-m", *NSGA2, f"hydra.sweep.dir={directory}", *arguments])


def seeds(directory: Path) -> dict[str, int]:
    """The seed of each run by the name of its directory."""
    found = directory.glob("*/summary.json")
    return {path.parent.name: json.loads(path.read_text())["seed"] for path in sorted(found)}


def times(directory: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in directory.glob("*/summary.json")}


def test_a_sweep_that_is_started_again_does_nothing_twice(tmp_path, capsys):
    assert sweep(tmp_path, "seed=0,1") == 0
    before = times(tmp_path)
    capsys.readouterr()
    assert sweep(tmp_path, "seed=0,1") == 0
    assert times(tmp_path) == before
    assert "2 of 2 jobs were already done" in capsys.readouterr().err


@pytest.mark.parametrize(("figures", "made"), [("False", False), ("no", False), ("TRUE", True)])
def test_figures_may_be_written_in_any_way_that_hydra_knows(figures, made, tmp_path, monkeypatch):
    collected = []
    collect = "rbfevo.commands.sweep.collect"
    monkeypatch.setattr(collect, lambda directory, quiet: collected.append((directory, quiet)))
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])
    arguments = [word for word in NSGA2 if not word.startswith(("figures", "quiet"))]
    assert main(["-m", *arguments, f"hydra.sweep.dir={tmp_path}", "seed=0", f"figures={figures}", "quiet=True"]) == 0
    assert collected == ([(tmp_path, True)] if made else [])


def test_jobs_are_recognized_by_their_settings_not_by_their_numbers(tmp_path):
    assert sweep(tmp_path, "seed=0,1") == 0
    before = times(tmp_path)
    assert sweep(tmp_path, "seed=2,1,3") == 0
    found = seeds(tmp_path)
    assert sorted(found.values()) == [0, 1, 2, 3]
    assert {name: when for name, when in times(tmp_path).items() if name in before} == before
    for name, seed in found.items():
        config = OmegaConf.load(tmp_path / name / ".hydra" / "config.yaml")
        assert config.seed == seed
        assert f"seed={seed}" in OmegaConf.load(tmp_path / name / ".hydra" / "overrides.yaml")
    assert not [path for path in tmp_path.iterdir() if path.is_dir() and not any(path.iterdir())]


def test_more_generations_are_another_job(tmp_path):
    assert sweep(tmp_path, "seed=0") == 0
    assert sweep(tmp_path, "seed=0", "method.generations=5") == 0
    assert len(seeds(tmp_path)) == 2


def test_an_interrupted_job_is_taken_up_and_ends_as_if_it_had_not_been(tmp_path, monkeypatch, capsys):
    assert sweep(tmp_path / "calm", "seed=0,1") == 0
    assert sweep(tmp_path / "torn", "seed=0,1", "checkpoint.every=0") == 0
    torn = tmp_path / "torn" / "1"
    state = checkpoint.load(torn)
    assert state["finished"]
    shutil.rmtree(torn)
    from rbfevo.runs.journal import Journal

    class KilledError(BaseException):
        pass

    def dies(*_: object) -> None:
        raise KilledError

    with monkeypatch.context() as patch:
        count = 0
        real = Journal.record

        def record(self, records):
            nonlocal count
            count += 1
            if count == 3:
                raise KilledError
            real(self, records)

        patch.setattr(Journal, "record", record)
        patch.setattr("rbfevo.runs.run.Run.save", lambda *_: None)
        with pytest.raises(KilledError):
            sweep(tmp_path / "torn", "seed=0,1", "checkpoint.every=0")
    assert not checkpoint.head(torn)["finished"]
    assert sweep(tmp_path / "torn", "seed=0,1") == 0
    for name in ("0", "1"):
        with (
            np.load(tmp_path / "calm" / name / "setups.npz") as calm,
            np.load(tmp_path / "torn" / name / "setups.npz") as end,
        ):
            assert all(np.array_equal(calm[key], end[key], equal_nan=calm[key].dtype.kind == "f") for key in calm.files)


def test_failed_jobs_are_listed_with_the_reason_and_tried_again(tmp_path, capsys):
    assert sweep(tmp_path, "centers=4,1000,5", "seed=0") == 2
    err = capsys.readouterr().err
    assert "1 of 3 jobs failed:" in err
    assert "  1 (centers=1000): centers=1000: scenario plane has only 144 vertices; use fewer" in err
    assert len(seeds(tmp_path)) == 2
    assert sweep(tmp_path, "centers=4,100,5", "seed=0") == 0
    assert len(seeds(tmp_path)) == 3


def test_a_bug_in_one_job_does_not_end_the_others(tmp_path, monkeypatch, capsys):
    from rbfevo.runs import run

    real = run.carry_out

    def fails(settings, *arguments):
        if settings.seed == 1:
            raise RuntimeError("a bug")
        return real(settings, *arguments)

    monkeypatch.setattr(run, "carry_out", fails)
    assert sweep(tmp_path, "seed=0,1,2") == 1
    assert "  1 (seed=1): RuntimeError: a bug" in capsys.readouterr().err
    assert sorted(seeds(tmp_path).values()) == [0, 2]


def test_a_mistake_in_the_words_leaves_no_sweep_behind(tmp_path, capsys):
    assert sweep(tmp_path / "new", "seed=0,1", "kernel=gauss") == 2
    assert not (tmp_path / "new").exists()
    assert capsys.readouterr().err.count("\n") == 1


def test_two_sweeps_in_one_directory_are_refused(tmp_path, capsys):
    held = subprocess.Popen(
        [sys.executable, "-c", "import sys; from pathlib import Path; from rbfevo.runs.lock import locked\n"
         "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()", str(tmp_path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT,
    )  # fmt: skip
    assert held.stdout is not None
    held.stdout.readline()
    before = sorted(path.name for path in tmp_path.iterdir())
    try:
        assert sweep(tmp_path, "seed=0,1") == 2
        assert "another process is working" in capsys.readouterr().err
        assert main([*NSGA2, f"hydra.run.dir={tmp_path}"]) == 2
        assert "another process is working" in capsys.readouterr().err
        assert sorted(path.name for path in tmp_path.iterdir()) == before
    finally:
        held.kill()
        held.wait()
        held.stdout.close()
        if held.stdin is not None:
            held.stdin.close()
    assert main([*NSGA2, f"hydra.run.dir={tmp_path / 'now'}"]) == 0


def test_a_lock_is_held_more_than_once_by_the_same_process(tmp_path):
    other = filelock.FileLock(tmp_path / lock.NAME, timeout=0)  # as another process sees it
    with lock.locked(tmp_path), lock.locked(tmp_path):
        pass
    with lock.locked(tmp_path):
        with lock.locked(tmp_path):
            pass
        with pytest.raises(filelock.Timeout):  # letting go once is not enough
            other.acquire()
    other.acquire()
    assert other.is_locked
    other.release()


# --- launchers -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("launcher", "arguments"),
    [
        ("joblib", ["hydra.launcher.n_jobs=2"]),
        pytest.param("submitit_local", ["hydra.launcher.cpus_per_task=1"], marks=pytest.mark.slow),
    ],
)
def test_launchers_share_the_cores_and_tell_what_failed(launcher, arguments, tmp_path):
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.split('_')[0]}_launcher")
    command = [sys.executable, "-m", "rbfevo", "-m", *NSGA2, f"hydra.sweep.dir={tmp_path}", "centers=4,1000"]
    command += [f"hydra/launcher={launcher}", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2, done.stderr
    assert "1 of 2 jobs failed:" in done.stderr
    assert "  1 (centers=1000): centers=1000: scenario plane has only 144 vertices" in done.stderr
    summary = json.loads((tmp_path / "0" / "summary.json").read_text())
    cores = len(os.sched_getaffinity(0))
    assert summary["threads"] == (max(1, cores // 2) if launcher == "joblib" else 1)
    assert not (tmp_path / jobs.STATUS).exists()


def test_threads_of_jobs_fit_the_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)))
    joblib = {"_target_": "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher"}
    assert jobs.threads(joblib | {"n_jobs": 4}) == 4
    assert jobs.threads(joblib | {"n_jobs": -1}) == 1
    assert jobs.threads(joblib | {"n_jobs": -9}) == 2
    assert jobs.threads(joblib | {"n_jobs": 64}) == 1
    assert jobs.threads({"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher"}) is None
    submitit = {"_target_": "hydra_plugins.hydra_submitit_launcher.submitit_launcher.SlurmLauncher"}
    assert jobs.threads(submitit | {"cpus_per_task": 3}) == 3
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "5")
    assert jobs.threads(submitit | {"cpus_per_task": 3}) == 5


def test_a_job_that_ended_without_a_word_is_told_of():
    found = [jobs.Outcome(0, ["a=1", "b=2"], "0", "s", 0), jobs.Outcome(1, ["a=1", "b=3"], "1", "s", None)]
    assert jobs.summary(found) == [
        "1 of 2 jobs failed:",
        "  1 (b=3): its process ended without a result",
        "start the same sweep again to run only the jobs that are not done",
    ]


# --- the command line, killed ----------------------------------------------------------------------------------------


def test_a_killed_command_goes_on(tmp_path):
    arguments = [*NSGA2, "method.generations=100000", "checkpoint.every=0"]
    command = [sys.executable, "-m", "rbfevo", *arguments, f"hydra.run.dir={tmp_path / 'run'}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, cwd=ROOT, env=environment)
    path = tmp_path / "run" / checkpoint.NAME
    end = time.monotonic() + 60
    while time.monotonic() < end and not (path.exists() and checkpoint.load(tmp_path / "run")["progress"]):
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    step = int(checkpoint.load(tmp_path / "run")["progress"]["step"])
    assert step > 0
    assert main([f"resume={tmp_path / 'run'}", f"method.generations={step + 3}"]) == 0
    assert main([*NSGA2, f"method.generations={step + 3}", f"hydra.run.dir={tmp_path / 'calm'}"]) == 0
    with np.load(tmp_path / "calm" / "setups.npz") as calm, np.load(tmp_path / "run" / "setups.npz") as torn:
        assert all(np.array_equal(calm[key], torn[key], equal_nan=calm[key].dtype.kind == "f") for key in calm.files)
    config = OmegaConf.load(tmp_path / "run" / ".hydra" / "config.yaml")
    assert config.method.generations == step + 3
    assert main([f"resume={tmp_path / 'run'}"]) == 2


def test_resuming_is_refused_in_one_line_while_the_run_is_on(tmp_path, capsys):
    code = "import sys; from pathlib import Path; from rbfevo.runs.lock import locked\n"
    code += "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    assert main([*NSGA2, f"hydra.run.dir={tmp_path}"]) == 0
    capsys.readouterr()
    held = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdin=-1, stdout=-1, cwd=ROOT)
    assert held.stdout is not None
    held.stdout.readline()
    assert main([f"resume={tmp_path}", "method.generations=9"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "another process is working on this run" in line
    held.communicate()


@pytest.mark.parametrize("name", ["1e3", "null", "a b", "it's", "x=y,z", "[x]"])
def test_a_run_goes_on_whatever_its_directory_is_called(name, tmp_path, monkeypatch):
    place = tmp_path / "place"
    assert main([*NSGA2, f"hydra.run.dir={place}"]) == 0
    place.rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert main([f"resume={name}", "method.generations=5"]) == 0
    assert len((tmp_path / name / "history.csv").read_text().splitlines()) == 6


def test_a_run_goes_on_from_another_directory(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    trimesh.creation.icosphere(subdivisions=2).export("ball.ply")
    trimesh.creation.icosphere(subdivisions=2, radius=1.2).export("wanted.ply")
    mesh = [
        "scenario=mesh",
        "scenario.template=ball.ply",
        "scenario.target=wanted.ply",
        *NSGA2[2:],
        "hydra.run.dir=run",
    ]
    assert main(mesh) == 0
    monkeypatch.chdir(tmp_path / "there")
    assert main([f"resume={tmp_path / 'here' / 'run'}", "method.generations=5"]) == 0
    assert Path.cwd() == tmp_path / "there"
    (tmp_path / "here" / "ball.ply").unlink()
    assert main([f"resume={tmp_path / 'here' / 'run'}", "method.generations=6"]) == 2
    assert (tmp_path / "here" / "run" / "setups.npz").exists()


def test_a_mistake_does_not_touch_what_is_there(tmp_path):
    assert main([*NSGA2, f"hydra.run.dir={tmp_path / 'run-${seed}'}"]) == 0
    run = tmp_path / "run-0"
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert main([*NSGA2, "centers=5", f"hydra.run.dir={tmp_path / 'run-${seed}'}"]) == 2
    assert main([*NSGA2, "centers=5", f"++hydra.run.dir={run}"]) == 2
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    (tmp_path / "foreign").mkdir()
    assert main([f"resume={tmp_path / 'foreign'}"]) == 2
    assert not list((tmp_path / "foreign").iterdir())


def test_a_sweep_in_a_directory_that_hydra_works_out_tells_what_failed(tmp_path, capsys):
    assert main(["-m", *NSGA2, f"hydra.sweep.dir={tmp_path}/of-${{seed}}", "centers=4,1000"]) == 2
    assert "1 of 2 jobs failed:" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["of-0"]


def test_an_unwritable_place_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"), lock.locked(tmp_path / "file" / "run"):
        pass


# --- the main process of a sweep, signalled ---------------------------------------------------------------------------


def below(process: int) -> list[int]:
    """The processes that a process has started, and those that they have."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = path.read_text()
        except OSError:
            continue
        if int(text.rpartition(")")[2].split()[1]) == process:
            found += [int(path.parent.name), *below(int(path.parent.name))]
    return found


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def begun(run: Path) -> bool:
    """Whether the run has taken a step."""
    return (run / checkpoint.NAME).exists() and bool(checkpoint.load(run).get("progress"))


PROC = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="there is no /proc here that lists processes")


def leader(directory: Path) -> tuple[subprocess.Popen[str], list[int]]:
    """The main process of a joblib sweep, two of whose four long jobs are in the middle, and those it has started."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = [*NSGA2, "method.generations=100000", "checkpoint.every=0", f"hydra.sweep.dir={directory}", "seed=0,1,2,3"]
    words += ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    command = [sys.executable, "-m", "rbfevo", "-m", *words]
    process = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, stderr=-1, text=True)
    end = time.monotonic() + 120
    while time.monotonic() < end and not all(map(begun, (directory / "0", directory / "1"))):
        time.sleep(0.1)
    started = below(process.pid)
    assert len(started) >= 2
    return process, started


@PROC
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_to_the_leader_of_a_joblib_sweep_leaves_nothing_running(number, code, tmp_path):
    process, started = leader(tmp_path)
    process.send_signal(number)
    _, text = process.communicate(timeout=60)
    assert process.returncode == code
    end = time.monotonic() + 5
    while time.monotonic() < end and any(map(alive, started)):
        time.sleep(0.1)
    assert not [other for other in started if alive(other)]
    assert "interrupted" in text.splitlines()
    assert seeds(tmp_path) == {"0": 0, "1": 1}  # their results so far; no other job has begun
    assert [json.loads((tmp_path / name / "summary.json").read_text())["stop_reason"] for name in ("0", "1")] == [
        "interrupted by SIGTERM"
    ] * 2
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["0", "1"]
    with np.load(tmp_path / "0" / "setups.npz") as archive:
        assert len(archive["regularity"]) == 16


@PROC
def test_the_jobs_of_a_joblib_sweep_end_when_its_leader_is_killed(tmp_path):
    process, started = leader(tmp_path)
    process.kill()
    end = time.monotonic() + 60
    while time.monotonic() < end and any(map(alive, started)):
        time.sleep(0.1)
    assert not [other for other in started if alive(other)]
    assert seeds(tmp_path) == {"0": 0, "1": 1}  # their results so far; no other job has begun
    assert {json.loads((tmp_path / name / "summary.json").read_text())["stop_reason"] for name in ("0", "1")} == {
        "interrupted by SIGTERM"
    }
    process.communicate(timeout=20)
    assert sweep(tmp_path, "method.generations=1", "seed=2") == 0  # nothing is locked


def test_a_signal_while_a_sweep_is_collected_ends_that_too(tmp_path):
    assert sweep(tmp_path, "seed=0,1") == 0
    slow = "import time, sys; print('begun', flush=True); time.sleep(60)"
    code = (
        "import sys; from pathlib import Path; from rbfevo.commands import sweep\n"
        f"real = sweep.subprocess.Popen\n"
        f"def popen(command, **keywords): return real([sys.executable, '-c', {slow!r}], **keywords)\n"
        "sweep.subprocess.Popen = popen\n"
        "from rbfevo.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    words = [word for word in NSGA2 if not word.startswith(("figures", "quiet"))]
    words += [f"hydra.sweep.dir={tmp_path}", "seed=0,1", "figures=true"]
    process = subprocess.Popen([sys.executable, "-c", code, "-m", *words], cwd=ROOT, stdout=-1, stderr=-1, text=True)
    assert process.stdout is not None
    while process.stdout.readline() not in ("begun\n", ""):
        pass
    (started,) = below(process.pid)
    process.send_signal(signal.SIGTERM)
    _, text = process.communicate(timeout=20)
    assert process.returncode == 143
    assert not alive(started)
    assert f"python -m rbfevo.collect {tmp_path} makes its page" in text


# --- GPUs ------------------------------------------------------------------------------------------------------------


def given(directory: Path) -> list[tuple[str, int]]:
    """CUDA_VISIBLE_DEVICES and process of each job, by tests/plugged/kernel/witness.yaml."""
    found = [json.loads(path.read_text()) for path in directory.glob("seen-*.json")]
    return [(job["gpu"], job["process"]) for job in found]


@pytest.mark.parametrize(("gpus", "processes"), [("GPU-a1,GPU-b2", 3), pytest.param("", 2, marks=pytest.mark.slow)])
def test_jobs_of_joblib_have_one_gpu_each(gpus, processes, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    plugged = ROOT / "tests" / "plugged"
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": gpus, "PYTHONPATH": f"{ROOT}{os.pathsep}{plugged}"}
    words = [*NSGA2, f"hydra.searchpath=[file://{plugged}]", "kernel=witness", f"kernel.place={tmp_path}"]
    words += [f"hydra.sweep.dir={tmp_path / 'sweep'}", "seed=0,1,2", "hydra/launcher=joblib"]
    command = [sys.executable, "-m", "rbfevo", "-m", *words, f"hydra.launcher.n_jobs={processes}"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = given(tmp_path)
    assert len(found) == 3
    of_process = {process: gpu for gpu, process in found}
    assert all(of_process[process] == gpu for gpu, process in found)  # all jobs of a process have the same
    choice = gpus.split(",")
    counts = [list(of_process.values()).count(gpu) for gpu in choice]
    assert sum(counts) == len(of_process)  # one each, and no other
    assert max(counts) - min(counts) <= 1  # processes share them evenly


def test_the_job_of_slurm_takes_one_of_the_gpus_that_it_sees(monkeypatch):
    from rbfevo.commands import gpus

    for number, gpu in enumerate(["3", "5", "3"]):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3, 5")
        gpus.choose(number)
        assert os.environ["CUDA_VISIBLE_DEVICES"] == gpu
    gpus.choose(7)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "3"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")  # none is to be used
    gpus.choose(1)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == ""
