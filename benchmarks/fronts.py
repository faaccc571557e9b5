"""NSGA-II's reference fronts: computes the missing ones and resumes an interrupted search.

`benchmarks/fronts/PANEL-seedS-E.csv` is the front after E evaluations. `PANEL-seedS.npz` is the complete state of the
search, from which a larger budget continues bit for bit. The search is `python -m rbfevo ... method=nsga2 seed=S`.
"""

from __future__ import annotations

import argparse
import io
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.panels import Panel, chosen
from rbfevo.errors import UserError
from rbfevo.methods.nsga2 import Nsga2Search
from rbfevo.runs import storage
from rbfevo.runs.run import Run
from rbfevo.scoring.pareto import hypervolume, nondominated
from rbfevo.scoring.threads import coarse

DIRECTORY = Path(__file__).parent / "fronts"
HISTORY_EVERY = 50  # generations
SAVE_EVERY = 30.0  # seconds
HISTORY = ("generation", "evaluations", "hypervolume", "best_regularity", "best_improvement_potential")


class Reference:
    """NSGA-II on one panel, with its state on disk; `overrides` are further Hydra overrides."""

    def __init__(self, panel: Panel, seed: int, directory: Path = DIRECTORY, *overrides: str) -> None:
        self.panel, self.seed, self.directory, self.overrides = panel, seed, directory, overrides
        self.path = directory / f"{panel.name}-seed{seed}.npz"
        self.seconds = self.cpu_seconds = 0.0
        self.failed = 0
        self.history: list[tuple[float, ...]] = []

    def csv(self, evaluations: int) -> Path:
        """The file of the front after this many evaluations."""
        return self.directory / f"{self.panel.name}-seed{self.seed}-{evaluations}.csv"

    def compute(self, generations: int, report: Any = print) -> None:
        """Run up to `generations` and write the front; continues a search whose state is on disk."""
        with coarse() as threads:
            overrides = ("method=nsga2", f"method.generations={generations}", f"seed={self.seed}", *self.overrides)
            run = Run(self.panel.settings(*overrides))
            (search,) = run.stages
            if not isinstance(search, Nsga2Search):
                raise UserError("method=nsga2 is not NSGA-II")
            search.start(run.problem())
            done = self._load(search)
            evaluations = (done + 1) * search.population
            begin, cpu, saved = time.perf_counter(), time.process_time(), time.perf_counter()
            before = self.seconds, self.cpu_seconds, self.failed - run.evaluator.failed_evaluations
            for generation in range(done + 1, generations + 1):
                search.step()
                evaluations = (generation + 1) * search.population
                now = time.perf_counter()
                self.seconds, self.cpu_seconds = before[0] + now - begin, before[1] + time.process_time() - cpu
                self.failed = before[2] + run.evaluator.failed_evaluations
                if generation % HISTORY_EVERY == 0 or generation == generations:
                    objectives = search.algorithm.objectives
                    best = objectives.amax(0).tolist()
                    self.history.append((generation, evaluations, hypervolume(objectives), *best))
                if now - saved > SAVE_EVERY:
                    self._save(search)
                    saved = now
            self._save(search)
            self._write(search, run, evaluations, threads)
        line = self.history[-1]
        report(f"{self.panel.name}: hypervolume {line[2]:.6f}, best R {line[3]:.6f}, best P {line[4]:.6f}, "
               f"{evaluations} evaluations, {self.seconds:.0f} s, processor {self.cpu_seconds:.0f} s")  # fmt: skip

    def _save(self, search: Nsga2Search) -> None:
        state = search.algorithm.state_dict()
        arrays = {name: np.asarray(value) for name, value in state.items()}
        arrays |= {
            "history": np.array(self.history),
            "spent": np.array([self.seconds, self.cpu_seconds, float(self.failed)]),
        }
        storage.write_whole(self.path, storage.npz(arrays))

    def population(self, evaluations: int) -> tuple[torch.Tensor, torch.Tensor]:
        """The population [N, D] after this many evaluations and its objectives [N, 2], read from disk.

        Raises:
            UserError: if the state is missing, or is that of another number of evaluations.
        """
        if not self.path.exists():
            raise UserError(f"{self.path} is missing: compute it with scripts/fronts {self.panel.name}")
        with np.load(io.BytesIO(self.path.read_bytes()), allow_pickle=False) as file:
            population, objectives = torch.from_numpy(file["population"]), torch.from_numpy(file["objectives"])
            stored = int(file["generation"]) * len(population)
        if stored != evaluations:
            raise UserError(f"{self.path} has {stored} evaluations, not {evaluations}: restore it, or compute it again")
        return population, objectives

    def _load(self, search: Nsga2Search) -> int:
        """Load the state from disk and return its number of generations; 0 if there is none."""
        if not self.path.exists():
            return 0
        with np.load(io.BytesIO(self.path.read_bytes()), allow_pickle=False) as file:
            arrays = dict(file)
        names = ("population", "objectives", "asked", "generator")
        search.algorithm.load_state_dict(
            {name: torch.from_numpy(arrays[name]) for name in names} | {"generation": int(arrays["generation"])}
        )
        self.history = [tuple(line) for line in arrays["history"].tolist()]
        self.seconds, self.cpu_seconds, failed = arrays["spent"].tolist()
        self.failed = int(failed)
        return search.algorithm.generation - 1  # the algorithm counts the initial population too

    def _write(self, search: Nsga2Search, run: Run, evaluations: int, threads: int) -> None:
        # Scored by definition, as in a run directory.
        centers = search.rows()[0].centers
        objectives = run.evaluator.definition(centers).objectives
        objectives = objectives[nondominated(objectives)]
        order = objectives[:, 0].argsort()
        facts = {
            "panel": self.panel.name,
            "method": "nsga2",
            "seed": self.seed,
            "generations": search.algorithm.generation - 1,
            "evaluations": evaluations,
            "failed_evaluations": self.failed,
            "seconds": round(self.seconds, 1),
            "processor_seconds": round(self.cpu_seconds, 1),
            "threads": threads,
            "evaluator": run.evaluator.backend,
            "torch": torch.__version__,
            "machine": platform.machine(),
            "hypervolume": hypervolume(objectives),
        }
        head = "".join(f"# {name}: {value}\n" for name, value in facts.items()).encode()
        table = storage.csv_text(("regularity", "improvement_potential"), objectives[order].tolist())
        storage.write_whole(self.csv(evaluations), head + table)


