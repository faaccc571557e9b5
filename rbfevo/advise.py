"""`python -m rbfevo.advise scenario=mesh ...`: how many control points, of which kernel and radius, for this design."""

from __future__ import annotations

import csv
import io
import json
import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfevo.commands import parsers
from rbfevo.errors import UserError
from rbfevo.files import refuse_held, write_whole

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from rbfevo.advice.choice import Choice, Trial
    from rbfevo.commands.composition import Composition
    from rbfevo.runs.config import Settings
    from rbfevo.scenarios.scenario import Scenario
    from rbfevo.scoring.kernels import Kernel

NAME = "rbfevo.advise"
HELP = """python -m rbfevo.advise scenario=mesh scenario.template=FILE scenario.sensitivity=NAME [KEY=VALUE ...]

Recommend a kernel, a support radius and a number of centers for a design, as the command that makes the setups.
It takes the keys of python -m rbfevo (see its --help); of these

  centers=M                      the most centers to try (16)
  kernel=, kernel.support=       leave one kernel, or one radius, to try (all)
  scenario.smooth=LENGTH         the length over which the sensitivity is smoothed (1.5 mean edges); null: not at all
  criterion.norm=P               the norm of the step that is bounded (16; 2 for targets)
  hydra.run.dir=DIR              the directory for advice.json, advice.csv, advice.html, advice.png and centers.csv

docs/advise.md explains what is measured, and how the recommendation is chosen."""
MOST, NORM, SMOOTH = 16, 16.0, 1.5  # centers; p for sensitivities; mean edges
RESULTS = ("advice.json", "advice.csv", "advice.html", "advice.png", "centers.csv")
PICK, STEP = "potential:0.95", 0.02
OWN = ("kernel", "kernel.support", "scenario.smooth", "centers", "criterion.norm", "method", "preference")


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line and return its exit code: 0, 2 for a user's mistake, 130, or 1."""
    return parsers.outcome(NAME, lambda: launched(sys.argv[1:] if arguments is None else list(arguments)))


def launched(arguments: Sequence[str]) -> int:
    """Compose the settings as a run does, and advise.

    Raises:
        UserError: for a user's mistake.
    """
    if any(argument in ("-h", "--help") for argument in arguments):
        print(HELP, flush=True)
        return 0
    from rbfevo import names
    from rbfevo.commands import composition, overrides
    from rbfevo.commands.launch import explained, prepared
    from rbfevo.commands.single import guarded, held
    from rbfevo.runs.config import CONF

    given = prepared(arguments)
    if names.is_sweep(given) or any(argument.partition("=")[0] == "resume" for argument in given):
        raise UserError("advise looks at one design at a time; leave out -m and resume=")
    code, message = 0, ""

    def task(config: DictConfig) -> None:
        nonlocal code, message
        code, message = guarded(lambda: advise(config, composition.Composition.current()))

    with explained(given), held(given):
        overrides.look_over(given, CONF)
        composition.start(task, given)
    if message:
        parsers.complain(NAME, message)
    return code


def advise(config: DictConfig, composition: Composition) -> int:
    """Study the design, write the files, print the recommendation; return 0.

    Raises:
        UserError: for a user's mistake.
    """
    from rbfevo.advice.choice import choose, reasons
    from rbfevo.advice.study import Study
    from rbfevo.runs.config import check

    settings, directory = check(config), composition.directory
    refuse_held(directory, RESULTS, "hydra.run.dir")
    given = {override.lstrip("+").partition("=")[0] for override in composition.overrides}
    scenario, norm = design_of(settings, given)
    most = settings.centers if "centers" in given else MOST
    tried = kernels_of(settings, given, scenario)
    for note in scenario.notes.values():
        report(settings, note)
    for warning in scenario.warnings:
        print(f"warning: {warning}", file=sys.stderr, flush=True)
    study = Study(scenario, norm, most, settings.seed)
    everything = []
    for kernel in tried:
        everything.append(study.found(kernel))
        report(settings, progress(everything[-1].trials))
    study.refine(everything)
    trials = [trial for found in everything for trial in found.trials]
    choice = choose(trials)
    setup = next(found.setups[choice.trial.centers] for found in everything if choice.trial in found.trials)
    why = reasons(trials, choice)
    commands = commands_of(composition, choice, scenario, norm)
    write(directory, settings, scenario, norm, trials, choice, why, commands, setup)
    report(settings, f"recommended: {described(choice.trial, scenario)}")
    for line in (*why, *commands):
        report(settings, line)
    report(settings, f"files: {directory}: {', '.join(name for name in RESULTS if (directory / name).exists())}")
    return 0


def report(settings: Settings, line: str) -> None:
    """A line on stdout, unless quiet."""
    if not settings.quiet:
        print(line, flush=True)


def design_of(settings: Settings, given: set[str]) -> tuple[Scenario, float]:
    """The design, with its sensitivity smoothed over some mean edges where nothing else is asked for, and p.

    Raises:
        UserError: for another representation than RBFs, or a file or key of the scenario that cannot be used.
    """
    from rbfevo.advice.study import edge
    from rbfevo.runs.config import build

    if settings.keep is not None:
        raise UserError(f"keep={settings.keep}: recommendations are for setups without centers that stay; leave it out")
    if not settings.representation["_target_"].endswith(".rbf"):
        raise UserError("advise compares kernels and radii of RBFs; leave out representation=")
    if settings.representation.get("polynomial") is not None:
        raise UserError(
            "advise compares kernels and radii of RBFs without a polynomial; leave out representation.polynomial="
        )
    scenario: Scenario = build(settings.scenario)
    if scenario.objectives is not None:
        listed = ", ".join(scenario.objectives.sources)
        raise UserError(f"advise looks at one objective at a time: set scenario.sensitivity to one of {listed}")
    sensitivity = scenario.direction_only
    norm = settings.criterion_norm if "criterion.norm" in given else NORM if sensitivity else 2.0
    if sensitivity and settings.scenario.get("smooth", 0) is None and "scenario.smooth" not in given:
        length = float(f"{SMOOTH * edge(scenario):.4g}")
        if length > 0.0:
            scenario = build({**settings.scenario, "smooth": length})
    return scenario, norm


