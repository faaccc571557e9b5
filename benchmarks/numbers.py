"""The tables of docs/reliability-numbers.md: the error of R and P against many digits, and what units change.

    python -m benchmarks.numbers            # ten minutes on one core
    python -m benchmarks.numbers --page     # writes the tables into docs/reliability-numbers.md again

Every setup is brought to a wanted condition number of Phi by moving two or three of its centers together, then scored
by the evaluator, by the definition, and at 90 digits, in Python's integers (tests/test_numbers.py holds them against
mpmath's singular values).
benchmarks/numbers.csv holds all scores, benchmarks/numbers-units.csv those of one setup in 13 model units.
"""

from __future__ import annotations

import argparse
import csv
import functools
import math
import operator
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mpmath
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.choosing import markdown, write
from rbfevo.deformation import MANIPULATIONS
from rbfevo.evaluator import Evaluator
from rbfevo.kernels import Cubic, Kernel, ThinPlate, Wendland

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reliability-numbers.md"
TABLE, UNITS = (ROOT / "benchmarks" / name for name in ("numbers.csv", "numbers-units.csv"))
EPS = 2.0**-52
BITS = 300  # behind the point
KERNELS: dict[str, Kernel] = {"Wendland": Wendland(0.5), "r^2 log r": ThinPlate(), "r^3": Cubic()}
COUNTS = (1, 2, 5, 25, 50, 100, 200)
CASES = {"spread": 0, "pair": 1, "three": 2, "duplicate": 1}  # how many centers are moved to the first one
VERTICES = 400
Integers = NDArray[Any]  # of Python's, in units of 2^-BITS
Point = tuple[int, ...]  # in units of 2^-BITS


class Design(NamedTuple):
    """Vertices [n, d] of the plane or the sphere and a smooth gradient [n, k] of unit norm."""

    vertices: Tensor
    gradient: Tensor


def points(d: int, count: int, shift: float) -> NDArray[np.float64]:
    """Evenly spread points [count, d]: of [0, 1] x [0, 2], or of the unit sphere."""
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
    """d of the design that the kernel is measured on."""
    return 3 if isinstance(kernel, Cubic) else 2


def setup(kernel: Kernel, m: int, case: str, h: float = 0.0) -> Tensor | None:
    """Centers [m, d], the last ones a distance h from the first on either side; None if there are not enough."""
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
    """The setup whose Phi has the wanted condition number, by bisection over h; None if there is none."""
    deformation = Evaluator(*design(dimension(kernel)), kernel).deformation
    low, high = math.log(1e-16), math.log(0.2)
    C, condition = None, math.nan
    for _ in range(25):
        middle = 0.5 * (low + high)
        C = setup(kernel, m, case, math.exp(middle))
        if C is None:
            return None
        sigma = torch.linalg.svdvals(deformation.phi(C))
        condition = float(sigma[0] / sigma[-1].clamp(min=1e-300))
        low, high = (middle, high) if condition > wanted else (low, middle)
    return C if 0.5 < condition / wanted < 2.0 else None


# ------------------------------------------------------------------ many digits


def integer(x: float) -> int:
    """A float64 number in units of 2^-BITS: exactly, if it is 0 or not below 2^-248."""
    numerator, denominator = x.as_integer_ratio()
    return (numerator << BITS) // denominator


def phi(kernel: Kernel, a: Point, b: Point) -> int:
    """phi(|a - b|) of two points in units of 2^-BITS."""
    square = sum((s - t) ** 2 for s, t in zip(a, b, strict=True))  # in units of 2^(-2 BITS)
    if isinstance(kernel, ThinPlate):
        if square == 0:
            return 0
        with mpmath.workprec(BITS + 40):
            logarithm = mpmath.log(mpmath.ldexp(square, -2 * BITS))
            return (square * int(mpmath.ldexp(logarithm, BITS))) >> (2 * BITS + 1)
    r = math.isqrt(square)
    if isinstance(kernel, Wendland):
        q = (r << BITS) // integer(kernel.support)
        one = 1 << BITS
        return ((one - q) ** 4 * (4 * q + one)) >> (4 * BITS) if q < one else 0
    return (square * r) >> (2 * BITS)


@functools.cache
def column(kernel: Kernel, center: Point, some: Design) -> list[int]:
    """A column of Phi [n]; setups share most of theirs."""
    return [phi(kernel, x, center) for x in integers(some.vertices)]