def reference_front(panel: Panel, evaluations: int, seed: int = 0, directory: Path = DIRECTORY) -> torch.Tensor:
    """The committed front [p, 2] of regularity and improvement potential.

    Raises:
        UserError: if it has not been computed.
    """
    path = Reference(panel, seed, directory).csv(evaluations)
    if not path.exists():
        raise UserError(f"{path} is missing: compute it with scripts/fronts {panel.name}")
    return torch.from_numpy(np.loadtxt(path, delimiter=",", skiprows=_header(path), ndmin=2))


def _header(path: Path) -> int:
    return sum(line.startswith("#") for line in path.read_text().splitlines()) + 1


def main() -> int:
    """Compute the missing fronts."""
    parser = argparse.ArgumentParser(prog="scripts/fronts", description=__doc__)
    parser.add_argument("panels", nargs="*", help="panels, or parts of their names; default: all twelve")
    parser.add_argument("--generations", type=int, default=2499, help="default: 2499, which is 250,000 evaluations")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    arguments = parser.parse_args()
    DIRECTORY.mkdir(exist_ok=True)
    try:
        for panel in chosen(arguments.panels):
            reference = Reference(panel, arguments.seed)
            if not reference.csv((arguments.generations + 1) * 100).exists():
                reference.compute(arguments.generations, lambda line: print(line, flush=True))
    except UserError as error:
        print(f"scripts/fronts: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
