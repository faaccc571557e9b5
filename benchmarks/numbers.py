"""The tables of docs/reliability-numbers.md: the errors of R and P against 90 digits, and the effect of model units.

    python -m benchmarks.numbers            # ten minutes on one core
    python -m benchmarks.numbers --page     # only writes the tables into docs/reliability-numbers.md

Two or three centers of every setup are moved together until Phi has a prescribed condition number. The setup is then
scored by the evaluator, by the definition, and at 90 digits (`benchmarks.digits`).
benchmarks/numbers.csv holds all scores, benchmarks/numbers-units.csv those of one setup in 13 model units.
"""

from __future__ import annotations

import argparse
import csv
import functools
import math
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.choosing import markdown, write
from benchmarks.digits import Design, exact
from rbfevo.scoring.deformation import MANIPULATIONS
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reliability-numbers.md"
TABLE, UNITS = (ROOT / "benchmarks" / name for name in ("numbers.csv", "numbers-units.csv"))
EPS = 2.0**-52
KERNELS: dict[str, Kernel] = {"Wendland": Wendland(0.5), "r^2 log r": ThinPlate(), "r^3": Cubic()}
COUNTS = (1, 2, 5, 25, 50, 100, 200)
CASES = {"spread": 0, "pair": 1, "three": 2, "duplicate": 1}  # how many centers are moved to the first one
VERTICES = 400


def points(d: int, count: int, shift: float) -> NDArray[Any]:
    """Evenly spread points [count, d] of [0, 1] x [0, 2] or of the unit sphere."""
    i = np.arange(count) + 0.5
    if d == 2:
        plastic = 1.32471795724474602596
        return np.stack([(shift + i / plastic) % 1.0, 2.0 * ((shift + i / plastic**2) % 1.0)], axis=1)
    z, angle = 1.0 - 2.0 * i / count, math.pi * (3.0 - math.sqrt(5.0)) * i + shift
    return np.stack([np.sqrt(1.0 - z * z) * np.cos(angle), np.sqrt(1.0 - z * z) * np.sin(angle), z], axis=1)


