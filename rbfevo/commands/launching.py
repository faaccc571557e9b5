"""Between Hydra's sweeper and its launcher: only the jobs that are not done are launched.

A job that was done before would cost a launcher a composed configuration, and SLURM a place in its queue and a process.
"""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from rbfevo.commands import jobs
from rbfevo.commands.finished import Finished

JOBLIB, SLURM = "JoblibLauncher", "SlurmLauncher"  # classes of Hydra's plugins


class Numbers(int):
    """The number of the first job that is launched; launchers add a job's place among them, and get its own number."""

    numbers: Sequence[int]

    def __new__(cls, numbers: Sequence[int]) -> Numbers:
        made = super().__new__(cls, numbers[0])
        made.numbers = numbers
        return made

    def __add__(self, place: int) -> int:
        return self.numbers[place]


class Remaining(Launcher):
    """A launcher that hands the jobs that are not done to another one, and saves the outcomes of the others."""

    def __init__(self, launcher: Launcher, validate: Callable[[Sequence[Sequence[str]]], None]) -> None:
        self._launcher, self._validate = cast(Any, launcher), validate
        self._finished: Finished | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """The other launcher has been set up."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Launch the jobs that are not done; what it returns of the others is empty."""
        config = self._launcher.config
        sweep = Path(str(config.hydra.sweep.dir))
        if self._finished is None:  # before the first batch
            if type(self._launcher).__name__ == SLURM:
                from rbfevo.commands import slurm  # with submitit

                slurm.refuse(config.hydra.launcher, sweep)
            states = list(jobs.states(sweep))
            jobs.remember(states, sweep)
            self._finished = Finished(states, self._launcher.hydra_context.config_loader, config)
        found = [self._finished.directory(overrides) for overrides in job_overrides]
        places = [place for place, done in enumerate(found) if done is None]
        remaining = [job_overrides[place] for place in places]
        self._validate(remaining)
        for place, done in enumerate(found):
            if done is not None:
                directory, settings = done
                print(f"{directory.name}: done already ({' '.join(job_overrides[place])})", flush=True)
                outcome = jobs.Outcome(initial_job_idx + place, [*job_overrides[place]], directory.name, str(sweep), 0)
                quiet, figures = settings.get("quiet") is True, settings.get("figures") is True
                jobs.save(outcome._replace(skipped=True, figures=figures, quiet=quiet))
        returned = [JobReturn(_return_value=None, status=JobStatus.COMPLETED) for _ in job_overrides]
        if remaining:
            launched = self._launch(remaining, Numbers([initial_job_idx + place for place in places]))
            for place, made in zip(places, launched, strict=True):
                returned[place] = made
        return returned

    def _launch(self, job_overrides: Sequence[Sequence[str]], numbers: Numbers) -> Sequence[JobReturn]:
        name = type(self._launcher).__name__
        if name == JOBLIB and _initializes():
            self._launcher.joblib["initializer"] = jobs.hear_no_signals
        if name != SLURM:
            return self._launcher.launch(job_overrides, numbers)
        from rbfevo.commands import slurm

        with slurm.watched(self._launcher.config.hydra.launcher, job_overrides, numbers.numbers):
            return self._launcher.launch(job_overrides, numbers)


def _initializes() -> bool:
    """Whether this joblib lets its processes begin with a function of ours."""
    import joblib

    return "backend_kwargs" in inspect.signature(joblib.Parallel.__init__).parameters


@contextlib.contextmanager
def remaining() -> Iterator[None]:
    """Let a sweep that Hydra starts meanwhile launch only those of its jobs that are not done."""
    plugins = Plugins.instance()
    make = plugins.instantiate_sweeper

    def made(**arguments: Any) -> Sweeper:
        """The sweeper of a plugin, whose launcher leaves out the jobs that are done."""
        sweeper = make(**arguments)
        launcher = getattr(sweeper, "launcher", None)
        if launcher is not None:
            replaced = {"launcher": Remaining(launcher, sweeper.validate_batch_is_legal)}
            vars(sweeper).update(replaced, validate_batch_is_legal=lambda batch: None)
        return sweeper

    vars(plugins)["instantiate_sweeper"] = made
    try:
        yield
    finally:
        del vars(plugins)["instantiate_sweeper"]
