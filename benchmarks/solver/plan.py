"""Which setups are compared on a case, by a plan that was committed before any solver ran on a deformed design."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.elsewhere.setups import placed, scores
from rbfevo.__main__ import main as rbfevo
from rbfevo.arrays import Array
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import Setup, setup

SEEDS = (0, 1, 2)
LATTICES = ((3, 2, 2), (4, 2, 2))  # of free-form deformation, in the box of the design; columns of one half
MARGIN = 0.02  # of half the longest side of that box
GRIDS = {"few": ((2, 2, 1), (3, 2, 1)), "many": ((3, 2, 2), (4, 2, 2))}


class Plan(NamedTuple):
    """What `python -m rbfevo.advise` recommends for a case, and what is compared with it.

    Attributes:
        few: centers, the recommended number but at most 6; many: 16.
        radii: the recommended one, and half of it; smooth: the length that it recommends; model units.
        step: the largest displacement of a step, a fraction of the diagonal of the design surface.
    """

    few: int
    radii: tuple[float, float]
    smooth: float
    many: int = 16
    step: float = 0.01


# python -m rbfevo.advise recommends 6 centers of radius 2.911 (duct), 10 of 1.248 (body), 5 of 2.06 (diffuser), 8 of
# 105.7 (elastic); the commands stand in examples/openfoam and examples/elastic.
PLANS = {
    "duct": Plan(6, (2.911, 1.4555), 0.1332),
    "body": Plan(6, (1.248, 0.624), 0.08318),
    "diffuser": Plan(5, (2.06, 1.03), 0.1311),
    "elastic": Plan(6, (105.7, 52.85), 10.21),
}


class Chosen(NamedTuple):
    """A setup: its family, `few` or `many` centers, its radius, the run's record and its columns."""

    family: str
    size: str
    radius: float
    record: Record
    setup: Setup


def setups(settings: tuple[str, ...], plan: Plan, runs: Path) -> Iterator[Chosen]:
    """All setups of a case; a run that was carried out already is read.

    Args:
        settings: of a run on the case; runs: the directory of the runs.
    """
    for radius in plan.radii:
        for size, count in (("few", plan.few), ("many", plan.many)):
            common = (*settings, f"scenario.smooth={plan.smooth!r}", f"kernel.support={radius!r}", f"centers={count}")
            out = runs / f"advised-{size}-{radius:g}"
            record = run(out, *common, "criterion.norm=16", "method=gradient")
            yield Chosen("advised", size, radius, record, setup(record, pick(record, "potential:0.95")))
            for seed in SEEDS:
                lloyd = run(runs / f"lloyd-{seed}-{size}-{radius:g}", *common, "method=lloyd", f"seed={seed}")
                yield Chosen(f"Lloyd {seed}", size, radius, lloyd, setup(lloyd, 0))
            for shape in GRIDS[size]:
                yield Chosen("x".join(map(str, shape)), size, radius, *placed(record, grid(record, shape)))
    yield from boxes(settings, plan, runs)


def boxes(settings: tuple[str, ...], plan: Plan, runs: Path) -> Iterator[Chosen]:
    """Lattices of free-form deformation in the box of the design surface, symmetric where the design is."""
    common = (*settings, f"scenario.smooth={plan.smooth!r}", "method=random", "method.population=1")
    plane = run(runs / "random", *common).summary.get("symmetry")
    for shape in LATTICES:
        counts, name = list(shape), "x".join(map(str, shape))
        if isinstance(plane, dict):
            counts["xyz".index(plane["axis"])] *= 2
        lattice = ("representation=ffd", f"representation.lattice=[{','.join(map(str, counts))}]")
        record = run(runs / f"ffd-{name}", *common, *lattice, manipulation="indirect")
        lower, upper = record.vertices.min(0), record.vertices.max(0)
        half = 0.5 * (upper - lower)
        box = np.concatenate([0.5 * (lower + upper), half + MARGIN * half.max()])
        if isinstance(plane, dict):
            box["xyz".index(plane["axis"])] = plane["at"]
        made = dataclasses.replace(record, genotype=box[None], centers=record.centers[:1])
        chosen = setup(made, 0)
        yield Chosen(f"FFD {name}", "many", 0.0, dataclasses.replace(made, centers=chosen.weight_places[None]), chosen)


def run(out: Path, *overrides: str, manipulation: str = "direct") -> Record:
    """The record of a run, which is carried out if it was not."""
    common = (f"manipulation={manipulation}", "figures=false", "quiet=true", f"hydra.run.dir={out}")
    if not (out / "summary.json").exists() and rbfevo([*overrides, *common]):
        raise SystemExit(f"{out}: the run failed")
    return read(out)


def grid(record: Record, shape: tuple[int, int, int]) -> Array:
    """The middles [m, 3] of the cells of a uniform grid over the box of the design surface, of one half of it where it
    is symmetric."""
    lower, upper = record.vertices.min(0), record.vertices.max(0)
    if isinstance(plane := record.summary.get("symmetry"), dict):
        lower["xyz".index(plane["axis"])] = plane["at"]
    axes = [low + (high - low) * (np.arange(n) + 0.5) / n for low, high, n in zip(lower, upper, shape, strict=True)]
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)


def known(chosen: Chosen) -> dict[str, float]:
    """R, P and P_16 of a setup for the raw and the smoothed sensitivity of the original design."""
    record = chosen.record
    raw = record.gradient if record.gradient_raw is None else record.gradient_raw
    return scores(chosen.setup, record, {"raw": raw, "smooth": record.gradient})