@functools.cache
def design(d: int, count: int = VERTICES) -> Design:
    """The plane with a height field (d = 2) or the sphere with displacements (d = 3)."""
    X = points(d, count, 0.0)
    if d == 2:
        side = math.isqrt(count)
        X = np.stack(np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 2, count // side)), axis=-1).reshape(-1, 2)
    g = np.stack([np.sin((2 + q) * X[:, q % d] + 3 * X[:, (q + 1) % d] + q) for q in range(1 if d == 2 else 3)], axis=1)
    return Design(torch.from_numpy(X), torch.from_numpy(g / np.linalg.norm(g)))


def dimension(kernel: Kernel) -> int:
    """The dimension d of the design on which the kernel is measured."""
    return 3 if isinstance(kernel, Cubic) else 2


def setup(kernel: Kernel, m: int, case: str, h: float = 0.0) -> Tensor | None:
    """Centers [m, d], the last ones at distance h from the first on either side; None if m is too small."""
    d, moved = dimension(kernel), CASES[case]
    if m <= moved:
        return None
    C = points(d, m, 0.4)
    step = np.zeros(d)
    step[0] = h
    for j in range(moved):
        C[m - 1 - j] = C[0] + (1 - 2 * j) * step
    return torch.from_numpy(C)


def conditioned(kernel: Kernel, m: int, case: str, wanted: float) -> Tensor | None:
    """The setup whose Phi has the wanted condition number, by bisection over h; None if no h gives it."""
    deformation = Evaluator(*design(dimension(kernel)), kernel).deformation
    low, high = math.log(1e-16), math.log(0.2)
    C, found = None, math.nan
    for _ in range(25):
        middle = 0.5 * (low + high)
        C = setup(kernel, m, case, math.exp(middle))
        if C is None:
            return None
        sigma = torch.linalg.svdvals(deformation.phi(C))
        found = float(sigma[0] / sigma[-1].clamp(min=1e-300))
        low, high = (middle, high) if found > wanted else (low, middle)
    return C if 0.5 < found / wanted < 2.0 else None


# ------------------------------------------------------------------ measurements


def setups(counts: Iterable[int] = COUNTS) -> Iterator[tuple[str, int, str, str, Tensor]]:
    """Kernel, m, case, wanted condition number and centers [m, d] of every cell; fewer decades from m = 100 on."""
    for m in counts:
        for name, kernel in KERNELS.items():
            for case in CASES:
                exponents = range(1, 15) if m < 100 else range(2, 15, m // 50)
                for exponent in exponents if case in ("pair", "three") else (0,):
                    if exponent:
                        C, wanted = conditioned(kernel, m, case, 10.0**exponent), f"1e{exponent}"
                    else:
                        C, wanted = setup(kernel, m, case), ""
                    if C is not None:
                        yield name, m, case, wanted, C


def measured(name: str, m: int, case: str, wanted: str, C: Tensor) -> Iterator[dict[str, Any]]:
    """Two lines of numbers.csv: one setup with each manipulation."""
    kernel = KERNELS[name]
    some = design(dimension(kernel))
    truth = exact(kernel, C, some)
    for manipulation in MANIPULATIONS:
        evaluator = Evaluator(*some, kernel, manipulation)
        fast, definition = evaluator(C), evaluator.definition(C)
        yield {
            "kernel": name, "manipulation": manipulation, "m": m, "case": case, "wanted": wanted,
            "cond_Phi": truth.of_phi, "cond_Psi": truth.of_psi,
            "R": getattr(truth, manipulation), "P": truth.potential,
            "R_fast": fast.regularity.item(), "P_fast": fast.improvement_potential.item(),
            "R_definition": definition.regularity.item(), "P_definition": definition.improvement_potential.item(),
        }  # fmt: skip


def in_units(exponents: Iterable[int] = range(-6, 7), m: int = 25) -> Iterator[dict[str, Any]]:
    """Lines of numbers-units.csv: an evenly spread setup, everything multiplied by 10^exponent."""
    for name, kernel in KERNELS.items():
        some, C = design(dimension(kernel)), torch.from_numpy(points(dimension(kernel), m, 0.4))
        for manipulation in MANIPULATIONS:
            for exponent in exponents:
                unit = 10.0**exponent
                scaled = Wendland(0.5 * unit) if isinstance(kernel, Wendland) else kernel
                evaluator = Evaluator(some.vertices * unit, some.gradient, scaled, manipulation)
                fast, definition = evaluator(C * unit), evaluator.definition(C * unit)
                yield {
                    "kernel": name, "manipulation": manipulation, "exponent": exponent,
                    "R_fast": fast.regularity.item(), "P_fast": fast.improvement_potential.item(),
                    "R_definition": definition.regularity.item(),
                    "P_definition": definition.improvement_potential.item(),
                }  # fmt: skip


# ------------------------------------------------------------------ tables

Line = dict[str, str]
PATHS = ("fast", "definition")


def error(line: Line, path: str) -> tuple[float, float]:
    """|dR| / R and |dP| of a line of numbers.csv; the first is NaN where R is exactly 0 or cut off to 0."""
    R, P, found, potential = (float(line[key]) for key in ("R", "P", f"R_{path}", f"P_{path}"))
    return (abs(found - R) / R if R > 0.0 and found > 0.0 else math.nan), abs(potential - P)


def within(line: Line, path: str) -> bool:
    """Whether R is within 1e-6 R + 1e-12 and P within 1e-8 of the scores at 90 digits."""
    R, found = float(line["R"]), float(line[f"R_{path}"])
    return abs(found - R) <= 1e-6 * R + 1e-12 and error(line, path)[1] <= 1e-8


def cut(line: Line, path: str) -> bool:
    """Whether a cutoff sets a nonzero R to 0."""
    return float(line[f"R_{path}"]) == 0.0 < float(line["R"])


def largest(values: Iterable[float]) -> str:
    """The largest of the values that are not NaN, with one digit; empty if there are none."""
    known = [value for value in values if not math.isnan(value)]
    return f"{max(known):.0e}".replace("0e+00", "0").replace("e-0", "e-").replace("e+0", "e") if known else ""


def condition(line: Line) -> float:
    """The condition number that the error of R grows with: that of Phi or, for direct, of Psi if it is larger."""
    of_phi, of_psi = float(line["cond_Phi"]), float(line["cond_Psi"])
    return of_phi if line["manipulation"] == "indirect" else max(of_phi, of_psi)


def by_decade(lines: list[Line]) -> str:
    """The errors of lines of one manipulation by the nearest decade of the condition number, up to 1e16."""
    groups: dict[int, list[Line]] = {}
    for line in lines:
        if math.isfinite(condition(line)):
            groups.setdefault(min(round(math.log10(condition(line))), 16), []).append(line)
    table = []
    for decade, group in sorted(groups.items()):
        row = [f"1e{decade}{' and more' if decade == 16 else ''}", str(len(group))]
        for part in (0, 1):
            row += [largest(error(line, path)[part] for line in group) for path in PATHS]
        for count in (cut, within):
            row += [str(sum(count(line, path) for line in group)) for path in PATHS]
        table.append(row)
    both = [f"{what}, {path}" for what in ("dR/R", "dP", "R cut to 0", "within") for path in PATHS]
    return markdown(("condition", "setups", *both), table)


def growth(lines: list[Line], key: str) -> str:
    """Errors over eps times the condition number that they grow with, grouped by a field; without cut R."""
    table = []
    for value in dict.fromkeys(line[key] for line in lines):
        row = [value]
        for manipulation, part in (("indirect", 0), ("direct", 0), ("indirect", 1)):
            group = [line for line in lines if (line[key], line["manipulation"]) == (value, manipulation)]
            group = [line for line in group if math.isfinite(condition(line)) and not cut(line, "definition")]
            row += [largest(error(line, path)[part] / (EPS * condition(line)) for line in group) for path in PATHS]
        table.append(row)
    heads = ("dR/R, indirect", "dR/R, direct", "dP")
    return markdown((key, *(f"{head}, {path}" for head in heads for path in PATHS)), table)


def ends(lines: list[Line]) -> str:
    """The smallest condition numbers at which scores are not `within` and at which R is `cut`, by kernel."""
    table = []
    for kernel, manipulation in dict.fromkeys((line["kernel"], line["manipulation"]) for line in lines):
        group = [line for line in lines if (line["kernel"], line["manipulation"]) == (kernel, manipulation)]
        group = [line for line in group if math.isfinite(condition(line))]
        row = [kernel, manipulation]
        for found in (lambda line, path: not within(line, path) and not cut(line, path), cut):
            row += [f"{min(condition(line) for line in group if found(line, path)):.1e}" for path in PATHS]
        table.append(row)
    heads = (f"{what}, {path}" for what in ("not within from", "R cut to 0 from") for path in PATHS)
    return markdown(("kernel", "manipulation", *heads), table)


def duplicates(lines: list[Line]) -> str:
    """Setups with a duplicate center: the largest R, and the largest error of P."""
    table = []
    for name in KERNELS:
        group = [line for line in lines if (line["kernel"], line["case"]) == (name, "duplicate")]
        table.append([name, str(len(group))])
        table[-1] += [largest(float(line[f"R_{path}"]) for line in group) for path in PATHS]
        table[-1] += [largest(error(line, path)[1] for line in group) for path in PATHS]
    return markdown(("kernel", "setups", *(f"{what}, {path}" for what in ("R", "dP") for path in PATHS)), table)


def changes(lines: list[Line]) -> str:
    """The largest relative change of R and P over all units, compared with unit 1."""
    table = []
    for kernel, manipulation in dict.fromkeys((line["kernel"], line["manipulation"]) for line in lines):
        group = [line for line in lines if (line["kernel"], line["manipulation"]) == (kernel, manipulation)]
        (one,) = [line for line in group if int(line["exponent"]) == 0]
        row = [kernel, manipulation]
        for score in ("R", "P"):
            for path in PATHS:
                at_one = float(one[f"{score}_{path}"])
                row.append(largest(abs(float(line[f"{score}_{path}"]) / at_one - 1.0) for line in group))
        table.append(row)
    return markdown(("kernel", "manipulation", *(f"d{s}/{s}, {path}" for s in "RP" for path in PATHS)), table)


def thin_plates(lines: list[Line]) -> str:
    """R and P of r^2 log r in every unit, by definition."""
    table = []
    for exponent in dict.fromkeys(line["exponent"] for line in lines):
        row = [f"1e{exponent}"]
        for manipulation in MANIPULATIONS:
            (line,) = [
                entry
                for entry in lines
                if (entry["kernel"], entry["manipulation"], entry["exponent"]) == ("r^2 log r", manipulation, exponent)
            ]
            row += [f"{float(line[f'{score}_definition']):.3g}" for score in "RP"]
        table.append(row)
    heads = [f"{score} {manipulation}" for manipulation in MANIPULATIONS for score in "RP"]
    return markdown(("unit", *heads), table)


def page(lines: list[Line], units: list[Line]) -> None:
    """Write the tables into docs/reliability-numbers.md, each between its two markers."""
    text = PAGE.read_text(encoding="utf-8")
    indirect, direct = ([line for line in lines if line["manipulation"] == name] for name in MANIPULATIONS)
    tables = {
        "indirect": by_decade(indirect),
        "direct": by_decade(direct),
        "ends": ends(lines),
        "kernels": growth(lines, "kernel"),
        "counts": growth(lines, "m"),
        "duplicates": duplicates(lines),
        "units": changes(units),
        "thin plates": thin_plates(units),
    }
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, _, following = text.partition(begin)
        _, _, after = following.partition(end)
        text = f"{before}{begin}\n{table}\n{end}{after}"
    PAGE.write_text(text, encoding="utf-8")


def main() -> int:
    """Measure unless --page is given, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help="only write the tables into the page")
    if not parser.parse_args().page:
        begin, lines = time.perf_counter(), []
        for cell in setups():
            lines += measured(*cell)
            print(f"{time.perf_counter() - begin:4.0f} s: {' '.join(map(str, cell[:-1]))}", flush=True)
        write(TABLE, lines)
        write(UNITS, list(in_units()))
    with TABLE.open(encoding="utf-8") as file, UNITS.open(encoding="utf-8") as other:
        page(list(csv.DictReader(file)), list(csv.DictReader(other)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
