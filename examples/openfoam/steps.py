"""What both examples share: from an OpenFOAM case to a deformed mesh and the objective on it, command by command."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
DEBIAN = Path("/usr/share/openfoam")  # where Debian's package has the directory that WM_PROJECT_DIR names
SEARCH = (
    "method.starts=32",
    "method.population=24",
    "method.generations=40",
    "method.front=24",
)  # seconds, not a minute
HEADER = "FoamFile\n{{\n    version 2.0;\n    format  ascii;\n    class   dictionary;\n    object  {};\n}}\n\n"


class Example(NamedTuple):
    """One of the examples.

    Attributes:
        name: of its directory of dictionaries; tools: programs of OpenFOAM that it needs beside those of every example.
        files: writes what is computed, into a case's directory, with the number of cells along an edge times a scale.
        meshing: the commands that make the mesh, without -case.
        objective: the file with the values of the objective, in optimisation/objective/0 of a case.
        settings: of the run that finds the setup; step: default of --step.
    """

    name: str
    files: Callable[[Path, float], None]
    meshing: tuple[tuple[str, ...], ...]
    objective: str
    settings: tuple[str, ...]
    step: float


class State(NamedTuple):
    """A mesh and the flow on it: the objective, and what checkMesh says."""

    objective: float
    orthogonality: float
    skewness: float


class StepError(Exception):
    """A command did not do what the example needs."""


def main(example: Example, arguments: list[str] | None = None) -> int:
    """Run an example; return 0, 1 if a step fails, or 2 for what is missing or in the way."""
    options = parser(example).parse_args(arguments)
    tools = dict.fromkeys([*(command[0] for command in example.meshing), "checkMesh", "adjointOptimisationFoam"])
    missing = [tool for tool in tools if shutil.which(tool) is None]
    if missing:
        return complain(
            f"OpenFOAM's {', '.join(missing)} cannot be found: install OpenFOAM (on Debian, apt-get install openfoam), "
            "or source its etc/bashrc",
            2,
        )
    if options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        return complain(f"{options.out} exists already: give another directory, or remove it", 2)
    try:
        carry_out(example, options)
    except StepError as error:
        return complain(str(error), 1)
    return 0


def parser(example: Example) -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        description=f"From the mesh of the {example.name} to a deformed mesh and the objective on it. Every step is "
        "printed as the command that is run."
    )
    made.add_argument("out", type=Path, metavar="OUT", help="directory to make, such as outputs/" + example.name)
    made.add_argument(
        "settings", nargs="*", metavar="KEY=VALUE", help="more settings of the run, such as figures=false"
    )
    made.add_argument(
        "--step",
        type=float,
        nargs="+",
        metavar="S",
        help=f"the largest displacement, a fraction of the diagonal of the design ({example.step:g}); of several, each "
        "is tried",
    )
    made.add_argument("--scale", type=float, default=1.0, help="cells along each edge of the mesh, relative to 1")
    return made


def carry_out(example: Example, options: argparse.Namespace) -> None:
    """Carry out all steps, and print the table.

    Raises:
        StepError: if one of them fails.
    """
    started, out = time.perf_counter(), options.out
    if "WM_PROJECT_DIR" not in os.environ and DEBIAN.is_dir():
        os.environ["WM_PROJECT_DIR"] = str(DEBIAN)  # Debian's package sets none, and its tools want one
        print(f"$ export WM_PROJECT_DIR={DEBIAN}")
    case, run = out / "case", out / "run"
    out.mkdir(parents=True, exist_ok=True)
    shell("cp", "-r", HERE / example.name, case)
    example.files(case, options.scale)
    for command in example.meshing:
        foam(case, *command)
    quality = checked(case, "-constant")
    before = State(solved(example, case), *quality)
    settings = (*example.settings, *SEARCH, *options.settings)
    python("rbfevo", "scenario=mesh", f"scenario.template={case}", *settings, f"hydra.run.dir={run}")
    rows = []
    for size in options.step or [example.step]:
        export, moved = out / f"export-{size:g}", out / f"step-{size:g}"
        printed = python(
            *("rbfevo.export", run, "--pick", "potential:0.95", "--rule", "max-norm"),
            *("--step", f"{size:g}", "--out", export),
        )
        found = re.search(r"predicted change of the objective: (\S+)", printed)
        if found is None:
            raise StepError("rbfevo.export predicts no change of the objective")
        shell("mkdir", moved)
        shell("cp", "-r", *(case / part for part in ("0", "constant", "system")), moved)
        python(
            *("rbfevo.apply", run, "--pick", "potential:0.95", "--displacements", export / "displacements.csv"),
            *("--mesh", case, "--volume", "laplace", "--out", moved / "0"),
        )
        quality = checked(moved, "-latestTime")
        rows.append((size, State(solved(example, moved), *quality), float(found[1])))
    print("\n".join(table(before, rows)))
    print(f"{time.perf_counter() - started:.0f} s")


def table(before: State, rows: list[tuple[float, State, float]]) -> list[str]:
    """The result, a row for each size of the step."""
    lines = [
        "",
        "| step | J before | J after | predicted change | real change | real / predicted | largest non-orthogonality "
        "| largest skewness |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for size, after, predicted in rows:
        real = after.objective - before.objective
        lines.append(
            f"| {size:g} | {before.objective:.5f} | {after.objective:.5f} "
            f"| {predicted:+.5f} ({100 * predicted / before.objective:+.1f} %) "
            f"| {real:+.5f} ({100 * real / before.objective:+.1f} %) | {real / predicted:.2f} "
            f"| {before.orthogonality:.1f} -> {after.orthogonality:.1f} "
            f"| {before.skewness:.2f} -> {after.skewness:.2f} |"
        )
    return [*lines, ""]


def checked(case: Path, when: str) -> tuple[float, float]:
    """The largest non-orthogonality and skewness of a mesh that checkMesh passes."""
    text = foam(case, "checkMesh", when)
    if "Mesh OK." not in text:
        raise StepError(f"checkMesh does not pass: {case}/log.checkMesh")
    numbers = [re.search(pattern, text) for pattern in (r"non-orthogonality Max: (\S+)", r"Max skewness = (\S+)")]
    return tuple(float(found[1]) if found else float("nan") for found in numbers)  # pyright: ignore[reportReturnType]


def solved(example: Example, case: Path) -> float:
    """The objective of a case, by its flow; its adjoint is solved as well."""
    foam(case, "adjointOptimisationFoam")
    lines = (case / "optimisation" / "objective" / "0" / example.objective).read_text().splitlines()
    return float(lines[-1].split()[1])


def foam(case: Path, *command: str) -> str:
    """Run a program of OpenFOAM with its log in the case's directory; return what it prints."""
    log = case / f"log.{command[0]}"
    words = [*command, "-case", str(case)]
    print(f"$ {shlex.join(words)} > {shlex.quote(str(log))}", flush=True)
    with log.open("w") as stream:
        code = subprocess.run(words, stdout=stream, stderr=subprocess.STDOUT, check=False).returncode
    text = log.read_text(errors="replace")
    if code:
        raise StepError(f"{command[0]} ends with exit code {code}: {' '.join(text[-300:].split())} ({log})")
    return text


def python(module: str, *arguments: str | Path) -> str:
    """Run a module of rbfevo; return what it prints, which is shown."""
    words = ["-m", module, *map(str, arguments)]
    print(f"$ python {shlex.join(words)}", flush=True)
    return _run([sys.executable, *words])


def shell(*command: str | Path) -> None:
    """Run a small command."""
    words = [str(word) for word in command]
    print(f"$ {shlex.join(words)}", flush=True)
    _run(words)


def _run(words: list[str]) -> str:
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    print(done.stdout, end="", flush=True)
    if done.returncode:
        raise StepError(f"{shlex.join(words[:3])} ends with exit code {done.returncode}")
    return done.stdout


def write(path: Path, content: str) -> None:
    """Write a dictionary of a case, with its header."""
    path.write_text(HEADER.format(path.name) + content)
    print(f"written: {path}", flush=True)


def complain(line: str, code: int) -> int:
    """One line on stderr; returns the exit code."""
    print(f"{Path(sys.argv[0]).name}: {line}", file=sys.stderr, flush=True)
    return code
