"""Rules of `rbfevo.step` on the bracket of examples/elastic: the objective by the number of solutions. docs/step.md.

OMP_NUM_THREADS=1 python -m benchmarks.rules outputs/bracket     # made by the commands of docs/step.md
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.choosing import ROOT
from rbfevo import meshes
from rbfevo.commands.following import Follower
from rbfevo.descent import Descent, State
from rbfevo.descent.loop import RULES
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup

SHOWN = (1, 2, 4, 6, 8, 10, 15, 20, 30)


def main() -> None:
    """Print a row for each rule and step: J after some solutions, in % of the first."""
    made = argparse.ArgumentParser(description=__doc__)
    made.add_argument("out", type=Path, metavar="OUT", help="directory of examples/elastic/solve.py, with a run")
    made.add_argument("--cells", type=int, nargs=3, default=(24, 6, 3))
    made.add_argument("--steps", type=float, nargs="+", default=(0.01, 0.02, 0.04))
    made.add_argument("--lines", action="store_true", help="print the history of each")
    made.add_argument("--rules", nargs="+", default=RULES)
    options = made.parse_args()
    sys.path.insert(0, str(ROOT / "examples" / "elastic"))
    bracket, elasticity, solver = (importlib.import_module(name) for name in ("bracket", "elasticity", "solve"))
    record = read(options.out / "run")
    chosen = setup(record, pick(record, "potential:0.95"))
    case: Any = bracket.bracket(options.cells)
    print("| rule | step | " + " | ".join(map(str, SHOWN)) + " | solutions | best |")
    with meshes.opened(options.out / "bracket.vtu") as mesh:
        follower = Follower(options.out / "bracket.vtu", mesh, record, chosen)
        places = [
            int(np.flatnonzero((np.abs(mesh.points - vertex) < 1e-9).all(axis=1))[0]) for vertex in record.vertices
        ]
        for rule in options.rules:
            for step in options.steps:
                begin = time.perf_counter()
                state = State.begin((chosen.count, 3), rule, step, 1e-5)
                descent, best = Descent(record, chosen, state), []
                while len(best) <= SHOWN[-1]:
                    proposal = (
                        descent.state.proposal if descent.state.best is None else descent.propose(follower.unusable)
                    )
                    if proposal is None:
                        break
                    points = mesh.points + follower.displacement(proposal.weights)
                    try:
                        found = case.body.solve(points)
                    except elasticity.ShapeError as error:
                        descent.fail(str(error))
                        continue
                    slope = found.compliance_gradient + solver.PRICE * found.volume_gradient
                    line = descent.accept(found.compliance + solver.PRICE * found.volume, slope[places])
                    best.append(line.best)
                if options.lines:
                    print("\n".join(map(str, descent.state.lines)), file=sys.stderr, flush=True)
                shares = [f"{100 * best[k] / best[0]:.2f}" if k < len(best) else "" for k in SHOWN]
                end = f"{len(best) - 1} | {100 * best[-1] / best[0]:.3f}"
                print(f"| {rule} | {step:g} | {' | '.join(shares)} | {end} |", flush=True)
                print(f"{descent.state.ended}; {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
