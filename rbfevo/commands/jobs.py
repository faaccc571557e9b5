"""The jobs of a sweep: which are done, the directory and threads of each one, and its outcome.

A launcher may start jobs as processes, also on other machines; they leave their outcomes in files of the sweep's
directory. A job is recognized by its settings, not by its number.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.runs.directory import CHECKPOINT

STATUS = ".jobs"  # in the sweep's directory: one directory for each start of the sweep
START = "RBFEVO_START"  # where that directory is, for jobs in other processes
QUEUED = "slurm"  # a file there: the ids of jobs in SLURM's queue, until all of them have ended
STOP = "stop"  # a file there: no further job begins, and those that run stop
KNOWN = "known"  # a file there: where the jobs work that have begun before, by the hash of their settings
STOPPED = (130, 143)  # exit codes after SIGINT and SIGTERM
_begun: Path | None = None  # the place of the sweep that this process has started last
_leader: int | None = None  # the process that has started this one of joblib's


class Outcome(NamedTuple):
    """The outcome of a job.

    Attributes:
        number, overrides, directory: as Hydra has them; sweep: the sweep's directory.
        code: its exit code, None until it ends; message: the reason for it; skipped: whether it was done before.
        figures, quiet: its settings, once they are known.
        process: the id of its process on the machine on which that runs.
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
    process: int = 0


class State(NamedTuple):
    """A run below a sweep's directory that has a checkpoint: the hash of all its settings, and whether it is done."""

    whole: str
    directory: Path
    finished: bool
    overrides: Sequence[str]


def begin(sweep: Path) -> Path:
    """A place for the outcomes of this start of the sweep, below its directory.

    Raises:
        UserError: if it cannot be written to.
    """
    global _begun
    place = _begun = (sweep / STATUS / uuid.uuid4().hex[:12]).absolute()
    os.environ[START] = str(place)
    try:
        place.mkdir(parents=True)
    except OSError as error:
        raise UserError(f"{sweep} cannot be written: {error.strerror or error}") from None
    return place


def end(sweep: Path) -> None:
    """Remove the places for outcomes below a sweep's directory, but for those of jobs that SLURM still has."""
    for place in (sweep / STATUS).glob("*"):
        if not (place / QUEUED).exists():
            shutil.rmtree(place, ignore_errors=True)
    with contextlib.suppress(OSError):
        (sweep / STATUS).rmdir()


def hear_no_signals() -> None:
    """Let SIGINT and SIGTERM do nothing to this process of joblib's, but for the run that is in it: that sets its own.

    joblib kills all its processes when one of them ends, and a terminal and SLURM send signals to all of them.
    """
    global _leader
    _leader = _leader or os.getppid()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def stopping() -> bool:
    """Whether no further job of the sweep begins here, and those that run stop."""
    return (place() / STOP).exists() or orphaned()


def orphaned() -> bool:
    """Whether the main process that has started this one of joblib's is dead, which joblib notices after minutes."""
    return _leader not in (None, os.getppid())


def leads() -> bool:
    """Whether this process has started the sweep: jobs are in the same process, or in others."""
    return _begun is not None and _begun == place()


def place() -> Path:
    """The place for the outcomes of this start of the sweep.

    Raises:
        UserError: if the launcher has not handed it on.
    """
    if START not in os.environ:
        raise UserError(f"the launcher hands no environment on to its jobs: {START} is missing (SLURM: --export=ALL)")
    return Path(os.environ[START])


def save(outcome: Outcome) -> None:
    """Save the outcome of a job."""
    place().mkdir(parents=True, exist_ok=True)
    made = place() / f".{uuid.uuid4().hex}"  # without waiting for the disk: it need not outlive a power cut
    made.write_text(json.dumps(outcome._asdict()))
    made.replace(place() / f"{outcome.number}.json")


def forget(outcome: Outcome) -> None:
    """Remove the outcome of a job that has not begun after all."""
    (place() / f"{outcome.number}.json").unlink(missing_ok=True)


def outcomes(place: Path) -> list[Outcome]:
    """The outcomes of the jobs, by number."""
    found = [Outcome(**json.loads(path.read_text())) for path in place.glob("*.json")]
    return sorted(found, key=lambda outcome: outcome.number)


def states(sweep: Path) -> Iterator[State]:
    """The runs below a sweep's directory that have checkpoints, in the order of their paths; damaged ones are left out.

    A job's directory may be some levels down; hidden directories, and those within a run, are not looked into.
    """
    from rbfevo.runs import checkpoint

    for directory, below, files in os.walk(sweep, followlinks=True):
        below[:] = sorted(name for name in below if not name.startswith("."))
        if CHECKPOINT not in files:
            continue
        if Path(directory) != sweep:
            below.clear()
        try:
            head = checkpoint.head(Path(directory))
        except UserError:
            continue
        yield State(str(head.get("whole")), Path(directory), bool(head.get("finished")), head.get("words") or [])


def remember(found: Sequence[State], sweep: Path) -> None:
    """Save where the jobs work that have begun before, so that not every job reads all checkpoints."""
    runs: dict[str, str] = {}
    for state in found:
        runs.setdefault(state.whole, str(state.directory.relative_to(sweep)))
    write_whole(place() / KNOWN, json.dumps({"sweep": str(sweep.resolve()), "runs": runs}).encode())


def place_of(sweep: Path, numbered: Path, whole: str) -> tuple[Path, str]:
    """Where the job with settings of hash `whole` works, and how: `new`, `resume`, or `done`.

    That is where it has worked before; else `numbered`, unless another job has left something there. Of several jobs
    with the same settings in one sweep the first one decides.
    """
    from rbfevo.runs import checkpoint

    directory = _claimed(whole, _known(sweep).get(whole) or _free(numbered, whole))
    try:
        head = checkpoint.head(directory)
    except UserError:
        return directory, "new"
    if str(head.get("whole")) != whole:  # it has been lengthened, or replaced, since
        return _free(numbered, whole), "new"
    return directory, "done" if head.get("finished") else "resume"


def _known(sweep: Path) -> dict[str, Path]:
    """The directories of jobs that have begun before, by the hash of their settings."""
    with contextlib.suppress(OSError, ValueError):  # without the file, its start of the sweep has ended before the job
        saved = json.loads((place() / KNOWN).read_text())
        if saved["sweep"] == str(sweep.resolve()):  # it may be another one for each job
            return {whole: sweep / name for whole, name in saved["runs"].items()}
    return {state.whole: state.directory for state in reversed(list(states(sweep)))}


def _free(numbered: Path, whole: str) -> Path:
    taken = numbered.is_dir() and any(path.name not in (".lock", ".hydra") for path in numbered.iterdir())
    return numbered.with_name(f"{numbered.name}-{whole[:8]}") if taken else numbered


def _claimed(whole: str, directory: Path) -> Path:
    """The directory that the first job with these settings has chosen in this start of the sweep."""
    place().mkdir(parents=True, exist_ok=True)
    claim, text = place() / whole, place() / f".{uuid.uuid4().hex}"
    text.write_text(str(directory))
    try:
        os.link(text, claim)
    except FileExistsError:
        return Path(claim.read_text())
    except OSError:  # a file system without links: two equal jobs at the same moment may then both begin
        text.replace(claim)
    finally:
        text.unlink(missing_ok=True)
    return directory


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
