"""The setups of a case: families of runs of `python -m rbfevo` and uniform grids; and the numbers known beforehand."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.elsewhere.cases import Case
from rbfevo.__main__ import main as rbfevo
from rbfevo.arrays import Array
from rbfevo.recorded.parameters import design_matrix
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import EPS, Setup, setup
from rbfevo.scenarios.smoothing import smoothed
from rbfevo.scoring.maxnorm import Block, best_displacement, dual_norm

CELLS = 1.5  # length of smoothing, in median edges
SEARCH = ("method=gradient", "method.generations=60", "method.starts=32", "method.population=16",
          "method.coarse=1000", "method.polish=4", "method.front=20")  # fmt: skip
BOUNDED = 16.0
ENDS = ("best-regularity", "knee", "best-improvement-potential")


class Family(NamedTuple):
    """Setups of one run: the run's overrides, whether it looks at the smoothed sensitivity, and which are picked."""

    overrides: tuple[str, ...]
    smooth: bool
    picks: tuple[str, ...]


FAMILIES = {
    **{f"Lloyd {seed}": Family(("method=lloyd", f"seed={seed}"), True, ("index:0",)) for seed in range(3)},
    "random": Family(("method=random", "method.population=3"), True, ("index:0", "index:1", "index:2")),
    "OLS": Family(("method=ols",), True, ("index:0",)),
    "P raw": Family(SEARCH, False, ENDS[1:]),
    "P": Family(SEARCH, True, ENDS),
    "P_16": Family((*SEARCH, "criterion.norm=16"), True, ENDS),
    "P_16 raw": Family((*SEARCH, "criterion.norm=16"), False, ENDS[1:]),
}
SHORT = {"knee": " knee", "best-regularity": " best R", "best-improvement-potential": " best", "index:0": ""}
ON_SURFACE = ("Lloyd 0", "Lloyd 1")  # which setups are taken once more, each center at the nearest vertex that is free


def setups(case: Case, count: int, radius: float, runs: Path) -> Iterator[tuple[str, Record, Setup]]:
    """Family, the run's record and the setup, for each setup of a number of centers and a radius.

    A run that was carried out already is read. A target knows no smoothing in its run: `P raw` would be `P`.
    """
    first = None
    for family, (overrides, smooth, picks) in FAMILIES.items():
        if case.target and not smooth:
            continue
        out = runs / f"{case.name}-{count}-{radius:g}-{family.replace(' ', '-')}"
        if not (out / "summary.json").exists():
            common = [*case.overrides, f"kernel.support={radius!r}", f"centers={count}", "manipulation=direct",
                      "figures=false", "quiet=true", f"hydra.run.dir={out}"]  # fmt: skip
            if not case.target:
                common.append(f"scenario.template={runs / case.name}.vtp")
                if smooth:
                    common.append(f"scenario.smooth={CELLS * case.cell!r}")
            if rbfevo([*common, *overrides]):
                raise SystemExit(f"{out}: the run failed")
        record = read(out)
        first = record if first is None else first
        for choice in picks:
            yield family + SHORT.get(choice, f" {choice[-1]}"), record, setup(record, pick(record, choice))
        if family in ON_SURFACE:
            yield f"{family} on surface", *placed(record, on_surface(record))
    assert first is not None
    yield "grid", *placed(first, grid(first, count))


def placed(record: Record, centers: Array) -> tuple[Record, Setup]:
    """A run's record with centers [m, d] in place of its own, and their setup."""
    record = dataclasses.replace(record, centers=centers[None])
    return record, setup(record, 0)


def on_surface(record: Record) -> Array:
    """The centers of the first row, each at the nearest vertex that moves freely, on their side of a symmetry plane."""
    centers = record.centers[0]
    free = np.ones(len(record.vertices), bool) if record.blend is None else record.blend > 0.5
    if isinstance(plane := record.summary.get("symmetry"), dict):
        axis, at = "xyz".index(plane["axis"]), plane["at"]
        side = np.sign((centers[:, axis] - at).sum())
        free &= side * (record.vertices[:, axis] - at) > -1e-6
    vertices = record.vertices[free]
    return vertices[((centers[:, None] - vertices) ** 2).sum(2).argmin(1)]


def grid(record: Record, count: int) -> Array:
    """The centers [count, d] of a uniform grid in the box of the vertices, of one half where they are symmetric.

    Of all grids with that number of cells, the one whose cells are most like cubes.
    """
    lower, upper = record.vertices.min(0), record.vertices.max(0)
    if isinstance(plane := record.summary.get("symmetry"), dict):
        lower["xyz".index(plane["axis"])] = plane["at"]
    sides, d = upper - lower, len(lower)
    divisors = [n for n in range(1, count + 1) if count % n == 0]
    shapes = [shape for shape in itertools.product(divisors, repeat=d) if math.prod(shape) == count]
    shape = min(shapes, key=lambda shape: float(np.var(np.log(np.maximum(sides, 1e-9) / shape))))
    axes = [low + side * (np.arange(n) + 0.5) / n for low, side, n in zip(lower, sides, shape, strict=True)]
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)


def wanted(case: Case, record: Record, smooth: bool) -> Array:
    """The displacement [n, k] that the case wants, the descent of J, of any size; smoothed or not."""
    g = -case.sensitivity(np.zeros((len(case.vertices), case.components)))[1] / record.weights[:, None]
    held = np.zeros(len(g), bool) if record.blend is None else record.blend == 0.0
    g[held] = 0.0
    if not smooth:
        return g
    args = (record.weights, held, CELLS * case.cell, not case.target)
    return smoothed(g, case.in_space, case.faces, *args).wanted


def scores(chosen: Setup, record: Record, fields: dict[str, Array]) -> dict[str, float]:
    """R; and P and P_16 of each wanted displacement, by the definition."""
    blocks, singular = [], []
    whole = 0
    for components, across, columns in chosen.parities(record.gradient.shape[1]):
        U = chosen.blended(record.vertices, across)[:, columns]
        left, values, _ = np.linalg.svd(U, full_matrices=False)
        kept = values > max(U.shape) * EPS * values.max(initial=0.0)
        blocks.append(Block(components, left[:, kept]))
        whole += int(kept.sum()) - len(columns)
        if chosen.manipulation == "direct":
            whole -= int(chosen.singular(across))
            U = U if chosen.singular(across) else design_matrix(chosen, record.vertices, across)
        singular.append(np.linalg.svd(np.sqrt(record.weights)[:, None] * U, compute_uv=False))
    values = np.concatenate(singular)
    found = {"R": 0.0 if whole < 0 else float(values.min() / values.max())}
    for name, g in fields.items():
        a = record.weights[:, None] * g
        for label, p in (("P", 2.0), ("P16", BOUNDED)):
            gain = best_displacement(blocks, a, record.weights, p).gain
            found[f"{label}_{name}"] = (gain / dual_norm(a, record.weights, p)) ** 2
    return found
