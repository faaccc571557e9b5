"""`python -m rbfevo.step RUN --pick knee --state DIR ...`: one step of an optimization with a solver in the loop."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rbfevo.commands import parsers
from rbfevo.errors import UserError

if TYPE_CHECKING:
    from rbfevo.commands.stepping import Stepping

ENDED = 3  # the exit code when nothing more is to be solved
STEP, TOLERANCE = 0.01, 1e-5
RULES = ("max-norm", "natural", "steepest", "quasi-newton")
DESCRIPTION = """Take the next step of an optimization: read the last design's solution, write the next one's mesh.

Called again and again, with a solver between the calls, it is an optimization:

  while python -m rbfevo.step RUN --pick knee --case CASE --state STATE --step 0.005
  do adjointOptimisationFoam -case CASE > log; done

Each call prints the predicted and the real change by the last step. A design that is worse, a mesh whose cells turn
inside out and a solver that failed (--failed) lead back to the best design and half the step. U stays on the run's own
design, and parameters accumulate. STATE is all that a call knows of the calls before: a loop that was killed goes on.
docs/step.md explains it."""
EPILOG = """Exit codes: 0 a design waits for its solution; 3 the descent has ended, and the best design is written; 2 a
mistake, or no new solution in two calls."""


def parser() -> parsers.Parser:
    """The options."""
    made = parsers.PickParser("rbfevo.step", DESCRIPTION, EPILOG)
    made.add_argument("--state", type=Path, required=True, metavar="DIR", help="directory of this optimization")
    made.add_argument(
        "--case",
        type=Path,
        metavar="CASE",
        help="an OpenFOAM case: solution, J and mesh are read, and the next written",
    )
    made.add_argument(
        "--mesh",
        type=Path,
        metavar="FILE",
        help="the mesh of the original design, to be deformed (default: the run's template, or CASE/constant)",
    )
    made.add_argument(
        "--out", type=Path, metavar="FILE", help="the next design's mesh; of a case a time (default: its newest one)"
    )
    made.add_argument(
        "--sensitivity",
        metavar="FILE",
        help="dJ/dx on the last design: FILE, or FILE:NAME, as scenario.sensitivity takes it; of a case also an array "
        "(default: the run's own for the original design, and that of the run in a case)",
    )
    made.add_argument(
        "--objective", metavar="J", help="the objective of the last design: a number, or a file that ends with it"
    )
    made.add_argument(
        "--failed",
        action="store_true",
        help="the solver failed on the last design: go back, whatever --sensitivity and --objective are",
    )
    made.add_argument(
        "--step",
        type=parsers.fraction,
        default=None,
        help="how far a vertex moves at most in a step, a fraction of the diagonal of the mesh or a percentage "
        f"(default: {STEP:g})",
    )
    made.add_argument("--rule", choices=RULES, help=f"how a step is chosen (default: {RULES[0]})")
    made.add_argument(
        "--tolerance",
        type=float,
        help=f"the predicted change, a share of J, below which the descent ends (default: {TOLERANCE:g})",
    )
    made.add_argument(
        "--volume",
        choices=("rbf", "laplace"),
        help="how points inside a volume mesh move, as for apply (default: laplace where there are solid cells)",
    )
    for name, what in (("design", "a patch of the design surface"), ("slip", "a further patch that slides")):
        made.add_argument(f"--{name}", action="append", default=[], metavar="PATCH", help=f"for laplace: {what}")
    made.add_argument(
        "--adapt",
        type=int,
        nargs="?",
        const=0,
        metavar="M",
        help="search M more centers beside the old ones (default: half as many) when the gain that the setup can reach "
        "of the sensitivity has fallen to half of what it was at first",
    )
    made.add_argument("--quiet", action="store_true", help="print only warnings")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line; return 0, 3 at the end of a descent, or 2 for a user's mistake."""
    return parsers.carried_out(parser, carry_out, arguments)


def carry_out(options: argparse.Namespace) -> int:
    """Take one step.

    Raises:
        UserError: for a user's mistake; the state stays as it was.
    """
    from rbfevo.recorded.picks import pick
    from rbfevo.recorded.record import read
    from rbfevo.recorded.setup import setup

    refuse(options)
    record = read(options.run)
    chosen = setup(record, pick(record, options.pick))
    from rbfevo.commands.stepping import Stepping
    from rbfevo.runs.lock import locked

    with locked(options.state):
        stepping = Stepping(options, record, chosen)
        return step(stepping, options)


def refuse(options: argparse.Namespace) -> None:
    """Raise UserError for options that cannot be, or not together."""
    if options.step is not None and not 0.0 < options.step <= 1.0:
        raise UserError(f"--step {options.step:g}: give a fraction of the mesh's diagonal, above 0 and at most 1")
    if options.tolerance is not None and not 0.0 <= options.tolerance < 1.0:
        raise UserError(f"--tolerance {options.tolerance:g}: give a share of the objective, from 0 to below 1")
    if options.case is None and options.out is None:
        raise UserError("give --case, or --out and --sensitivity: where is the mesh of the next design to go?")
    if options.adapt is not None and options.adapt < 0:
        raise UserError(f"--adapt {options.adapt}: give how many centers to add, at least 1")


def step(stepping: Stepping, options: argparse.Namespace) -> int:
    """Take the solution, if there is a new one, and write the next design."""

    def show(*lines: str) -> None:
        if not options.quiet:
            for line in filter(None, lines):
                print(line, flush=True)

    if stepping.state.ended:
        show(f"the descent has ended: {stepping.state.ended}", stepping.best_line())
        return ENDED
    if options.failed:
        show(stepping.fail())
    else:
        solution = stepping.solution()
        if solution is None:
            return waiting(stepping, show)
        show(*stepping.accept(solution))
    if options.adapt is not None and stepping.moves:
        show(*stepping.adapt(options.adapt))
    show(*stepping.propose())
    for warning in stepping.warnings:
        print(f"warning: {warning}", file=sys.stderr, flush=True)
    return ENDED if stepping.state.ended else 0


def waiting(stepping: Stepping, show: Callable[..., None]) -> int:
    """There is no new solution: write the mesh of the design that waits for one again, at most once.

    Raises:
        UserError: in the second call.
    """
    number, again = stepping.wait()
    line = f"there is no new solution: design {number} still waits for its own"
    if again:
        raise UserError(
            f"{line}: give --sensitivity and --objective, or solve the case; if the solver failed, --failed"
        )
    show(f"{line}; its mesh is in {stepping.out}")
    return 0


if __name__ == "__main__":
    parsers.start(main)