@functools.cache
def product(kernel: Kernel, a: Point, b: Point, some: Design) -> int:
    """The inner product of two columns."""
    return sum(map(operator.mul, column(kernel, a, some), column(kernel, b, some))) >> BITS


def integers(some: Tensor) -> list[Point]:
    """Rows of a matrix in units of 2^-BITS."""
    return [tuple(map(integer, row)) for row in some.tolist()]


def cholesky(G: Integers) -> Integers:
    """L with G = L L^T."""
    L = np.zeros_like(G)
    for j in range(len(G)):
        rest = (G[j:, j] << BITS) - L[j:, :j] @ L[j, :j] if j else G[:, 0] << BITS
        L[j:, j] = rest // math.isqrt(rest[0])
    return L


def forward(L: Integers, B: Integers) -> Integers:
    """L^-1 B by forward substitution."""
    X = B.copy()
    for i in range(len(L)):
        X[i] = ((B[i] << BITS) - (L[i, :i] @ X[:i] if i else 0)) // L[i, i]
    return X


def solve(A: Integers, B: Integers) -> Integers | None:
    """A^-1 B by Gaussian elimination with row pivoting; None if A is singular."""
    M, m = np.concatenate([A, B], axis=1), len(A)
    for j in range(m):
        pivot = j + max(range(m - j), key=lambda i: abs(M[j + i, j]))
        if M[pivot, j] == 0:
            return None
        M[[j, pivot]] = M[[pivot, j]]
        M[j, j + 1 :] = (M[j, j + 1 :] << BITS) // M[j, j]
        M[j + 1 :, j + 1 :] -= (M[j + 1 :, j, None] * M[j, None, j + 1 :]) >> BITS
    for j in range(m - 1, 0, -1):
        M[:j, m:] -= (M[:j, j, None] * M[j, None, m:]) >> BITS
    return M[:, m:]


def norm(A: Integers) -> Any:
    """The largest singular value: the Rayleigh quotient at float64's singular vector, whose error it squares."""
    size = max(int(abs(A).max()).bit_length() - 900, 0)
    v = np.linalg.svd((A >> size).astype(np.float64))[2][0]
    w = np.array([integer(x) for x in v.tolist()], dtype=object)
    return mpmath.sqrt(mpmath.mpf(int(((A @ w) ** 2).sum())) / int((w * w).sum())) / mpmath.ldexp(1, BITS)


class Exact(NamedTuple):
    """Condition numbers of Phi and Psi (infinite where singular), R for each manipulation, and P."""

    of_phi: float
    of_psi: float
    indirect: float
    direct: float
    potential: float


def exact(kernel: Kernel, centers: Tensor, some: Design) -> Exact:
    """Scores of a setup [m, d] at 90 digits; centers that coincide count once for P."""
    C = list(dict.fromkeys(integers(centers)))
    G, Psi = (
        np.array([[entry(*sorted((a, b))) for a in C] for b in C], dtype=object)
        for entry in (lambda a, b: product(kernel, a, b, some), lambda a, b: phi(kernel, a, b))
    )
    columns = np.array([column(kernel, c, some) for c in C], dtype=object)
    g = np.array(integers(some.gradient), dtype=object)
    with mpmath.workprec(BITS):
        L = cholesky(G)
        size = mpmath.ldexp(1, 2 * BITS)
        potential = float(mpmath.mpf(int((forward(L, (columns @ g) >> BITS) ** 2).sum())) / size)
        one = np.diag([1 << BITS] * len(C)).astype(object)
        if len(C) < len(centers):
            return Exact(math.inf, math.inf, 0.0, 0.0, potential)
        of_phi = norm(L) * norm(forward(L, one))
        inverse = solve(Psi, np.concatenate([one, L], axis=1))
        if inverse is None:
            return Exact(float(of_phi), math.inf, float(1 / of_phi), 0.0, potential)
        of_psi = norm(Psi) * norm(inverse[:, : len(C)])
        of_u = norm(inverse[:, len(C) :]) * norm(forward(L, Psi))
        return Exact(float(of_phi), float(of_psi), float(1 / of_phi), float(1 / of_u), potential)


# ------------------------------------------------------------------ measurements


def setups(counts: Iterable[int] = COUNTS) -> Iterator[tuple[str, int, str, str, Tensor]]:
    """Kernel, m, case, wanted condition number and centers [m, d] of every cell; from m = 100 on not every decade."""
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
    """|dR| / R and |dP| of a line of numbers.csv; the first is NaN where R is 0, by the cutoffs or truly."""
    R, P, found, potential = (float(line[key]) for key in ("R", "P", f"R_{path}", f"P_{path}"))
    return (abs(found - R) / R if R > 0.0 and found > 0.0 else math.nan), abs(potential - P)


