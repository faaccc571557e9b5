"""The union of fronts: for each panel the best setups that any method has found.

`benchmarks/union/PANEL.npz` holds nondominated setups with their centers, scored by the definition on all vertices, and
the sources that they were chosen from: the overrides of a run, or a committed front of NSGA-II. A source that is there
already is not computed again. No method reads these files.
"""

from __future__ import annotations

import argparse
import io
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.fronts import DIRECTORY as FRONTS
from benchmarks.fronts import Reference
from benchmarks.panels import Panel, chosen
from rbfevo.errors import UserError
from rbfevo.runs import storage
from rbfevo.runs.run import Run
from rbfevo.scoring.pareto import hypervolume, well_spread
from rbfevo.scoring.threads import coarse

DIRECTORY = Path(__file__).parent / "union"
LIMIT = 250  # setups of a union: those that keep most of the hypervolume
SEEDS = range(10)
AIMS = {"hypervolume": 0.995, "best_regularity": 0.997, "best_improvement_potential": 0.997}  # of the union's
WISHES = "preference=[0,0.1,0.2,0.3,0.4,0.5,0.6,0.7,0.8,0.9,1]"
GROUPS = {
    "heuristics": (
        "method=ols",
        "method=random seed=0",
        *(f"method={name} seed={seed}" for name in ("lloyd", "blend") for seed in SEEDS),
    ),
    "gradient": tuple(f"method=gradient seed={seed}" for seed in SEEDS),
    "wishes": tuple(f"method=gradient {WISHES} seed={seed}" for seed in SEEDS[:3]),
    "long": tuple(
        f"method=gradient method.generations=1700 method.polish=150 method.coarse=4000 seed={seed}"
        for seed in SEEDS[:2]
    ),
    "cmaes": (f"method=cmaes method.generations=1000 {WISHES} seed=0",),
}


class Union(NamedTuple):
    """The best setups known of one panel.

    Attributes:
        centers: [p, m, d]; objectives: [p, 2] R and P by the definition, sorted by rising R.
        source: [p] long, index of the source of each setup; sources: all that were added, whether setups stay or not.
    """

    centers: Tensor
    objectives: Tensor
    source: Tensor
    sources: tuple[str, ...]

    @classmethod
    def read(cls, panel: Panel, directory: Path = DIRECTORY) -> Union | None:
        """The union on disk; None if there is none."""
        path = directory / f"{panel.name}.npz"
        if not path.exists():
            return None
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            centers, objectives, source = (torch.from_numpy(file[name]) for name in ("centers", "objectives", "source"))
            return cls(centers, objectives, source, tuple(file["sources"].tolist()))

    def write(self, panel: Panel, directory: Path = DIRECTORY) -> None:
        """Write it to disk."""
        arrays = {name: getattr(self, name).numpy() for name in ("centers", "objectives", "source")}
        storage.write_whole(
            directory / f"{panel.name}.npz", storage.npz({**arrays, "sources": np.array(self.sources, dtype=np.str_)})
        )

    def with_setups(self, centers: Tensor, objectives: Tensor, source: str) -> Union:
        """The union of this one and setups [q, m, d] with objectives [q, 2]: at most `LIMIT` nondominated ones."""
        new = torch.full((len(centers),), len(self.sources))
        centers, objectives = torch.cat((self.centers, centers)), torch.cat((self.objectives, objectives))
        rows = well_spread(objectives, LIMIT)
        return Union(centers[rows], objectives[rows], torch.cat((self.source, new))[rows], (*self.sources, source))


def empty(panel: Panel) -> Union:
    """The union of no sources."""
    d = 2 if panel.scenario == "plane" else 3
    like = torch.empty(0, dtype=torch.float64)
    return Union(like.view(0, 25, d), like.view(0, 2), torch.empty(0, dtype=torch.long), ())


def committed(panel: Panel) -> Iterator[tuple[str, Reference, int]]:
    """The committed searches of NSGA-II: name of the source, the search, and its evaluations."""
    for directory in (FRONTS, FRONTS / "paper"):
        for path in sorted(directory.glob(f"{panel.name}-seed*-*.csv")):
            seed, evaluations = (int(part) for part in path.stem.removeprefix(f"{panel.name}-seed").split("-"))
            reference = Reference(panel, seed, directory)
            if reference.path.exists():
                yield f"method=nsga2 method.generations={evaluations // 100 - 1} seed={seed}", reference, evaluations


def setups_of_run(panel: Panel, overrides: str) -> Tensor:
    """The setups [p, m, d] that a run finds."""
    run = Run(panel.settings(*overrides.split()))
    found = []
    for search in run.stages:
        search.start(run.problem())
        for _ in range(search.steps):
            search.step()
        found += [rows.centers for rows in search.rows()]
    return torch.cat(found)


