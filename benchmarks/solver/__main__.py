"""Setups and rules on real solvers, by adjoint solution: docs/solver.csv.

OMP_NUM_THREADS=1 python -m benchmarks.solver duct body diffuser     # hours; what was finished is skipped
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.choosing import ROOT, write
from benchmarks.solver.descent import descend
from benchmarks.solver.flow import Flow
from benchmarks.solver.plan import PLANS, Chosen, setups

RUNS, TABLE = ROOT / "outputs" / "solver", ROOT / "docs" / "solver.csv"
STEEPEST = ("advised", "Lloyd 0")  # families that take steepest descent, too, with the first radius


def rules(chosen: Chosen, first: float) -> tuple[str, ...]:
    """The rules that a setup is stepped by."""
    return ("max-norm", "steepest") if chosen.family in STEEPEST and chosen.radius == first else ("max-norm",)


def carry_out(name: str, only: str | None) -> None:
    """The descents of a case that are not there yet, a file each."""
    plan, case = PLANS[name], Flow(name, RUNS / name)
    for chosen in setups(case.settings, plan, RUNS / name / "runs"):
        if only is not None and chosen.size != only:
            continue
        for rule in rules(chosen, plan.radii[0]):
            label = f"{chosen.family}-{chosen.size}-{chosen.radius:g}-{rule}".replace(" ", "-")
            part = RUNS / name / f"{label}.csv"
            if part.exists():
                continue
            begin = time.perf_counter()
            lines = descend(case, chosen.record, chosen.setup, rule, plan.step, RUNS / name / label)
            known = {"case": name, "setup": chosen.family, "size": chosen.size, "centers": chosen.setup.count}
            known |= {"radius": chosen.radius, "rule": rule}
            write(part, [{key: _short(value) for key, value in (known | line).items()} for line in lines])
            last = 100 * (1 - lines[-1]["best"] / lines[0]["J"])
            print(f"{name} {label}: -{last:.2f} % in {time.perf_counter() - begin:.0f} s", flush=True)


def _short(value: Any) -> Any:
    return f"{value:.8g}" if isinstance(value, float) else value


def collected() -> list[dict[str, Any]]:
    """The lines of all descents."""
    found: list[dict[str, Any]] = []
    for name in PLANS:
        for path in sorted((RUNS / name).glob("*.csv")):
            with path.open(encoding="utf-8") as file:
                found += csv.DictReader(file)
    return found


def main() -> int:
    """Carry out what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="*", choices=[[], *PLANS], help="only these cases")
    parser.add_argument("--size", choices=("few", "many"), help="only setups of this size")
    options = parser.parse_args()
    RUNS.mkdir(parents=True, exist_ok=True)
    for name in options.case or PLANS:
        carry_out(name, options.size)
    if lines := collected():
        write(Path(TABLE), lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