def within(line: Line, path: str) -> bool:
    """Whether R is within 1e-6 R + 1e-12 and P within 1e-8 of many digits."""
    R, found = float(line["R"]), float(line[f"R_{path}"])
    return abs(found - R) <= 1e-6 * R + 1e-12 and error(line, path)[1] <= 1e-8


def cut(line: Line, path: str) -> bool:
    """Whether a cutoff sets R to 0 although it is not."""
    return float(line[f"R_{path}"]) == 0.0 < float(line["R"])


def largest(values: Iterable[float]) -> str:
    """The largest of what is there, shortly."""
    known = [value for value in values if not math.isnan(value)]
    return f"{max(known):.0e}".replace("e-0", "e-").replace("e+0", "e") if known else ""


def by_decade(lines: list[Line], key: str) -> str:
    """The errors of lines of one manipulation by the nearest decade of a condition number, up to 1e16."""
    groups: dict[int, list[Line]] = {}
    for line in lines:
        if math.isfinite(float(line[key])):
            groups.setdefault(min(round(math.log10(float(line[key]))), 16), []).append(line)
    table = []
    for decade, group in sorted(groups.items()):
        row = [f"1e{decade}{' and more' if decade == 16 else ''}", str(len(group))]
        for part in (0, 1):
            row += [largest(error(line, path)[part] for line in group) for path in PATHS]
        for count in (cut, within):
            row += [str(sum(count(line, path) for line in group)) for path in PATHS]
        table.append(row)
    of = {"cond_Phi": "cond(Phi)", "cond_Psi": "cond(Psi)"}[key]
    both = [f"{what}, {path}" for what in ("dR/R", "dP", "R cut to 0", "within") for path in PATHS]
    return markdown((of, "setups", *both), table)


def growth(lines: list[Line], key: str) -> str:
    """By a field: the errors over eps times the condition number that they grow with, while R is not cut."""
    table = []
    for value in dict.fromkeys(line[key] for line in lines):
        row = [value]
        for manipulation, of, part in (
            ("indirect", "cond_Phi", 0),
            ("direct", "cond_Psi", 0),
            ("indirect", "cond_Phi", 1),
        ):
            group = [line for line in lines if (line[key], line["manipulation"]) == (value, manipulation)]
            group = [line for line in group if math.isfinite(float(line[of])) and not cut(line, "definition")]
            row += [largest(error(line, path)[part] / (EPS * float(line[of])) for line in group) for path in PATHS]
        table.append(row)
    heads = ("dR/R indirect over eps cond(Phi)", "dR/R direct over eps cond(Psi)", "dP over eps cond(Phi)")
    return markdown((key, *(f"{head}, {path}" for head in heads for path in PATHS)), table)


def duplicates(lines: list[Line]) -> str:
    """Setups with a center twice: the largest R, and the largest error of P."""
    table = []
    for name in KERNELS:
        group = [line for line in lines if (line["kernel"], line["case"]) == (name, "duplicate")]
        table.append([name, str(len(group))])
        table[-1] += [largest(float(line[f"R_{path}"]) for line in group) for path in PATHS]
        table[-1] += [largest(error(line, path)[1] for line in group) for path in PATHS]
    return markdown(("kernel", "setups", *(f"{what}, {path}" for what in ("R", "dP") for path in PATHS)), table)


def changes(lines: list[Line]) -> str:
    """The largest change of R and P over all units, beside those of the unit 1."""
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
    """R and P of r^2 log r in every unit, by the definition."""
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
    """Write the tables into docs/reliability-numbers.md, each between its marks."""
    text = PAGE.read_text(encoding="utf-8")
    indirect, direct = ([line for line in lines if line["manipulation"] == name] for name in MANIPULATIONS)
    tables = {
        "indirect": by_decade(indirect, "cond_Phi"),
        "direct": by_decade(direct, "cond_Psi"),
        "kernels": growth(lines, "kernel"),
        "counts": growth(lines, "m"),
        "duplicates": duplicates(lines),
        "units": changes(units),
        "thin plates": thin_plates(units),
    }
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, _, rest = text.partition(begin)
        _, _, after = rest.partition(end)
        text = f"{before}{begin}\n{table}\n{end}{after}"
    PAGE.write_text(text, encoding="utf-8")


def main() -> int:
    """Measure and write the tables, or only write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help="only write the tables again")
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
