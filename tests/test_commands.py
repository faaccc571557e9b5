"""What all command lines share: how they end, what a closed pipe does to them, and what they wait for."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rbfevo.__main__ import main
from rbfevo.commands import parsers
from rbfevo.errors import UserError

ROOT = Path(__file__).parents[1]
SMALL = ["scenario.resolution=[12,12]", "centers=4", "evaluator=eager", "figures=false"]
MODULES = {  # with arguments that are right
    "rbfevo.export": ["RUN", "--pick", "knee"],
    "rbfevo.apply": ["RUN", "--pick", "knee", "--weights", "w.csv", "--mesh", "a.vtp", "--out", "b.vtp"],
    "rbfevo.show": ["RUN"],
    "rbfevo.collect": ["RUN"],
    "rbfevo.step": ["RUN", "--pick", "knee", "--state", "state", "--out", "b.vtp"],
    "rbfevo.fit": ["RUN", "--pick", "knee"],
    "rbfevo.figures": ["RUN"],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of six random setups."""
    directory = tmp_path_factory.mktemp("commands") / "run"
    assert main([f"hydra.run.dir={directory}", *SMALL, "quiet=true", "method=random", "method.population=6"]) == 0
    return directory


def command_of(name: str):
    """The module whose `main` the command is."""
    package = importlib.import_module(name)
    return package if hasattr(package, "main") else importlib.import_module(f"{name}.__main__")


def start(name: str, *arguments: str, imports: Path | None = None, **streams: Any) -> subprocess.Popen[bytes]:
    path = os.pathsep.join(map(str, [*([imports] if imports else []), ROOT]))
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    process: Any = subprocess.Popen([sys.executable, "-m", name, *arguments], env=environment, **streams)
    return process


def ended(name: str, *arguments: str, imports: Path | None = None) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    process = start(name, *arguments, imports=imports, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, err = process.communicate(timeout=120)
    return process.returncode, out.decode(), err.decode()


# --- how they end ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [(UserError("two\n  lines"), 2, "some.name: two lines"), (KeyboardInterrupt(), 130, "some.name: interrupted")],
)
def test_a_mistake_and_ctrl_c_are_one_line(error, code, line, capsys):
    def work() -> int:
        raise error

    assert parsers.outcome("some.name", work) == code
    assert capsys.readouterr() == ("", f"{line}\n")
    assert (parsers.outcome("some.name", lambda: None), parsers.outcome("some.name", lambda: 143)) == (0, 143)


@pytest.mark.parametrize("name", MODULES)
def test_ctrl_c_is_one_line_whatever_a_command_is_at(name, monkeypatch, capsys):
    module = command_of(name)

    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "carry_out", interrupted)
    assert module.main(MODULES[name]) == 130
    assert capsys.readouterr() == ("", f"{name}: interrupted\n")


@pytest.mark.parametrize(
    ("name", "arguments", "imported"),
    [
        ("rbfevo", ["method=lloyd"], "hydra"),
        ("rbfevo", [*SMALL, "method=lloyd", "hydra.run.dir=OUT"], "torch"),
        ("rbfevo.fit", ["RUN", "--pick", "knee"], "torch"),
        ("rbfevo.export", ["RUN", "--pick", "knee", "--out", "OUT"], "scipy"),
    ],
)
def test_ctrl_c_while_something_is_imported_is_one_line(name, arguments, imported, run, tmp_path):
    """A module that is interrupted as it is imported stands for the one that takes so long."""
    (tmp_path / "imports").mkdir()
    (tmp_path / "imports" / f"{imported}.py").write_text("raise KeyboardInterrupt\n")
    arguments = [word.replace("RUN", str(run)).replace("OUT", str(tmp_path / "out")) for word in arguments]
    code, _, err = ended(name, *arguments, imports=tmp_path / "imports")
    assert (code, err) == (130, f"{name}: interrupted\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", MODULES)
def test_an_unknown_option_is_one_line_that_says_where_the_options_are(name, capsys):
    assert command_of(name).main([*MODULES[name], "--bogus"]) == 2
    assert capsys.readouterr() == (
        "",
        f"{name}: unrecognized arguments: --bogus; see python -m {name} --help\n",
    )


# --- closed pipes ----------------------------------------------------------------------------------------------------


