"""The tables of docs/choosing.md: kernels, radii, manipulations, numbers of centers and methods on one car body.

    python -m benchmarks.choosing            # half an hour on two cores; finished runs are skipped
    python -m benchmarks.choosing --page     # only writes the tables into docs/choosing.md

Every run is a `python -m rbfevo` command on the body of docs/car/body.py with its drag sensitivity; docs/choosing.csv
holds the results. `descend` carries out an optimization with setups of these runs: steepest descent on the objective
whose sensitivity they were searched with.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import json
import statistics
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rbfevo.__main__ import main as rbfevo
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read

ROOT = Path(__file__).parents[1]
PAGE, TABLE = ROOT / "docs" / "choosing.md", ROOT / "docs" / "choosing.csv"
RUNS = ROOT / "outputs" / "choosing"
SEEDS = (0, 1)
COMMON = (
    "scenario=mesh", "scenario.sensitivity=drag_sensitivity", "scenario.fixed=wheels", "scenario.symmetry=y",
    "scenario.search_vertices=4000", "figures=false", "quiet=true",
)  # fmt: skip
KERNELS = ("wendland 8%", "wendland 15%", "wendland 30%", "wendland 60%", "triharmonic")
CENTERS = (5, 10, 25, 50)
METHODS = {
    "random": "",
    "lloyd": "",
    "ols": "",
    "cmaes": "preference=[0,0.5,1]",
    "nsga2": "",
    "gradient": "",
}
FIELDS = ("table", "case", "manipulation", "seed", "seconds", "hypervolume", "best_R", "best_P", "R_at_half")


class Case(NamedTuple):
    """One run: its table, its name in that table, its manipulation, and its further Hydra overrides."""

    table: str
    name: str
    manipulation: str
    overrides: tuple[str, ...]


def cases() -> Iterator[Case]:
    """All cases; each is run with every seed of SEEDS."""
    for name in KERNELS:
        kernel, _, radius = name.partition(" ")
        overrides = (f"kernel={kernel}", *([f"kernel.support={radius}"] if radius else []))
        for manipulation in ("indirect", "direct"):
            yield Case("kernels", name, manipulation, (*overrides, "method=gradient"))
    for count in CENTERS:
        yield Case("centers", str(count), "direct", ("kernel.support=15%", f"centers={count}", "method=gradient"))
    for method, more in METHODS.items():
        overrides = ("kernel.support=15%", f"method={method}", *([more] if more else []))
        yield Case("methods", method, "direct", overrides)


def body() -> ModuleType:
    """docs/car/body.py as a module."""
    spec = importlib.util.spec_from_file_location("car_body", ROOT / "docs" / "car" / "body.py")
    if spec is None or spec.loader is None:
        raise SystemExit("docs/car/body.py is missing")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def carry_out(case: Case, seed: int, template: Path) -> Path:
    """Carry out the run unless its directory holds it already; return the directory."""
    name = f"{case.table}-{case.name.replace(' ', '-').rstrip('%')}"
    if name == "centers-25":  # the same run
        name = "kernels-wendland-15"
    out = RUNS / f"{name}-{case.manipulation}-{seed}"
    if not (out / "summary.json").exists():
        overrides = [*COMMON, f"scenario.template={template}", f"manipulation={case.manipulation}", f"seed={seed}"]
        if rbfevo([*overrides, *case.overrides, f"hydra.run.dir={out}"]):
            raise SystemExit(f"{out}: the run failed")
    return out


def line(case: Case, seed: int, out: Path) -> dict[str, Any]:
    """One line of choosing.csv: the scores of the run's setups by its own method."""
    import torch

    from rbfevo.scoring.pareto import hypervolume

    record, summary = read(out), json.loads((out / "summary.json").read_text())
    own = record.method == summary["method"]
    R, P = record.regularity[own], record.improvement_potential[own]
    half = R[P >= P_WANTED]
    return {
        "table": case.table,
        "case": case.name,
        "manipulation": case.manipulation,
        "seed": seed,
        "seconds": round(summary["seconds"], 2),
        "hypervolume": hypervolume(torch.from_numpy(np.stack([R, P], axis=1))),
        "best_R": float(R.max()),
        "best_P": float(P.max()),
        "R_at_half": float(half.max()) if half.size else 0.0,
    }


P_WANTED = 0.5


def descents(template: Path, run: Path, name: str) -> Iterator[dict[str, Any]]:
    """The drop of the drag by steepest descent with three setups of a run."""
    record = read(run)
    for choice in ("best-regularity", "knee", "best-improvement-potential"):
        row = pick(record, choice)
        yield {"run": name, "pick": choice, "R": float(record.regularity[row]),
               "P": float(record.improvement_potential[row]), **descend(template, record, row)}  # fmt: skip


