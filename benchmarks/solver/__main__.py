"""Setups and rules on real solvers, by adjoint solution: docs/solver.csv.

OMP_NUM_THREADS=1 python -m benchmarks.solver diffuser elastic duct body     # hours; what was finished is skipped
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.choosing import ROOT, read_table, write
from benchmarks.solver.descent import descend
from benchmarks.solver.elastic import Elastic
from benchmarks.solver.flow import Flow
from benchmarks.solver.picture import draw
from benchmarks.solver.plan import PLANS, Chosen, boxes, known, setups
from benchmarks.solver.report import descents, largest, of
from benchmarks.solver.report import write as write_page
from benchmarks.solver.strategies import SEEDS, searched

RUNS, PAGE, TABLE = ROOT / "outputs" / "solver", ROOT / "docs" / "solver.md", ROOT / "docs" / "solver.csv"
KNOWN, STRATEGIES = TABLE.with_name("solver-known.csv"), TABLE.with_name("solver-es.csv")
KEYS = ("case", "setup", "size", "radius", "rule")  # of a descent
STEEPEST = ("advised", "Lloyd 0")  # families that take steepest descent, too, with the first radius


def rules(chosen: Chosen, first: float) -> tuple[str, ...]:
    """The rules that a setup is stepped by."""
    return ("max-norm", "steepest") if chosen.family in STEEPEST and chosen.radius == first else ("max-norm",)


def carry_out(name: str, only: str | None, lattices: bool) -> None:
    """The descents of a case that are not there yet, a file each."""
    plan, case, before = PLANS[name], case_of(name), read_table(TABLE)
    for chosen in (boxes if lattices else setups)(case.settings, plan, RUNS / name / "runs"):
        if only is not None and chosen.size != only:
            continue
        for rule in rules(chosen, plan.radii[0]):
            label = f"{chosen.family}-{chosen.size}-{chosen.radius:g}-{rule}".replace(" ", "-")
            part = RUNS / name / f"{label}.csv"
            own = (name, chosen.family, chosen.size, f"{chosen.radius:.8g}", rule)
            if part.exists() or any(tuple(line[key] for key in KEYS) == own for line in before):
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


def carry_out_known(name: str) -> None:
    """What is known beforehand of the setups of a case whose runs are all there."""
    plan, path = PLANS[name], RUNS / name / "known" / "known.csv"
    if path.exists() or not (RUNS / name / "runs").is_dir():
        return
    case, lines = case_of(name), []
    for chosen in setups(case.settings, plan, RUNS / name / "runs"):
        of = {"case": name, "setup": chosen.family, "size": chosen.size, "radius": chosen.radius}
        lines.append({key: _short(value) for key, value in (of | known(chosen)).items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, lines)


def carry_out_strategies() -> None:
    """The evolution strategy on the bracket, with the recommended few centers and the best setup of 16."""
    plan, case = PLANS["elastic"], case_of("elastic")
    found = of(descents(collected("*.csv", TABLE)), case="elastic", rule="max-norm")
    best = {size: largest(of(found, size=size)) for size in ("few", "many")}
    if best["few"] is None or best["many"] is None:
        print("elastic: its descents come first")
        return
    diagonal = float(np.linalg.norm(np.ptp(case.mesh.points[case.rows], axis=0)))
    for chosen in setups(case.settings, plan, RUNS / "elastic" / "runs"):
        many = best["many"]
        recommended = chosen.family == "advised" and chosen.size == "few" and chosen.radius == plan.radii[0]
        if not recommended and (chosen.family, chosen.size, chosen.radius) != (many.setup, many.size, many.radius):
            continue
        for seed in SEEDS:
            part = RUNS / "elastic" / "strategies" / f"{chosen.size}-{seed}.csv"
            if part.exists():
                continue
            part.parent.mkdir(parents=True, exist_ok=True)
            lines = searched(case, chosen, plan.step * diagonal, seed, RUNS / "elastic" / "strategies" / "solver")
            own = {
                "case": "elastic",
                "setup": chosen.family,
                "size": chosen.size,
                "radius": chosen.radius,
                "seed": seed,
            }
            write(part, [{key: _short(value) for key, value in (own | line).items()} for line in lines])
            print(f"elastic {part.stem}: {lines[-1]['best']:.5g} after {len(lines)} evaluations", flush=True)


def case_of(name: str) -> Any:
    """A case, with its mesh and first solution."""
    return (Elastic if name == "elastic" else Flow)(name, RUNS / name)


def collected(files: str, table: Path) -> list[dict[str, Any]]:
    """The lines of all files of the cases by a pattern, and those of a table that are of none of these files."""
    found: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for path in [path for name in PLANS for path in sorted((RUNS / name).glob(files))]:
        for line in read_table(path):
            found.setdefault(_key(line), []).append(line)
    here = set(found)
    for line in read_table(table):
        if _key(line) not in here:
            found.setdefault(_key(line), []).append(line)
    order = list(PLANS)
    return [line for key in sorted(found, key=lambda key: (order.index(key[0]), key)) for line in found[key]]


def _key(line: dict[str, Any]) -> tuple[str, ...]:
    """What tells the lines of one descent, or of one setup or seed, from those of another."""
    return tuple(line.get(key, "") for key in (*KEYS, "seed"))


def main() -> int:
    """Carry out what is missing, and write tables, page and picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="*", choices=[[], *PLANS], help="only these cases")
    parser.add_argument("--size", choices=("few", "many"), help="only setups of this size")
    parser.add_argument("--ffd", action="store_true", help="only lattices of free-form deformation")
    parser.add_argument("--strategies", action="store_true", help="the evolution strategy on the bracket")
    parser.add_argument("--page", action="store_true", help="only write the tables on disk into docs/solver.md")
    options = parser.parse_args()
    if not options.page:
        RUNS.mkdir(parents=True, exist_ok=True)
        for name in options.case or PLANS:
            carry_out(name, options.size, options.ffd)
            if not options.ffd:
                carry_out_known(name)
        if options.strategies:
            carry_out_strategies()
        for path, files in ((TABLE, "*.csv"), (KNOWN, "known/*.csv"), (STRATEGIES, "strategies/*.csv")):
            if lines := collected(files, path):
                write(path, lines)
    found = descents(read_table(TABLE))
    write_page(found, read_table(KNOWN), read_table(STRATEGIES), PAGE)
    draw(found, ROOT / "docs" / "images" / "solver.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
