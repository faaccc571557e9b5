"""`python -m rbfevo.fit RUN --pick knee`: optimize the design with a setup of a run."""

from __future__ import annotations

import argparse
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rbfevo.choices import FIT_MANIPULATIONS, FIT_STRATEGIES, refuse_others
from rbfevo.commands import parsers
from rbfevo.errors import UserError
from rbfevo.files import refuse_held
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read

LINE_EVERY = 10.0  # seconds between lines of progress
SMOOTHNESS = 1.0  # where the target has closest points
DESCRIPTION = "Optimize the design with a setup of a run, and see how fast and how far it gets."


def parser() -> parsers.Parser:
    """The options; their defaults are those of `fits`, but for the smoothness."""
    made = parsers.PickParser("rbfevo.fit", DESCRIPTION)
    made.add_argument("--manipulation", help="indirect, direct or orthogonalized (default: that of the run)")
    made.add_argument("--strategy", default="isotropic", help="isotropic (adapts only the step size; default) or cmaes")
    made.add_argument("--seed", type=int, default=0, help="seed of the random numbers (default: 0)")
    made.add_argument("--generations", type=int, default=5000, help="the largest number of generations (default: 5000)")
    made.add_argument("--within", type=float, default=0.05, help="stop at 1 + WITHIN times the optimum (default: 0.05)")
    made.add_argument(
        "--smoothness", type=float, help=f"weight of the Laplacian term, for scans (default: {SMOOTHNESS:g})"
    )
    made.add_argument("--parents", type=int, default=25, help="parents of a generation (default: 25)")
    made.add_argument("--population", type=int, default=100, help="offspring of a generation (default: 100)")
    made.add_argument("--out", type=Path, help="directory to write (default: RUN/fit-PICK-MANIPULATION-STRATEGY-seedN)")
    made.add_argument("--quiet", action="store_true", help="print nothing")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, 2 for a user's mistake, or 130 and 143 after SIGINT and SIGTERM."""
    return parsers.carried_out(parser, carry_out, arguments)


def carry_out(options: argparse.Namespace) -> int:
    """One fit into its directory.

    Raises:
        UserError: for a user's mistake; nothing is written then.
    """
    record = read(options.run)
    row = pick(record, options.pick)
    if not 0 <= options.seed < 2**63:
        raise UserError(f"--seed {options.seed}: give a whole number from 0 to 2^63 - 1")
    refuse_others("strategy", options.strategy, FIT_STRATEGIES)
    if options.manipulation is not None:
        refuse_others("manipulation", options.manipulation, FIT_MANIPULATIONS)

    import torch  # takes seconds: only once the run and the pick are known to exist

    from rbfevo import figures
    from rbfevo.fit import results, source, strategy
    from rbfevo.methods.method import random_stream
    from rbfevo.runs.interruption import Interruption
    from rbfevo.scoring.threads import coarse

    show = (lambda _: None) if options.quiet else (lambda line: print(line, flush=True))
    with Interruption() as interruption, coarse():
        origin = source.rebuild(options.run, record)
        if origin.scenario.direction_only:
            raise UserError(
                f"{options.run}: this run has a sensitivity, which gives a direction but no target to fit; "
                "use python -m rbfevo.export and rbfevo.apply"
            )
        manipulation = options.manipulation or origin.manipulation
        if options.smoothness is None:
            options.smoothness = 0.0 if origin.scenario.closest is None else SMOOTHNESS
        out = options.out or options.run / (
            f"fit-{options.pick.strip().replace(':', '-')}-{manipulation}-{options.strategy}-seed{options.seed}"
        )
        refuse_held(out, results.RESULTS, "--out")
        centers = torch.from_numpy((record.centers if record.genotype is None else record.genotype)[row])
        show(f"{options.pick}: row {row} of {options.run}, {manipulation} manipulation, {options.strategy} strategy")
        start = time.perf_counter()
        (fit,) = strategy.fits(
            origin.scenario,
            origin.kernel,
            centers[None],
            manipulation,
            options.strategy,
            generators=[random_stream(options.seed, "fit")],
            generations=options.generations,
            within=options.within,
            smoothness=options.smoothness,
            parents=options.parents,
            population=options.population,
            report=None if options.quiet else Progress(options.generations, start),
            stop=lambda: interruption.signal is not None,
        )
        seconds = time.perf_counter() - start
        if fit.stop.startswith("not fitted"):
            raise UserError(f"{options.run}, row {row}, {manipulation}: {fit.stop}")
        summary = contents(options, record, row, out, manipulation, fit, seconds, interruption.signal)
        results.write_fit(out, origin, centers, fit, summary)
    for warning in figures.draw(out):
        show(f"warning: {warning}")
    for line in closing(summary, out):
        show(line)
    return 0 if interruption.signal is None else 128 + interruption.signal