def kernels_of(settings: Settings, given: set[str], scenario: Scenario) -> list[Kernel]:
    """The kernels to try: all radii of the kernel asked for, and where none was asked for the triharmonic one, too."""
    from rbfevo.advice.study import radii
    from rbfevo.runs.config import build

    fitting = scenario.vertices.shape[1], scenario.support, scenario.diagonal
    node: dict[str, Any] = settings.kernel
    if "support" in node and not given & {"kernel.support", "scenario.support"}:
        found = [build({**node, "support": float(f"{radius:.4g}")}, *fitting) for radius in radii(scenario)]
    else:
        found = [build(node, *fitting)]
    if not given & {"kernel", "kernel.support", "scenario.support"}:
        found.append(build({"_target_": "rbfevo.scoring.kernels.triharmonic"}, *fitting))
    return found


def progress(trials: Sequence[Trial]) -> str:
    """One line for a kernel and radius: gains of the numbers that were optimized."""
    parts = [
        f"{trial.centers} center{'s' * (trial.centers != 1)} {trial.optimized:.3f} "
        f"(nested {trial.nested:.3f}, Lloyd {trial.lloyd:.3f})"
        for trial in trials
        if math.isfinite(trial.optimized)
    ]
    first = trials[0]
    radius = "" if first.support is None else f" radius {first.support:.4g}"
    return f"{first.kernel}{radius}: {', '.join(parts)}"


def described(trial: Trial, scenario: Scenario) -> str:
    """The recommendation in one line."""
    radius = "" if trial.support is None else f", support radius {trial.support:.4g}"
    smooth = "" if scenario.smooth is None else f", sensitivity smoothed over {scenario.smooth:.4g}"
    centers = f"{trial.centers} center{'s' * (trial.centers != 1)}"
    return f"{centers}, kernel {trial.kernel}{radius}{smooth}; gain {trial.gain:.3f} (P = {trial.gain**2:.3f})"


def commands_of(composition: Composition, choice: Choice, scenario: Scenario, norm: float) -> list[str]:
    """The run that makes the setups, and the export of the one that the rule takes, as one types them into a shell."""
    trial, directory = choice.trial, composition.directory / "run"
    kept = [
        override
        for override in composition.overrides
        if override.lstrip("+").partition("=")[0].split(".")[0] not in ("method", "preference")
        and override.lstrip("+").partition("=")[0] not in OWN
    ]
    if not any(override.startswith("manipulation=") for override in kept):
        kept.append("manipulation=direct")
    chosen = [f"kernel={trial.kernel}"]
    chosen += [] if trial.support is None else [f"kernel.support={trial.support:.4g}"]
    chosen += [f"centers={trial.centers}"]
    chosen += [] if scenario.smooth is None else [f"scenario.smooth={scenario.smooth:.4g}"]
    chosen += [f"criterion.norm={norm:g}", "method=gradient", f"hydra.run.dir={directory}"]
    rule = ["--step", f"{STEP:g}", "--rule", "max-norm"] if scenario.direction_only else []
    run = ["python", "-m", "rbfevo", *kept, *chosen]
    return [shlex.join(run), shlex.join(["python", "-m", "rbfevo.export", str(directory), "--pick", PICK, *rule])]


def write(
    directory: Path,
    settings: Settings,
    scenario: Scenario,
    norm: float,
    trials: Sequence[Trial],
    choice: Choice,
    why: Sequence[str],
    commands: Sequence[str],
    setup: Any,
) -> None:
    """Write all files; pictures that cannot be drawn are left out with a warning."""
    from rbfevo.recorded.advice import Advice

    rows = [{key: _number(value) for key, value in trial._asdict().items()} for trial in trials]
    chosen = {key: _number(value) for key, value in choice.trial._asdict().items()} | {"gain": choice.trial.gain}
    template = settings.scenario.get("template")
    name = scenario.name if template is None else f"{template}"
    design = f"{name}, {len(scenario.vertices):,} vertices"
    advice = Advice(design, norm, scenario.smooth, rows, chosen, list(why), list(commands))
    directory.mkdir(parents=True, exist_ok=True)
    write_whole(directory / "advice.json", (json.dumps(advice._asdict(), indent=1) + "\n").encode())
    write_whole(directory / "advice.csv", _csv(list(rows[0]), [list(row.values()) for row in rows]))
    axes = "xyz"[: setup.shape[1]]
    write_whole(directory / "centers.csv", _csv(list(axes), setup.tolist()))
    if settings.figures:
        draw(directory)


def draw(directory: Path) -> None:
    """Draw the curves and the page."""
    from rbfevo.figures import advice as figure
    from rbfevo.figures import style
    from rbfevo.recorded.advice import read_advice

    found = read_advice(directory)
    style.save(figure.picture(found), directory / "advice.png")
    write_whole(directory / "advice.html", figure.page(found).encode())


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _csv(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> bytes:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([["" if cell is None else cell for cell in row] for row in rows])
    return stream.getvalue().encode()


if __name__ == "__main__":
    parsers.start(main)