def descend(template: Path, record: Record, row: int, steps: int = 30) -> dict[str, float]:
    """The drop of the objective, in percent, after 10 and `steps` steps of steepest descent, and by L-BFGS.

    The objective is J plus MU/2 times the mean squared displacement of the vertices: without that term, sharper and
    sharper spikes would keep lowering an impact drag. The line search starts from twice the last step and halves it
    until the Armijo condition holds.
    """
    import pyvista as pv
    import torch
    from scipy.optimize import minimize

    from rbfevo.recorded.setup import setup

    car, chosen = body(), setup(record, row)
    surface: Any = pv.read(template)
    vertices, triangles = car.of_surface(surface)
    X = vertices.numpy()
    free = torch.from_numpy((np.asarray(surface["wheels"]) == 0).astype(np.float64))[:, None]
    parts = []
    for components, across, columns in chosen.parities(3):
        U = chosen.columns(X, across)[:, columns]
        if chosen.manipulation == "direct":
            U = np.linalg.solve(chosen.psi(across).T, U.T).T
        parts.append((components, torch.from_numpy(U)))
    sizes = [len(components) * U.shape[1] for components, U in parts]

    def displacements(p: torch.Tensor) -> torch.Tensor:
        """The displacements [n, d] of the vertices by design parameters p."""
        u = torch.zeros_like(vertices)
        for (components, U), piece in zip(parts, p.split(sizes), strict=True):
            u[:, components] = U @ piece.view(U.shape[1], len(components))
        return u

    def objective(p: torch.Tensor) -> torch.Tensor:
        """J and the penalty, as a scalar tensor."""
        u = displacements(p)
        # The displacement of fixed vertices is penalized with a hundred times the weight of the others.
        return car.drag(vertices + u, triangles) + MU / 2 * ((1.0 + 99.0 * (1.0 - free)) * u**2).sum() / len(X)

    def value_and_gradient(flat: np.ndarray) -> tuple[float, np.ndarray]:
        """The objective and its gradient by the design parameters, as SciPy expects them."""
        p = torch.from_numpy(np.array(flat)).requires_grad_()
        f = objective(p)
        (gradient,) = torch.autograd.grad(f, p)
        return f.item(), gradient.numpy()

    p = np.zeros(sum(sizes))
    start, gradient = value_and_gradient(p)
    f, step, drops = start, 1.0, []
    for _ in range(steps):
        step *= 2.0
        while True:
            ahead, new = value_and_gradient(p - step * gradient)
            if ahead <= f - 1e-4 * step * float(gradient @ gradient) or step < 1e-12:
                break
            step /= 2.0
        if ahead < f:
            p, f, gradient = p - step * gradient, ahead, new
        drops.append(100.0 * (1.0 - f / start))
    options = {"maxfun": EVALUATIONS}
    best = minimize(value_and_gradient, np.zeros_like(p), jac=True, method="L-BFGS-B", options=options)
    return {"after_10": drops[9], "after_30": drops[-1], "optimum": 100.0 * (1.0 - best.fun / start)}


EVALUATIONS = 400  # of L-BFGS
MU = 1000.0  # per square metre: gives root mean square displacements of one or two centimetres


def markdown(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    head = list(header)
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def page(lines: list[dict[str, Any]], fallen: list[dict[str, Any]]) -> None:
    """Write the tables into docs/choosing.md, each between its two markers."""
    text = PAGE.read_text(encoding="utf-8")
    scores = ("hypervolume", "best R", f"best R with P >= {P_WANTED}", "best P")
    tables = {}
    for name, columns in (("kernels", ("kernel", "manipulation")), ("centers", ("centers",)), ("methods", ("method",))):
        groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
        for entry in lines:
            if entry["table"] == name:
                groups.setdefault((entry["case"], entry["manipulation"])[: len(columns)], []).append(entry)
        more = ("seconds",) if name == "methods" else ()
        shown = (*FIELDS_SHOWN, *more)
        rows = [[*key, *(_median(group, field) for field in shown)] for key, group in groups.items()]
        tables[name] = markdown((*columns, *scores, *more), rows)
    rows = [[entry["run"], entry["pick"], *(f"{float(entry[key]):.3g}" for key in FALLEN)] for entry in fallen]
    tables["descent"] = markdown(
        ("setups of", "pick", "R", "P", "drop after 10 steps [%]", "after 30 [%]", "L-BFGS [%]"), rows
    )
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
        before, _, following = text.partition(begin)
        _, _, after = following.partition(end)
        text = f"{before}{begin}\n{table}\n{end}{after}"
    PAGE.write_text(text, encoding="utf-8")


FIELDS_SHOWN = ("hypervolume", "best_R", "R_at_half", "best_P")
FALLEN = ("R", "P", "after_10", "after_30", "optimum")


def _median(group: list[dict[str, Any]], field: str) -> str:
    middle = statistics.median(float(entry[field]) for entry in group)
    return f"{middle:.0f}" if field == "seconds" and middle >= 10 else f"{middle:.3g}"


def read_table(path: Path) -> list[dict[str, Any]]:
    """The lines of a table; none of one that is not there."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(path: Path, lines: list[dict[str, Any]]) -> None:
    """Write dictionaries with the same keys as a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


def main() -> int:
    """Carry out the missing runs and the descents, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", action="store_true", help="only write the tables into the page")
    parser.add_argument("--only", choices=("kernels", "centers", "methods"), help="only the runs of one table, no page")
    options = parser.parse_args()
    fallen_table = TABLE.with_name("choosing-descent.csv")
    if not options.page:
        template = RUNS / "car.vtp"
        if not template.exists():
            car = body()
            sys.argv = ["body.py", str(template)]
            car.main()
        lines, fallen = [], []
        for case in cases():
            if options.only in (None, case.table):
                for seed in SEEDS:
                    begin = time.perf_counter()
                    out = carry_out(case, seed, template)
                    lines.append(line(case, seed, out))
                    print(f"{out.name}: {time.perf_counter() - begin:.0f} s", flush=True)
        if options.only:
            return 0
        for kernel in KERNELS:
            for manipulation in ("indirect", "direct"):
                case = next(c for c in cases() if c[:3] == ("kernels", kernel, manipulation))
                fallen += descents(template, carry_out(case, 0, template), f"{kernel}, {manipulation}")
                print(f"descents of {kernel}, {manipulation}", flush=True)
        write(TABLE, lines)
        write(fallen_table, fallen)
    with TABLE.open(encoding="utf-8") as file, fallen_table.open(encoding="utf-8") as other:
        page(list(csv.DictReader(file)), list(csv.DictReader(other)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
