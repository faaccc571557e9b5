"""What setups between OLS and Lloyd are worth: `method=blend`, the ideas it is made of, and others that were tried.

    python -m benchmarks.blends              # a quarter of an hour; docs/blend.csv and the tables of docs/blend.md
    python -m benchmarks.blends --only car

Each idea gives eleven setups, for preferences 0, 0.1 .. 1. Its figure is the hypervolume of these as a share of that of
`method=gradient` (100 setups), all scored on all vertices, and its seconds, Lloyd and OLS not included.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import hydra
import torch
from hydra.core.global_hydra import GlobalHydra
from torch import Tensor

from benchmarks.choosing import ROOT, read_table, write
from benchmarks.panels import PANELS
from rbfevo.methods.blend import BlendHeuristic, Starts, climbed
from rbfevo.methods.method import Problem
from rbfevo.runs.assembly import Parts
from rbfevo.runs.config import CONF, check
from rbfevo.scoring.fronts import preferred
from rbfevo.scoring.pareto import hypervolume

PAGE, TABLE, CAR = ROOT / "docs" / "blend.md", ROOT / "docs" / "blend.csv", ROOT / "outputs" / "car" / "car.vtp"
WISHES = torch.linspace(0.0, 1.0, 11, dtype=torch.float64)
OF_CAR = (
    *("scenario=mesh", f"scenario.template={CAR}", "scenario.sensitivity=drag_sensitivity", "scenario.hold=wheels"),
    *("scenario.smooth=0.08", "scenario.symmetry=y", "manipulation=direct"),
)
ROUNDS, EACH, STEP = 6, 4, 0.08  # of `exchanged`: rounds, proposals a center, and how far, of the box


class Idea(NamedTuple):
    """An idea: its name, and what makes eleven setups of the starts."""

    name: str
    setups: Callable[[Problem, Problem, Starts], Tensor]


def exchanged(problem: Problem, starts: Starts) -> Tensor:
    """The best start of each preference after rounds in which each center tries some places near its own."""
    best, space, generator = starts.best(), problem.space, torch.Generator().manual_seed(0)
    lower, side = space.lower, space.upper - space.lower
    points = space.points(best)
    value = preferred(starts.weight, problem.evaluate(best).objectives)
    p, m, d = points.shape
    for number in range(ROUNDS):
        noise = torch.randn(p, m, EACH, d, generator=generator, dtype=points.dtype) * STEP * 0.7**number
        trials = points[:, None, None].expand(p, m, EACH, m, d).clone()
        centers = torch.arange(m)
        trials[:, centers, :, centers] += (noise * side[0]).transpose(0, 1)
        trials = trials.clamp(lower, space.upper)
        found = problem.evaluate(space.place(trials.flatten(0, 2))).objectives.view(p, m, EACH, 2)
        gain = preferred(starts.weight[:, None, None], found) - value[:, None, None]
        most, which = gain.max(2)
        moved = points.clone()
        for i in range(p):
            for j in torch.nonzero(most[i] > 0).flatten().tolist():
                moved[i, j] = trials[i, j, which[i, j], j]
        together = preferred(starts.weight, problem.evaluate(space.place(moved)).objectives)
        better = together > value
        points, value = torch.where(better[:, None, None], moved, points), torch.maximum(value, together)
    return space.place(points)


IDEAS = (
    Idea("between", lambda fine, coarse, starts: starts.setups[:11]),
    Idea("penalized", lambda fine, coarse, starts: starts.setups[11:22]),
    Idea("penalized, relaxed", lambda fine, coarse, starts: starts.setups[33:44]),
    Idea("best start", lambda fine, coarse, starts: starts.best()),
    Idea("exchange", lambda fine, coarse, starts: exchanged(coarse, starts)),
    *(
        Idea(f"{steps} climbs", lambda fine, coarse, starts, n=steps: climbed(coarse, starts.best(), starts.weight, n))
        for steps in (10, 25, 100)
    ),
)


def cases() -> dict[str, tuple[str, ...]]:
    """The overrides of each case, by its name."""
    return {panel.name: tuple(panel.overrides) for panel in PANELS} | {"car": OF_CAR}


def parts_of(*overrides: str) -> Parts:
    """The parts of a run."""
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return Parts(check(hydra.compose("config", overrides=list(overrides))))


def volume(problem: Problem, setups: Tensor) -> float:
    """The hypervolume of setups, scored on all vertices."""
    return float(hypervolume(problem.evaluate(setups).objectives))


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What it returns, and its seconds."""
    start = time.perf_counter()
    return work(), time.perf_counter() - start