def add(panel: Panel, groups: list[str], directory: Path = DIRECTORY) -> None:
    """Add the sources that are missing to the union of a panel; it is written after each."""
    held = Union.read(panel, directory) or empty(panel)
    evaluator = Run(panel.settings()).evaluator
    searches = {source: (reference, evaluations) for source, reference, evaluations in committed(panel)}
    sources = [*(searches if "nsga2" in groups else ()), *(one for group in groups for one in GROUPS.get(group, ()))]
    for source in sources:
        if source in held.sources:
            continue
        begin = time.perf_counter()
        if source in searches:
            reference, evaluations = searches[source]
            centers = reference.population(evaluations)[0].view(-1, *held.centers.shape[1:])
        else:
            centers = setups_of_run(panel, source)
        held = held.with_setups(centers, evaluator.definition(centers).objectives, source)
        held.write(panel, directory)
        print(f"{line(panel, held)}  {source}  {time.perf_counter() - begin:.0f} s", flush=True)


def line(panel: Panel, held: Union) -> str:
    """Hypervolume, best R, best P, and how many setups."""
    best = held.objectives.amax(0).tolist()
    volume = hypervolume(held.objectives)
    return f"{panel.name:30} {volume:.6g} {best[0]:.6g} {best[1]:.6g} {len(held.centers)}"


class Compared(NamedTuple):
    """One front of `method=gradient` beside the union: ratios of hypervolume, best R and best P, and seconds."""

    panel: str
    seed: int
    hypervolume: float
    best_regularity: float
    best_improvement_potential: float
    seconds: float


def compared(panel: Panel, seed: int, *overrides: str) -> Compared:
    """The front of one seed beside the union on disk; `seconds` are those of the search alone.

    Raises:
        UserError: if the panel has no union.
    """
    held = Union.read(panel)
    if held is None:
        raise UserError(
            f"{DIRECTORY}/{panel.name}.npz is missing: make it with python -m benchmarks.unions add {panel.name}"
        )
    run = Run(panel.settings("method=gradient", f"seed={seed}", *overrides))
    (search,) = run.stages
    problem = run.problem()
    begin = time.perf_counter()
    search.start(problem)
    for _ in range(search.steps):
        search.step()
    seconds = time.perf_counter() - begin
    objectives = run.evaluator.definition(search.rows()[0].centers).objectives
    regularity, potential = (objectives.amax(0) / held.objectives.amax(0)).tolist()
    share = hypervolume(objectives) / hypervolume(held.objectives)
    return Compared(panel.name, seed, share, regularity, potential, seconds)


def misses(found: list[Compared]) -> list[str]:
    """The targets that the medians over seeds of one panel miss."""
    medians = [statistics.median(getattr(one, name) for one in found) for name in AIMS]
    return [f"{name} {value:.4f}" for (name, aim), value in zip(AIMS.items(), medians, strict=True) if value < aim]


def main() -> int:
    """Add to the unions, or compare `method=gradient` with them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.unions", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    adding = commands.add_parser("add", help="compute the sources that are missing")
    adding.add_argument("panels", nargs="*", help="panels, or parts of their names; default: all twelve")
    adding.add_argument("--groups", nargs="+", choices=["nsga2", *GROUPS], default=["nsga2", *GROUPS])
    comparing = commands.add_parser("compare", help="the front of method=gradient beside the union")
    comparing.add_argument("panels", nargs="*", help="panels, or parts of their names; default: all twelve")
    comparing.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="default: 0 1 2")
    comparing.add_argument("--overrides", nargs="*", default=[], help="of the search, such as method.population=100")
    comparing.add_argument("--output", type=Path, help="CSV file; default: none")
    arguments = parser.parse_args()
    DIRECTORY.mkdir(exist_ok=True)
    try:
        with coarse():
            if arguments.command == "add":
                for panel in chosen(arguments.panels):
                    add(panel, arguments.groups)
                return 0
            table = []
            for panel in chosen(arguments.panels):
                found = [compared(panel, seed, *arguments.overrides) for seed in arguments.seeds]
                table += found
                for one in found:
                    print(f"{one.panel:30} {one.seed:4} " + " ".join(f"{value:.4f}" for value in one[2:]), flush=True)
                print(f"{panel.name:30} {'; '.join(misses(found)) or 'reached'}", flush=True)
        if arguments.output is not None:
            storage.write_whole(arguments.output, storage.csv_text(Compared._fields, table))
    except UserError as error:
        print(f"benchmarks.unions: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
