"""The command line, from words to exit code and run directory."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rbfevo.__main__ import main
from rbfevo.runs import checkpoint

ROOT = Path(__file__).parents[1]
SMALL = ["scenario.resolution=[24,24]", "quiet=true", "evaluator=eager"]


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Figures have tests of their own; here each would cost seconds."""
    if "figures" not in request.keywords:
        monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


MISTAKES = {
    "method.generatons=3": "method.nsga2",
    "method=nsga2 method.generatons=3": "did you mean method.generations?",
    "method=nsga3": "choose one of blend, cmaes, given, gradient, lloyd, nsga2, ols, panel, random",
    "scenario=sphere": "choose one of face, mesh, plane",
    "kernel=gauss": "choose one of gaussian, inverse_multiquadric, multiquadric, triharmonic, wendland, wendland_c0, ",
    "manipulation=both": "choose one of direct, indirect",
    "experiment=nope": "choose one of paper",
    "sed=3": "did you mean seed?",
    "+foo=3": "foo: there is no such key; choose one of",
    "bogus": "bogus",
    "=3": "=3",
    "seed=x": "seed=x: a whole number is expected",
    "seed=-1": "seed=-1",
    "quiet=3.5": "true or false is expected",
    "centers=0": "give at least 1",
    "centers=1.5": "a whole number is expected",
    "centers=100000 scenario.resolution=[20,20]": "only 400 vertices",
    "preference=1.5": "not a number from 0",
    "preference=-0.1": "not a number from 0",
    "preference=abc": "not a number from 0",
    "preference=true": "not a number from 0",
    "preference=[0,0.5,nan]": "nan is not a number from 0",
    "preference=[]": "the list is empty",
    "preference=[0.5,0.5]": "twice",
    "method=nsga2 preference=0.3": "method=nsga2 finds the same setups without it",
    "method=lloyd preference=0.3": "leave it out, or choose method=blend or cmaes or gradient",
    "method=ols preference=[0,1]": "preference=[0,1]: method=ols finds the same setups without it",
    "method=random preference=1": "method=random finds the same setups without it",
    "method=gradient method.population=488": "starts=320: at least population=488 is needed",
    "method.nsga2.population=101": "even population",
    "method=nsga2 method.population=2": "even population",
    "method=nsga2 method.generations=0": "at least 1",
    "method=nsga2 method.generations=abc": "a whole number is expected",
    "method=nsga2 method.mutation_eta=x": "a number is expected",
    "method=nsga2 method.crossover_probability=2": "crossover_probability",
    "method=cmaes method.parents=200": "parents=200",
    "method=cmaes method.sigma=0": "sigma=0",
    "method=cmaes method.generations=-3": "at least 1",
    "method=lloyd method.starts=0": "at least 1",
    "method=ols method.per_axis=1": "at least 2",
    "kernel.support=0": "give a positive number",
    "kernel.support=-1": "give a positive number",
    "kernel.support=nan": "give a positive number",
    "kernel.support=abc": "give a positive number",
    "kernel.support=0%": "give a positive number",
    "kernel.support=%": "give a positive number",
    "kernel.support=true": "give a positive number",
    "kernel=triharmonic kernel.support=1": "has no support radius",
    "device=tpu": "choose one of auto, cpu, cuda",
    "evaluator=foo": "choose one of auto, fused, eager",
    "scenario.resolution=5": "a list, each entry a whole number, is expected",
    "scenario.resolution=[1,1]": "resolution",
    "scenario.resolution=[a,b]": "a whole number",
    "scenario=face scenario.subdivisions=0": "1 to 8",
    "scenario=face scenario.reject=maybe": "boundary, none",
    "scenario=face scenario.scan=no/such/file.obj": "no/such/file.obj",
    "scenario=face scenario.up=w": "up",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_is_one_clear_line_and_exit_code_2(
    arguments: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    code = main([f"hydra.run.dir={tmp_path}/run", *arguments.split()])
    out, err = capfd.readouterr()
    assert code == 2, err
    assert len(err.strip().splitlines()) == 1, err
    assert err.startswith("rbfevo: ")
    assert MISTAKES[arguments] in err
    assert "Traceback" not in out + err
    assert not list(tmp_path.glob("run/*.npz"))


def test_cuda_where_there_is_none(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main([f"hydra.run.dir={tmp_path}/run", "device=cuda"]) == 2
    assert "no CUDA device" in capfd.readouterr().err


@pytest.mark.parametrize("content", [b"", b"\x00\xff" * 50, b"v 0 0 0\n", b"v 0 0 0\nv nan 0 0\nv 1 0 0\nf 1 2 3\n"])
def test_scans_that_cannot_be_used(content: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scan = tmp_path / "scan.obj"
    scan.write_bytes(content)
    assert main([f"hydra.run.dir={tmp_path}/run", "scenario=face", f"scenario.scan={scan}"]) == 2
    err = capfd.readouterr().err
    assert len(err.strip().splitlines()) == 1
    assert "scan.obj" in err


def test_an_output_directory_that_cannot_be_made(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main([f"hydra.run.dir={tmp_path}/file/run", "method=lloyd", *SMALL]) == 2
    err = capfd.readouterr().err
    assert "file/run" in err
    assert len(err.strip().splitlines()) == 1


def run(directory: Path, *overrides: str) -> dict[str, np.ndarray]:
    assert main([f"hydra.run.dir={directory}", *SMALL, *overrides]) == 0
    with np.load(directory / "setups.npz") as archive:
        return dict(archive)


def test_more_elements_than_starts_where_starts_are_not_used(tmp_path: Path) -> None:
    arguments = ("method=gradient", "method.population=488", "preference=0", "method.generations=2", "method.polish=1")
    arguments += ("centers=4",)
    assert run(tmp_path, *arguments)["preference"].tolist()[-1] == 0.0


def test_a_sweep_over_methods_may_have_preferences_that_some_do_not_use(tmp_path: Path) -> None:
    arguments = ["method=lloyd,cmaes", "preference=0.3", "checkpoint.every=null", "method.generations=2", "centers=4"]
    assert main(["-m", f"hydra.sweep.dir={tmp_path}", *SMALL, *arguments]) == 0
    found = [json.loads(path.read_text()) for path in tmp_path.glob("*/summary.json")]
    warned = {run["method"]: [w for w in run["warnings"] if "finds the same setups without it" in w] for run in found}
    assert [len(warned["lloyd"]), len(warned["cmaes"])] == [1, 0]


def test_results_are_never_overwritten(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run(tmp_path, "method=lloyd")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert main([f"hydra.run.dir={tmp_path}", *SMALL, "method=random", "seed=5"]) == 2
    assert "already holds results" in capfd.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("arguments", "count"),
    [
        ("method=nsga2 method.generations=3 method.population=8", {"random": 8, "nsga2": 8}),
        ("method=cmaes method.generations=3 method.population=8 method.parents=3", {"random": 8, "cmaes": 1}),
        ("method=cmaes method.generations=2 preference=[0,0.25,1]", {"random": 100, "cmaes": 3}),
        (
            "method=gradient method.generations=6 method.polish=2 method.starts=16 method.population=16 method.front=2",
            {"random": 16, "gradient": 2},
        ),
        (
            "method=gradient method.generations=6 method.polish=2 method.population=16 preference=[0,0.5,1]",
            {"random": 160, "gradient": 3},
        ),
        ("method=blend method.climbs=2 preference=[0.3,0.7]", {"blend": 2}),
        ("method=lloyd", {"lloyd": 1}),
        ("method=ols", {"ols": 1}),
        ("method=random method.population=7", {"random": 7}),
        (
            "method.nsga2.generations=2 method.cmaes.generations=2",
            {"random": 100, "nsga2": 100, "cmaes": 11, "lloyd": 1, "ols": 1, "blend": 11},
        ),
    ],
)
def test_run_directory_of_every_method(arguments: str, count: dict[str, int], tmp_path: Path) -> None:
    table = run(tmp_path, "centers=6", *arguments.split())
    assert {name: int((table["method"] == name).sum()) for name in set(table["method"].tolist())} == count
    p = sum(count.values())
    assert table["centers"].shape == (p, 6, 2)
    for name in ("centers", "regularity", "improvement_potential", "variability", "preference"):
        assert table[name].dtype == np.float64
    assert table["method"].dtype.kind == "U"
    assert table["nondominated"].dtype == bool
    assert table["nondominated"].any()
    preferred = ("blend", "cmaes", "gradient") if "preference" in arguments else ("blend", "cmaes")
    assert (np.isfinite(table["preference"]) == np.isin(table["method"], preferred)).all()
    with (tmp_path / "setups.csv").open() as file:
        lines = list(csv.DictReader(file))
    np.testing.assert_array_equal([float(line["regularity"]) for line in lines], table["regularity"])
    assert "centers" not in lines[0]
    with (tmp_path / "history.csv").open() as file:
        history = list(csv.DictReader(file))
    assert {line["method"] for line in history} == set(count) - ({"random"} if len(count) > 1 else set())
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["evaluations"] == int(history[-1]["evaluations"])
    assert summary["stop_reason"] == "budget"
    assert summary["support"] == 0.5
    assert (tmp_path / ".hydra" / "config.yaml").exists()
    with np.load(tmp_path / "scenario.npz") as scenario:
        assert set(scenario) == {"vertices", "faces", "gradient", "weights", "lower", "upper"}
        inside = (table["centers"] >= scenario["lower"]) & (table["centers"] <= scenario["upper"])
    assert inside.all()


@pytest.mark.parametrize("scenario", ["plane", "face"])
@pytest.mark.parametrize("kernel", ["wendland local", "wendland", "triharmonic"])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_saved_scores_are_those_of_a_plain_svd(scenario: str, kernel: str, manipulation: str, tmp_path: Path) -> None:
    support = {"plane": 0.5, "face": 1.0}[scenario] * (0.5 if "local" in kernel else 1.0)
    arguments = [f"scenario={scenario}", f"kernel={kernel.split()[0]}", f"manipulation={manipulation}"]
    arguments += [f"kernel.support={support}"] if "wendland" in kernel else []
    arguments += ["scenario.resolution=[40,40]"] if scenario == "plane" else ["scenario.subdivisions=3"]
    arguments += [
        "method.nsga2.generations=6",
        "method.nsga2.population=12",
        "method.cmaes.generations=3",
        "quiet=true",
    ]
    arguments += [
        "preference=[0,0.5,1]",
        "method.cmaes.population=12",
        "method.cmaes.parents=4",
        "method.ols.per_axis=12",
        "method.blend.per_axis=12",
        "method.blend.climbs=3",
    ]
    assert main([f"hydra.run.dir={tmp_path}", *arguments]) == 0
    with np.load(tmp_path / "setups.npz") as setups, np.load(tmp_path / "scenario.npz") as files:
        C, R, P, V = (setups[key] for key in ("centers", "regularity", "improvement_potential", "variability"))
        X, g, w = (files[key] for key in ("vertices", "gradient", "weights"))
    d = X.shape[1]

    def phi(r: np.ndarray) -> np.ndarray:
        if "wendland" in kernel:
            return np.where(r < support, (1 - r / support) ** 4 * (4 * r / support + 1), 0.0)
        return r**3 if d == 3 else np.where(r > 0, r**2 * np.log(np.where(r > 0, r, 1.0)), 0.0)

    np.testing.assert_allclose((w[:, None] * g**2).sum(), 1.0, rtol=1e-12)
    for i, c in enumerate(C):
        Phi = phi(np.linalg.norm(X[:, None] - c, axis=2))
        U = Phi
        if manipulation == "direct":
            U = np.linalg.solve(phi(np.linalg.norm(c[:, None] - c, axis=2)), Phi.T).T
        sigma = np.linalg.svd(Phi, compute_uv=False)
        rank = int((sigma > max(U.shape) * np.finfo(float).eps * sigma[0]).sum())
        u = np.linalg.svd(Phi, full_matrices=False)[0][:, :rank]
        potential = 1 - ((g - u @ (u.T @ g)) ** 2).sum()
        sigma = np.linalg.svd(U, compute_uv=False)
        regularity = sigma[-1] / sigma[0] if rank == len(c) else 0.0
        assert abs(regularity - R[i]) <= 1e-6 * R[i] + 1e-12
        assert abs(potential - P[i]) <= 1e-8
        assert V[i] == pytest.approx(rank / len(X), abs=1e-15)


def test_the_same_seed_twice_gives_the_same_result_and_another_one_does_not(tmp_path: Path) -> None:
    arguments = ["method.nsga2.generations=4", "method.cmaes.generations=3", "preference=[0.2,0.8]", "centers=5"]
    first, second = (run(tmp_path / name, *arguments) for name in ("a", "b"))
    other = run(tmp_path / "c", *arguments, "seed=1")
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
    assert not np.array_equal(first["centers"], other["centers"])


def test_a_list_of_preferences_is_the_same_as_one_after_the_other(tmp_path: Path) -> None:
    arguments = ["method=cmaes", "method.generations=4", "centers=4"]
    batch = run(tmp_path / "batch", *arguments, "preference=[0.3,0.7]")
    single = run(tmp_path / "single", *arguments, "preference=0.7")
    np.testing.assert_allclose(batch["centers"][-1], single["centers"][-1], atol=1e-9)


def test_a_sweep_goes_on_after_a_failed_job(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arguments = ["-m", f"hydra.sweep.dir={tmp_path}", *SMALL, "method=cmaes", "method.generations=2", "centers=4"]
    assert main([*arguments, "preference=0,2,0.2", "seed=0,1"]) == 2
    assert len(list(tmp_path.glob("*/setups.npz"))) == 4
    assert capfd.readouterr().err.count("rbfevo: ") == 2


def test_a_sweep_over_the_preference_grid(tmp_path: Path) -> None:
    arguments = ["-m", f"hydra.sweep.dir={tmp_path}", *SMALL, "method=cmaes", "method.generations=2", "centers=4"]
    assert main([*arguments, "preference=0,0.1,0.2", "seed=0,1"]) == 0
    tables = [np.load(path) for path in sorted(tmp_path.glob("*/setups.npz"))]
    assert sorted(float(table["preference"][-1]) for table in tables) == [0.0, 0.0, 0.1, 0.1, 0.2, 0.2]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_keeps_what_it_found(number: signal.Signals, code: int, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rbfevo", f"hydra.run.dir={tmp_path}/run", "method=nsga2", "centers=4"]
    command += ["method.generations=1000000", "scenario.resolution=[12,12]", "evaluator=eager", "checkpoint.every=0"]
    command += ["figures=false"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    run = tmp_path / "run"
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        end = time.monotonic() + 60
        while time.monotonic() < end:  # until the search is on its way
            if (run / checkpoint.NAME).exists() and checkpoint.load(run)["progress"]:
                break
            time.sleep(0.05)
        process.send_signal(number)
        process.stdout.read()
        assert process.wait(60) == code
    with np.load(tmp_path / "run" / "setups.npz") as table:
        assert (table["method"] == "nsga2").sum() == 100
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["stop_reason"].startswith("interrupted")
    assert not list((tmp_path / "run").glob(".*.npz*"))


@pytest.mark.figures
def test_a_run_draws_its_figures(tmp_path: Path) -> None:
    run(tmp_path, "method=random", "method.population=10", "centers=4")
    for name in ("front.png", "centers.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_small_runs_do_not_wait_for_a_compiler(tmp_path: Path) -> None:
    run(tmp_path / "small", "method=lloyd", "evaluator=auto")
    assert json.loads((tmp_path / "small" / "summary.json").read_text())["evaluator"] == "eager"


def test_start_up_is_not_slow_because_of_figures() -> None:
    """Figures are drawn by processes of their own: a run itself imports neither pyvista nor matplotlib."""
    heavy = ("pyvista", "matplotlib", "vtkmodules")
    code = f"import sys, rbfevo.runs.run; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "[]", done.stderr