def ended_unheard(name: str, *arguments: str, too: str = "") -> tuple[int, str]:
    """Exit code and stderr of a command whose stdout nobody reads; with `too`, whose stderr nobody reads either."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        process = start(name, *arguments, stdout=writer, stderr=writer if too else subprocess.PIPE)
        _, err = process.communicate(timeout=120)
    finally:
        os.close(writer)
    return process.returncode, "" if too else err.decode()


@pytest.mark.parametrize("name", ["rbfevo", *MODULES])
def test_help_that_nobody_reads_ends_quietly(name):
    assert ended_unheard(name, "--help") == (0, "")


def test_a_mistake_that_nobody_reads_is_still_one():
    assert ended_unheard("rbfevo", "bogus", too="stderr") == (2, "")


def test_an_export_that_nobody_reads_is_whole(run, tmp_path):
    arguments = [str(run), "--pick", "knee", "--out", str(tmp_path / "out")]
    assert ended_unheard("rbfevo.export", *arguments) == (0, "")
    assert {path.name for path in (tmp_path / "out").iterdir()} >= {"centers.csv", "centers.vtp", "template.vtp"}


def test_a_run_that_nobody_listens_to_keeps_its_results(tmp_path):
    arguments = [
        *SMALL,
        f"hydra.run.dir={tmp_path / 'run'}",
        "method=nsga2",
        "method.population=8",
        "method.generations=3",
    ]
    assert ended_unheard("rbfevo", *arguments) == (0, "")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["stop_reason"], summary["evaluations"]) == ("budget", 32)
    assert (tmp_path / "run" / "setups.npz").exists()


def test_lines_that_cannot_be_encoded_end_nothing(tmp_path):
    code = "from rbfevo.commands import parsers\nparsers.start(lambda: print('caf\\xe9 \\u7f51 \\udcff') or 3)"
    output = {}
    for encoding in ("utf-8", "latin-1"):
        environment = os.environ | {"PYTHONIOENCODING": f"{encoding}:strict", "PYTHONPATH": str(ROOT)}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, timeout=60)
        assert (done.returncode, done.stderr) == (3, b"")
        output[encoding] = done.stdout.strip()
    assert output == {"utf-8": "café 网 ".encode() + b"\xff", "latin-1": b"caf\xe9 \\u7f51 \\udcff"}


# --- what they wait for ----------------------------------------------------------------------------------------------

HEAVY = ("torch", "numba", "scipy", "pyvista", "vtk", "vtkmodules", "trimesh", "matplotlib", "plotly", "meshio", "mne")
WITHOUT = """
import contextlib, importlib, io, json, sys
tasks, heavy = map(json.loads, sys.argv[1:])
for name, arguments in tasks:
    package = importlib.import_module(name)
    module = package if hasattr(package, "main") else importlib.import_module(f"{name}.__main__")
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        try:
            code = module.main(arguments)
        except SystemExit as error:
            code = error.code
    imported = [name for name in heavy if name in sys.modules]
    print(json.dumps([code, err.getvalue(), imported]))
"""
NOTHING = "RUN/nowhere"
AT_ONCE = [
    *[(name, ["--help"]) for name in ("rbfevo", *MODULES)],
    *[(name, ["--bogus"]) for name in ("rbfevo", *MODULES)],
    *[(name, [NOTHING if word == "RUN" else word for word in arguments]) for name, arguments in MODULES.items()],
    ("rbfevo.export", ["RUN", "--pick", "nee"]),
    ("rbfevo.show", ["RUN", "--pick", "index:99"]),
    ("rbfevo.step", ["RUN", "--pick", "nee", "--state", "RUN/state", "--out", "b.vtp"]),
    ("rbfevo.step", ["RUN", "--pick", "knee", "--state", "RUN/state"]),
    ("rbfevo.figures", ["RUN", "--only", "nothing"]),
    ("rbfevo.fit", ["RUN", "--pick", "knee", "--strategy", "both"]),
    ("rbfevo.fit", ["RUN", "--pick", "knee", "--manipulation", "both"]),
    *[
        ("rbfevo", arguments.split())
        for arguments in (
            "sed=3",
            "method.generatons=3",
            "method=gradient method.generatons=3",
            "method=nsga3",
            "bogus",
            "seed=x",
            "seed=-1",
            "centers=0",
            "preference=2",
            "figures=maybe",
            "device=tpu",
            "evaluator=fast",
            "checkpoint.every=never",
            "scenario=mesh scenario.template=RUN/nowhere.vtp",
            "scenario=null",
            "seed=[1",
            "seed=${nothing}",
            "hydra.run.dir=RUN",
            "resume=RUN/nowhere",
            "resume=RUN seed=3",
            "-m method=nsga3,lloyd",
            "--help method=gradient",
        )
    ],
]


@pytest.fixture(scope="module")
def at_once(run: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str, list[str]]]:
    """Exit code, stderr and what was imported by each, one after the other in one process."""
    tasks = [[name, [word.replace("RUN", str(run)) for word in arguments]] for name, arguments in AT_ONCE]
    where = tmp_path_factory.mktemp("at-once")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, json.dumps(tasks), json.dumps(HEAVY)],
        cwd=where, env=environment, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    keys = [f"{name} {' '.join(arguments)}" for name, arguments in AT_ONCE]
    return dict(zip(keys, map(json.loads, done.stdout.splitlines()), strict=True))


@pytest.mark.parametrize("key", [f"{name} {' '.join(arguments)}" for name, arguments in AT_ONCE])
def test_help_and_mistakes_do_not_wait_for_libraries(key, at_once):
    code, err, imported = at_once[key]
    assert imported == []
    if "--help" in key:
        assert (code, err) == (0, "")
    else:
        assert code == 2, err
        assert len(err.splitlines()) == 1


def test_the_first_line_of_a_run_comes_before_torch(tmp_path):
    (tmp_path / "torch.py").write_text("raise KeyboardInterrupt\n")
    out = tmp_path / "run"
    arguments = ["scenario=face", "kernel=triharmonic", "manipulation=direct", "method=lloyd", "centers=9", "seed=4"]
    _, output, _ = ended("rbfevo", *arguments, f"hydra.run.dir={out}", imports=tmp_path)
    first = f"scenario face, kernel triharmonic, manipulation direct, method lloyd, 9 centers, seed 4: {out}"
    assert output.splitlines() == [first]
    assert ended("rbfevo", *arguments, "quiet=true", f"hydra.run.dir={out}", imports=tmp_path)[1] == ""
