"""From a mesh to an optimized design, with a solver in Python. `python examples/elastic/optimize.py OUT`."""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from rbfevo.errors import UserError

# python -m rbfevo.advise scenario=mesh scenario.template=outputs/elastic/design.vtp scenario.sensitivity=sensitivity \
#   scenario.hold=held scenario.hold_width=30 scenario.symmetry=z scenario.symmetry_at=0 hydra.run.dir=outputs/advice
# recommended the settings from manipulation on, before any design was optimized:
SETTINGS = (
    *("scenario.sensitivity=sensitivity", "scenario.hold=held", "scenario.hold_width=30"),
    *("scenario.symmetry=z", "scenario.symmetry_at=0"),
    *("manipulation=direct", "kernel=wendland", "kernel.support=105.7", "centers=8", "scenario.smooth=10.21"),
    *("criterion.norm=16", "method=gradient"),
)
PARTS = {"skfem": "scikit-fem", "openmdao": "openmdao"}  # modules that are imported late, and the packages to install
SEARCH = ("method.starts=32", "method.population=24", "method.generations=40", "method.front=24")
BOUND = 6.0  # mm, of each parameter
ITERATIONS, TOLERANCE = 40, 1e-4


class StepError(Exception):
    """A command did not do what the example needs."""


def main(arguments: list[str] | None = None) -> int:
    """Run the example; return 0, 1 if a step fails, or 2 for what is in the way."""
    options = parser().parse_args(arguments)
    if options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        return complain(f"{options.out} exists already: give another directory, or remove it", 2)
    try:
        carry_out(options)
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        if missing not in PARTS:
            raise
        return complain(f"{PARTS[missing]} is not installed: pip install 'rbfevo[elastic]'", 2)
    except StepError as error:
        return complain(str(error), 1)
    return 0


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        description="From the mesh of a curved bracket to the stiffest one of the same volume within reach of a setup."
    )
    made.add_argument("out", type=Path, metavar="OUT", help="directory to make, such as outputs/elastic")
    made.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="more settings of the run, as figures=false")
    made.add_argument("--pick", default="potential:0.95", help="setup of the run (default: potential:0.95)")
    made.add_argument("--bound", type=float, default=BOUND, help=f"of each parameter, in mm (default: {BOUND:g})")
    made.add_argument(
        "--cells",
        type=int,
        nargs=3,
        default=(24, 6, 3),
        metavar="N",
        help="along the ring, across it, over half its width",
    )
    return made


def carry_out(options: argparse.Namespace) -> None:
    """Carry out all steps, and print the table.

    Raises:
        StepError: if one of them fails.
        ModuleNotFoundError: if a package is missing; nothing is written then.
    """
    started, out = time.perf_counter(), options.out
    import bracket
    import openmdao.api as om
    from compliance import optimized
    from elasticity import ShapeError

    from rbfevo import meshes

    out.mkdir(parents=True, exist_ok=True)
    mesh, run, deformed = out / "bracket.vtu", out / "run", out / "deformed.vtu"
    case = bracket.bracket(options.cells)
    before = case.body.solve(case.points)
    bracket.write(case, case.points, before, mesh)
    bracket.write_design(case, mesh, out / "design.vtp")
    settings = (f"scenario.template={out / 'design.vtp'}", *SETTINGS, *SEARCH, *options.settings)
    python("rbfevo", "scenario=mesh", *settings, f"hydra.run.dir={run}")
    try:
        found = optimized(case.body, before, run, options.pick, mesh, options.bound, ITERATIONS, TOLERANCE)
    except UserError as error:
        raise StepError(str(error)) from None
    except (ShapeError, om.AnalysisError) as error:
        raise StepError(f"{' '.join(str(error).split())}; or choose a smaller --bound") from None
    for number, solution in enumerate(found.solutions):
        print(f"solution {number}: J {solution.compliance:.3f} N mm, V {solution.volume:.1f} mm^3", flush=True)
    print(f"SLSQP: {found.message}")
    np.save(out / "displacements.npy", found.rows)
    python(
        *("rbfevo.apply", run, "--pick", options.pick, "--displacements", out / "displacements.npy"),
        *("--mesh", mesh, "--volume", "laplace", "--out", deformed),
    )
    with meshes.opened(deformed) as written:
        points = written.points
    apart = float(np.abs(points - found.points).max())
    if apart > 1e-9:
        raise StepError(f"apply's mesh differs from the optimizer's by {apart:.2g} mm")
    after = case.body.solve(points)
    bracket.write(case, points, after, out / "optimized.vtu")
    lines = ["", "| | J (N mm) | V (mm^3) | largest stress (N/mm^2) |", "|---|---|---|---|"]
    for name, state in (("before", before), ("after", after)):
        lines.append(f"| {name} | {state.compliance:.2f} | {state.volume:.0f} | {state.stress.max():.1f} |")
    changes = [getattr(after, part) / getattr(before, part) - 1.0 for part in ("compliance", "volume")]
    changes.append(after.stress.max() / before.stress.max() - 1.0)
    lines.append(f"| change | {' | '.join(f'{100 * change:+.2f} %' for change in changes)} |")
    print("\n".join(lines))
    print(f"\n{len(found.solutions)} solutions with their gradients; {time.perf_counter() - started:.0f} s in all")


def python(module: str, *arguments: str | Path) -> None:
    """Run a module of rbfevo; what it prints is shown."""
    words = ["-m", module, *map(str, arguments)]
    print(f"$ python {shlex.join(words)}", flush=True)
    code = subprocess.run([sys.executable, *words], check=False).returncode
    if code:
        raise StepError(f"{module} ends with exit code {code}")


def complain(line: str, code: int) -> int:
    """One line on stderr; returns the exit code."""
    print(f"optimize.py: {line}", file=sys.stderr, flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
