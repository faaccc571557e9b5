"""Does bounded potential predict what max-norm steps gain elsewhere? The tables and the picture of docs/elsewhere.md.

    OMP_NUM_THREADS=1 python -m benchmarks.elsewhere [case ...]     # half an hour; what was finished is skipped
    python -m benchmarks.elsewhere --page                           # only writes the page, from docs/elsewhere.csv

Without solver: objectives of a surface with exact derivatives. For some 40 setups a case, numbers known beforehand are
compared with the reduction of J by ten steps of steepest descent, natural and max-norm steps. The predictions stand in
docs/elsewhere.md; they were committed before the first descent was run.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.choosing import ROOT, write
from benchmarks.elsewhere.cases import CASES, FEW, MANY, Case
from benchmarks.elsewhere.descents import descend, least_squares
from benchmarks.elsewhere.setups import scores, setups, wanted
from benchmarks.elsewhere.tables import fill
from rbfevo.recorded.moves import RULES

RUNS, PAGE, TABLE = ROOT / "outputs" / "elsewhere", ROOT / "docs" / "elsewhere.md", ROOT / "docs" / "elsewhere.csv"
PICTURE = ROOT / "docs" / "images" / "elsewhere.png"


def lines(case: Case, count: int, radius: float, runs: Path) -> list[dict[str, Any]]:
    """A line for each setup of a number of centers and a radius, and each reach."""
    found, fields = [], {}
    for family, record, chosen in setups(case, count, radius, runs):
        if not fields:
            fields = {name: wanted(case, record, name == "smooth") for name in ("raw", "smooth")}
        known: dict[str, Any] = {"setup": family, "centers": count, "radius": radius}
        known |= scores(chosen, record, fields)
        known["least_squares"] = least_squares(case, record, chosen) if case.target else ""
        for name, reach in case.reaches.items():
            entry = {"case": case.name, "reach": name, **known}
            for rule in RULES:
                entry |= {f"{rule}_{key}": value for key, value in descend(case, record, chosen, rule, reach).items()}
            found.append({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in entry.items()})
    return found


def carry_out(name: str) -> list[dict[str, Any]]:
    """The lines of a case, a file of its own for each number of centers and radius."""
    case, found = CASES[name](), []
    for count in (FEW, MANY):
        for radius in case.radii:
            part = RUNS / f"{name}-{count}-{radius:g}.csv"
            if not part.exists():
                begin = time.perf_counter()
                if not case.target:
                    case.save(RUNS / f"{name}.vtp")
                write(part, lines(case, count, radius, RUNS))
                print(f"{part.stem}: {time.perf_counter() - begin:.0f} s", flush=True)
            found += read(part)
    return found


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of a CSV file."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def main() -> int:
    """Carry out the missing descents, and write the page once all cases are there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="*", choices=[[], *CASES], help="only these cases, no page")
    parser.add_argument("--page", action="store_true", help="only write the page")
    options = parser.parse_args()
    if not options.page:
        RUNS.mkdir(parents=True, exist_ok=True)
        found = [line for name in options.case or CASES for line in carry_out(name)]
        if options.case:
            return 0
        write(TABLE, found)
    from benchmarks.elsewhere.picture import draw

    entries = read(TABLE)
    PAGE.write_text(fill(PAGE.read_text(encoding="utf-8"), entries), encoding="utf-8")
    draw(entries, PICTURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