def measured(name: str, overrides: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """A line for the gradient front, Lloyd, OLS, each idea and the method itself."""
    searched = parts_of(*overrides, "method=gradient")
    (search,) = searched.stages

    def front() -> Tensor:
        search.start(searched.problem())
        for _ in range(search.steps):
            search.step()
        return search.rows()[0].centers

    setups, seconds = timed(front)
    problem = parts_of(*overrides, "method=blend").problem()
    whole = volume(problem, setups)
    yield {"case": name, "idea": "gradient", "hypervolume": whole, "share": 1.0, "seconds": seconds}
    coarse, method = problem.coarsened(2000), BlendHeuristic()
    heuristics, seconds = timed(lambda: method.heuristics(problem))
    yield {"case": name, "idea": "Lloyd and OLS", "seconds": seconds, **_share(problem, heuristics, whole)}
    starts, of_starts = timed(lambda: Starts.of(problem, coarse, heuristics, WISHES))
    for idea in IDEAS:
        found, seconds = timed(lambda idea=idea: idea.setups(problem, coarse, starts))
        yield {"case": name, "idea": idea.name, "seconds": of_starts + seconds, **_share(problem, found, whole)}
    found, seconds = timed(lambda: method.place(problem))
    yield {"case": name, "idea": "method=blend", "seconds": seconds, **_share(problem, found, whole)}


def _share(problem: Problem, setups: Tensor, whole: float) -> dict[str, float]:
    found = volume(problem, setups)
    return {"hypervolume": found, "share": found / whole}


def page(lines: list[dict[str, Any]]) -> None:
    """Write the table of shares into docs/blend.md."""
    names = list(dict.fromkeys(line["idea"] for line in lines if line["idea"] != "gradient"))
    rows = ["| case | gradient: s | " + " | ".join(names) + " |", "|---|---|" + "---|" * len(names)]
    for case in dict.fromkeys(line["case"] for line in lines):
        own = {line["idea"]: line for line in lines if line["case"] == case}
        cells = [
            f"{100 * float(own[n]['share']):.1f} ({float(own[n]['seconds']):.1f})" if n in own else "" for n in names
        ]
        rows.append(f"| {case} | {float(own['gradient']['seconds']):.1f} | " + " | ".join(cells) + " |")
    before, _, rest = PAGE.read_text(encoding="utf-8").partition("<!-- shares -->\n")
    _, _, after = rest.partition("<!-- end of shares -->")
    text = "\n".join(rows)
    PAGE.write_text(f"{before}<!-- shares -->\n{text}\n<!-- end of shares -->{after}", encoding="utf-8")


def main() -> int:
    """Measure what is asked for, and write the table and the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="NAME", default="", help="cases whose names contain this")
    options = parser.parse_args()
    lines: list[dict[str, Any]] = [dict(line) for line in read_table(TABLE)]
    for name, overrides in cases().items():
        if options.only not in name:
            continue
        found = [
            {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in line.items()}
            for line in measured(name, overrides)
        ]
        print(
            name, *(f"{line['idea']} {line['share']} ({line['seconds']} s)" for line in found), sep="\n  ", flush=True
        )
        keys = ("case", "idea", "hypervolume", "share", "seconds")
        lines = [line for line in lines if line["case"] != name] + [{key: line[key] for key in keys} for line in found]
        order = list(cases())
        write(TABLE, sorted(lines, key=lambda line: order.index(line["case"])))
    page([dict(line) for line in read_table(TABLE)])
    return 0


if __name__ == "__main__":
    sys.exit(main())
