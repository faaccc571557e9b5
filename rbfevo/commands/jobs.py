"""The jobs of a sweep: which are done, the directory and threads of each one, and its outcome.

A launcher may start jobs as processes, also on other machines; they leave their outcomes in files of the sweep's
directory. A job is recognized by its settings, not by its number.
"""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.runs.directory import CHECKPOINT

STATUS = ".jobs"  # in the sweep's directory: one directory for each start of the sweep
START = "RBFEVO_START"  # where that directory is, for jobs in other processes


STOPPED = (130, 143)  # exit codes after SIGINT and SIGTERM


class Outcome(NamedTuple):
    """The outcome of a job.

    Attributes:
        number, overrides, directory: as Hydra has them; sweep: the sweep's directory.
        code: its exit code, None until it ends; message: the reason for it; skipped: whether it was done before.
        figures, quiet: its settings, once they are known.
    """

    number: int
    overrides: list[str]
    directory: str
    sweep: str
    code: int | None
    message: str = ""
    skipped: bool = False
    figures: bool = True
    quiet: bool = False


def begin(sweep: Path) -> Path:
    """A place for the outcomes of this start of the sweep, below its directory.

    Raises:
        UserError: if it cannot be written to.
    """
    place = (sweep / STATUS / uuid.uuid4().hex[:12]).absolute()
    os.environ[START] = str(place)
    try:
        place.mkdir(parents=True)
    except OSError as error:
        raise UserError(f"{sweep} cannot be written: {error.strerror or error}") from None
    return place


def save(outcome: Outcome) -> None:
    """Save the outcome of a job."""
    place = Path(os.environ[START])
    place.mkdir(parents=True, exist_ok=True)
    write_whole(place / f"{outcome.number}.json", json.dumps(outcome._asdict()).encode())


def outcomes(place: Path) -> list[Outcome]:
    """The outcomes of the jobs, by number."""
    found = [Outcome(**json.loads(path.read_text())) for path in place.glob("*.json")]
    return sorted(found, key=lambda outcome: outcome.number)


def states(sweep: Path) -> Iterator[tuple[str, Path, bool]]:
    """The runs below a sweep's directory that have checkpoints: hash of all settings, directory, whether it is done."""
    from rbfevo.runs import checkpoint

    for path in sorted(sweep.glob(f"**/{CHECKPOINT}")):  # a job's directory may be some levels down
        try:
            state = checkpoint.head(path.parent)
        except UserError:
            continue
        yield str(state.get("whole")), path.parent, bool(state.get("finished"))


def place_of(sweep: Path, numbered: Path, whole: str) -> tuple[Path, str]:
    """Where the job with settings of hash `whole` works, and how: `new`, `resume`, or `done`.

    That is where it has worked before; else `numbered`, unless another job has left something there.
    """
    for known, directory, finished in states(sweep):
        if known == whole:
            return directory, "done" if finished else "resume"
    taken = numbered.is_dir() and any(path.name not in (".lock", ".hydra") for path in numbered.iterdir())
    return (numbered.with_name(f"{numbered.name}-{whole[:8]}") if taken else numbered), "new"


def summary(found: list[Outcome]) -> list[str]:
    """The lines to print at the end of a sweep."""
    common = set.intersection(*(set(outcome.overrides) for outcome in found)) if found[1:] else set()

    def label(outcome: Outcome) -> str:
        own = [override for override in outcome.overrides if override not in common]
        return f"  {outcome.number} ({' '.join(own) or 'the only job'})"

    stopped = [outcome for outcome in found if outcome.code in STOPPED]
    failed = [outcome for outcome in found if outcome.code not in (0, None, *STOPPED)]
    lost = [outcome for outcome in found if outcome.code is None]
    skipped = sum(outcome.skipped for outcome in found)
    lines = []
    if skipped:
        lines.append(f"{skipped} of {len(found)} jobs were already done")
    if failed or lost:
        lines.append(f"{len(failed) + len(lost)} of {len(found)} jobs failed:")
        lines += [f"{label(outcome)}: {outcome.message or 'no reason given'}" for outcome in failed]
        lines += [f"{label(outcome)}: its process ended without a result" for outcome in lost]
    if stopped:
        lines.append("interrupted")
    if failed or lost or stopped:
        lines.append("start the same sweep again to run only the jobs that are not done")
    return lines


def threads(launcher: Any, jobs: int | None = None) -> int | None:
    """Threads for one job, so that all that run at once share the cores; None leaves them as they are.

    Args:
        launcher: Hydra's configuration of the launcher; jobs: how many there are, if that is known.
    """
    target = str(launcher.get("_target_", ""))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if "joblib" in target.lower():
        asked = int(launcher.get("n_jobs") or -1)
        at_once = asked if asked > 0 else max(1, cores + 1 + asked)
        return max(1, cores // min(at_once, jobs or at_once))
    if "submitit" in target.lower():
        return max(1, int(os.environ.get("SLURM_CPUS_PER_TASK") or launcher.get("cpus_per_task") or 1))
    return None