class Progress:
    """A line of progress, at most every ten seconds."""

    def __init__(self, generations: int, start: float) -> None:
        self.generations, self._last = generations, start - 0.8 * LINE_EVERY  # the first line comes after two seconds

    def __call__(self, generation: int, running: int, ratio: float) -> None:
        now = time.perf_counter()
        if now - self._last >= LINE_EVERY:
            self._last = now
            print(f"generation {generation} of at most {self.generations}: {ratio:.4g} times the optimum", flush=True)


def contents(
    options: argparse.Namespace,
    record: Record,
    row: int,
    out: Path,
    manipulation: str,
    fit: Any,
    seconds: float,
    interrupted: int | None,
) -> dict[str, Any]:
    """The contents of fit.json; errors in squared model units."""
    from rbfevo.runs.summary import versions

    preference = float(record.preference[row])
    stop = fit.stop if interrupted is None else f"interrupted by {signal.Signals(interrupted).name}"
    return {
        # Relative, so that a run directory can be moved with the fits in it.
        "run": os.path.relpath(options.run.resolve(), out.resolve()),
        "pick": options.pick.strip(),
        "row": row,
        "method": str(record.method[row]),
        "preference": preference if preference == preference else None,
        "scenario": record.summary.get("scenario"),
        "kernel": record.summary.get("kernel"),
        "support": record.summary.get("support"),
        "centers": int(record.centers.shape[1]),
        "manipulation": manipulation,
        "strategy": options.strategy,
        "seed": options.seed,
        "parents": options.parents,
        "population": options.population,
        "generations_limit": options.generations,
        "within": options.within,
        "smoothness": options.smoothness,
        "regularity": fit.regularity,
        "improvement_potential": fit.improvement_potential,
        "start_error": fit.start_error,
        "optimum": fit.optimum,
        "optimum_iterations": fit.optimum_iterations,
        "error": fit.error,
        "generations": fit.generations,
        "reached": fit.reached,
        "evaluations": fit.evaluations,
        "seconds": seconds,
        "stop_reason": stop,
        "versions": versions(),
    }


def closing(summary: dict[str, Any], out: Path) -> list[str]:
    """The last lines on the screen."""
    share = summary["error"] / summary["optimum"] - 1 if summary["optimum"] > 0 else float("inf")
    stop = summary["stop_reason"]
    how = stop if stop != "generations" else "not reached"
    goal = f"within {100 * summary['within']:.3g}% of the optimum"
    return [
        f"R = {summary['regularity']:.4g}, P = {summary['improvement_potential']:.4f}",
        f"error: {summary['start_error']:.6g} at the start, {summary['error']:.6g} now, "
        f"{summary['optimum']:.6g} at the optimum ({share:.1%} above it)",
        f"{goal}: {how} after {summary['generations']} generations, "
        f"{summary['evaluations']} evaluations, {summary['seconds']:.1f} s",
        f"files: {out}",
    ]


if __name__ == "__main__":
    parsers.start(main)
