"""RBFs, with a polynomial or without, beside boxes of free-form deformation and uniform grids: docs/deformers.csv.

    OMP_NUM_THREADS=1 python -m benchmarks.deformers            # an hour on one core; finished runs are skipped
    python -m benchmarks.deformers --page                       # only writes the tables into docs/choosing.md

Four shapes of `benchmarks.elsewhere`, each with about 12, 25 and 50 parameters. RBFs are searched under direct
manipulation, boxes as their control points move; both by `method=gradient` with the same short budget.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from benchmarks.choosing import ROOT, read_table, write
from benchmarks.elsewhere.cases import CASES, Case
from benchmarks.elsewhere.setups import CELLS, SEARCH, grid, placed, scores
from rbfevo.__main__ import main as rbfevo
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import Setup, setup

RUNS, TABLE, PAGE = ROOT / "outputs" / "deformers", ROOT / "docs" / "deformers.csv", ROOT / "docs" / "choosing.md"
NAMES = ("car", "face", "winged", "lumpy")
COUNTS = (12, 25, 50)
RADII = (0.08, 0.15, 0.3)  # of the diagonal of the design
LATTICES = {  # columns of a box that is symmetric about y are those of one side and of the middle layer
    False: {12: (3, 2, 2), 25: (4, 3, 2), 50: (4, 4, 3)},
    True: {12: (3, 4, 2), 25: (4, 4, 3), 50: (6, 4, 4)},
}
FINE = (8, 6, 6)  # the lattice that control points are picked from
PICK = "potential:0.95"


class Deformer(NamedTuple):
    """What deforms: its name, a radius (of the diagonal) or None, and the overrides of its run, or None for a grid."""

    name: str
    radius: float | None
    overrides: tuple[str, ...] | None


def deformers(case: Case, count: int) -> Iterator[Deformer]:
    """All that are compared with about so many parameters."""
    diagonal = float(np.linalg.norm(np.ptp(case.vertices, axis=0)))
    for radius in RADII:
        words = (f"centers={count}", "manipulation=direct", f"kernel.support={radius * diagonal!r}", *SEARCH)
        yield Deformer("RBF", radius, words)
        yield Deformer("RBF, linear", radius, (*words, "representation.polynomial=linear"))
        yield Deformer("grid", radius, None)
    ffd = ("representation=ffd", "manipulation=indirect")
    lattice = LATTICES["scenario.symmetry=y" in case.overrides][count]
    yield Deformer("FFD", None, (*ffd, _lattice(lattice), *SEARCH))
    yield Deformer("FFD, picks", None, (*ffd, _lattice(FINE), f"centers={count}", "method=ols"))


def _lattice(shape: tuple[int, ...]) -> str:
    return f"representation.lattice=[{','.join(map(str, shape))}]"


def lines_of(case: Case) -> Iterator[dict[str, Any]]:
    """A line for each deformer and number of parameters."""
    common = [*case.overrides, "figures=false", "quiet=true"]
    if not case.target:
        case.save(RUNS / f"{case.name}.vtp")
        common += [f"scenario.template={RUNS / case.name}.vtp", f"scenario.smooth={CELLS * case.cell!r}"]
    for count in COUNTS:
        first: Record | None = None
        for one in deformers(case, count):
            own = {"case": case.name, "deformer": one.name, "radius": one.radius or "", "asked": count}
            if one.overrides is None:
                if first is None:
                    raise SystemExit("a grid needs a run before it")
                record, chosen = placed(first, grid(first, count))
                yield {**own, **measured(record, chosen), "hypervolume": "", "best_P": "", "seconds": ""}
                continue
            radius = "" if one.radius is None else f"-{one.radius:g}"
            out = RUNS / f"{case.name}-{one.name.replace(', ', '-')}{radius}-{count}"
            if not (out / "summary.json").exists() and rbfevo([*common, *one.overrides, f"hydra.run.dir={out}"]):
                raise SystemExit(f"{out}: the run failed")
            record = read(out)
            first = record if one.name == "RBF" else first
            found = measured(record, setup(record, pick(record, PICK)))
            summary, best = record.summary, record.improvement_potential[record.usable].max()
            of_run = {"hypervolume": summary["hypervolume"], "best_P": best, "seconds": summary["seconds"]}
            yield {**own, **found, **of_run}


def measured(record: Record, chosen: Setup) -> dict[str, Any]:
    """Columns, R, P and P_16 of a setup for the (smoothed) gradient of its run, by the definition."""
    found = scores(chosen, record, {"run": record.gradient})
    return {"columns": chosen.count, "R": found["R"], "P": found["P_run"], "P16": found["P16_run"]}


def page(lines: list[dict[str, str]]) -> None:
    """Write the tables into docs/choosing.md."""
    text = []
    for name in dict.fromkeys(line["case"] for line in lines):
        text += [f"\n**{name}**\n", "| deformer | radius | columns | R | P | P_16 | best P | hypervolume | s |"]
        text.append("|---|---|---|---|---|---|---|---|---|")
        for line in (line for line in lines if line["case"] == name):
            radius = f"{100 * float(line['radius']):g} %" if line["radius"] else ""
            numbers = [_short(line[key]) for key in ("R", "P", "P16", "best_P", "hypervolume")]
            seconds = f"{float(line['seconds']):.0f}" if line["seconds"] else ""
            text.append(f"| {line['deformer']} | {radius} | {line['columns']} | {' | '.join(numbers)} | {seconds} |")
    before, _, rest = PAGE.read_text(encoding="utf-8").partition("<!-- deformers -->\n")
    _, _, after = rest.partition("<!-- end of deformers -->")
    table = "\n".join(text)
    PAGE.write_text(f"{before}<!-- deformers -->{table}\n\n<!-- end of deformers -->{after}", encoding="utf-8")


def _short(value: str) -> str:
    return f"{float(value):.3g}" if value else ""


def in_order() -> list[dict[str, Any]]:
    """The lines of the table by shape and number of parameters."""
    return sorted(read_table(TABLE), key=lambda line: (NAMES.index(line["case"]), int(line["asked"])))


def main() -> int:
    """Measure what is missing, and write table and page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="*", choices=[[], *NAMES], help="only these shapes")
    parser.add_argument("--page", action="store_true", help="only write the tables on disk into docs/choosing.md")
    options = parser.parse_args()
    if not options.page:
        RUNS.mkdir(parents=True, exist_ok=True)
        for name in options.case or NAMES:
            found = []
            for line in lines_of(CASES[name]()):
                short = {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in line.items()}
                print(*short.values(), flush=True)
                found.append(short)
            write(TABLE, [*(line for line in in_order() if line["case"] != name), *found])
    page(in_order())
    return 0


if __name__ == "__main__":
    sys.exit(main())
