"""A sweep on SLURM: its jobs are waited for whatever becomes of some of them, and those without a result have a reason.

submitit itself gives up on a sweep at its first job without a result, and asks SLURM's accounting about its jobs. Many
clusters have no accounting, and there it would wait forever for a job that was cancelled. squeue works on all of them.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

from hydra.core.utils import JobReturn, JobStatus
from omegaconf import DictConfig
from submitit.core.utils import FailedJobError, FailedSubmissionError, UncompletedJobError
from submitit.slurm import slurm

from rbfevo.commands import jobs, parsers
from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.runs.interruption import WARNING

LOOK = 15  # seconds between two questions about the queue, at most
LATE = 15  # seconds that a file may take from one machine to another
GONE = "GONE"  # the state of a job that SLURM has forgotten
REASONS = {
    "CANCELLED": "was cancelled",
    "OUT_OF_MEMORY": "was killed for memory",
    "TIMEOUT": "reached its time limit",
    "NODE_FAIL": "lost its node",
    "PREEMPTED": "was preempted",
    "BOOT_FAIL": "found no node that started",
    "DEADLINE": "reached its deadline",
    "FAILED": "failed",
    "COMPLETED": "ended without a result",
    GONE: "is no longer known",
}  # of all states in which a job has ended
_OF_SLURM = re.compile(r"^(?:slurmstepd|srun)\S*: error: (.+)$", re.MULTILINE)
_MEMORY = re.compile(r"memory|oom", re.IGNORECASE)


class Queue(slurm.SlurmInfoWatcher):
    """The states of jobs, from squeue."""

    def __init__(self) -> None:
        super().__init__(delay_s=LOOK)
        self._missed: dict[str, int] = {}

    def update(self) -> None:
        """Ask for the states of all jobs; where SLURM does not answer, they stay as they were."""
        self._last_status_check = time.time()
        try:
            found = states()
        except UserError:
            return
        for job in self._registered:
            if job in found:
                self._info_dict[job] = {"State": found[job]}
            elif self._info_dict.get(job, {}).get("State") not in REASONS:
                self._missed[job] = self._missed.get(job, 0) + 1
                if self._missed[job] > 1:
                    self._info_dict[job] = {"State": GONE}

    def is_done(self, job_id: str, mode: str = "standard") -> bool:
        """Whether a job has ended, and will not be started again."""
        return self.get_state(job_id, mode) in REASONS


class Job(slurm.SlurmJob[Any]):
    """A job that ends, but never fails: what there is to say about it is in its outcome."""

    watcher: ClassVar[Queue] = Queue()

    def results(self) -> list[Any]:
        """Wait until the job has ended."""
        self.wait()
        return [JobReturn(_return_value=None, status=JobStatus.COMPLETED)]


def states() -> dict[str, str]:
    """The states of all jobs of this user that SLURM knows, by their ids, such as 12 or 12_3.

    Raises:
        UserError: if SLURM does not answer.
    """
    command = ["squeue", "--noheader", "--array", "--states=all", f"--user={os.getuid()}", "--format=%i %T"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    except subprocess.CalledProcessError as error:
        raise UserError(f"SLURM does not answer: {' '.join(str(error.stderr).split())}") from None
    except (OSError, subprocess.SubprocessError) as error:
        raise UserError(f"SLURM does not answer: {error}") from None
    return dict(line.split() for line in done.stdout.splitlines() if len(line.split()) == 2)


def refuse(launcher: DictConfig, sweep: Path) -> None:
    """Raise UserError where a sweep cannot be started on SLURM, or has been and still has jobs there."""
    if shutil.which("srun") is None:
        raise UserError("hydra/launcher=submitit_slurm: there is no srun here; start the sweep where SLURM is")
    for key in ("nodes", "tasks_per_node"):
        if (launcher.get(key) or 1) != 1:
            raise UserError(f"hydra.launcher.{key}={launcher.get(key)}: a job is one process, choose 1")
    found = [path for path in sweep.glob(f"{jobs.STATUS}/*/{jobs.QUEUED}") if path.parent != jobs.place()]
    ids = {job for path in found for job in json.loads(path.read_text())}
    if not ids:
        return
    waiting = [job for job, state in states().items() if job.partition("_")[0] in ids and state not in REASONS]
    if waiting:
        raise UserError(
            f"{len(waiting)} jobs of an earlier start of this sweep are still in SLURM's queue: wait for them, or end "
            f"them with scancel {' '.join(sorted(ids))}"
        )
    for path in found:
        path.unlink()


@contextlib.contextmanager
def watched(launcher: DictConfig, job_overrides: Sequence[Sequence[str]], numbers: Sequence[int]) -> Iterator[None]:
    """Let submitit wait for all jobs that it submits meanwhile; then save the outcomes of those that could not.

    Args:
        launcher: Hydra's configuration of it; job_overrides, numbers: of the jobs, in the order of SLURM's array.

    Raises:
        UserError: if SLURM refuses the jobs.
    """
    submitted: list[Job] = []
    queued = jobs.place() / jobs.QUEUED

    class Submitted(Job):
        def __init__(self, *arguments: Any, **keywords: Any) -> None:
            super().__init__(*arguments, **keywords)
            submitted.append(self)
            if len(submitted) == 1:  # the array, or the only job; those of the array follow
                write_whole(queued, json.dumps([self.job_id]).encode())

    if launcher.get("cpus_per_task"):  # which srun does not take from its sbatch
        os.environ["SRUN_CPUS_PER_TASK"] = str(launcher.cpus_per_task)
    before = slurm.SlurmJob
    setattr(slurm, "SlurmJob", Submitted)  # noqa: B010 - of an array
    setattr(slurm.SlurmExecutor, "job_class", Submitted)  # noqa: B010 - of a single job
    try:
        yield
    except KeyboardInterrupt:
        if submitted:
            parsers.complain("rbfevo", f"the jobs go on in SLURM; scancel {submitted[0].job_id} ends them")
        raise
    except (FailedJobError, FailedSubmissionError) as error:
        raise UserError(f"SLURM has refused the jobs: {error}") from None
    finally:
        setattr(slurm, "SlurmJob", before)  # noqa: B010
        setattr(slurm.SlurmExecutor, "job_class", before)  # noqa: B010
    _settle(submitted[-len(numbers) :], job_overrides, numbers)
    queued.unlink()


def _settle(submitted: Sequence[Job], job_overrides: Sequence[Sequence[str]], numbers: Sequence[int]) -> None:
    """Save an outcome for each job that has ended without saving one."""

    def saved() -> dict[int, jobs.Outcome]:
        return {outcome.number: outcome for outcome in jobs.outcomes(jobs.place())}

    ended, found = time.monotonic(), saved()
    for job, overrides, number in zip(submitted, job_overrides, numbers, strict=True):
        outcome = found.get(number, jobs.Outcome(number, list(overrides), str(number), "", None))
        done = job.state == "COMPLETED" or job.paths.result_pickle.exists()
        while outcome.code is None and done and time.monotonic() - ended < LATE:
            time.sleep(1)
            outcome = saved().get(number, outcome)
        if outcome.code is None:
            jobs.save(outcome._replace(code=1, message=_reason(job)))


def _reason(job: Job) -> str:
    """Why a job has no result, in one line."""
    log = Path(job.paths.stderr)
    try:
        text = log.read_text(errors="replace")
    except OSError:  # of an array's job that is cancelled before it begins SLURM keeps nothing
        why = f"{REASONS['CANCELLED']} before it began" if job.state in ("CANCELLED", GONE) else REASONS[job.state]
        return f"SLURM's job {job.job_id} {why}"
    found = _OF_SLURM.findall(text)
    memory = [line for line in found if _MEMORY.search(line)]
    state = "OUT_OF_MEMORY" if memory else job.state
    lines = memory[:1] or found[-1:] or text.strip().splitlines()[-1:]
    return f"SLURM's job {job.job_id} {REASONS[state]}: {''.join(lines)[:200]} (log: {log})"


# --- within a job ----------------------------------------------------------------------------------------------------


def stopped(code: int) -> str:
    """What to say about a job that a signal has stopped; it does not return if the job goes into the queue again."""
    kept = "its results so far are saved"
    if WARNING is not None and code == 128 + WARNING:
        try:
            signal.raise_signal(WARNING)  # submitit puts the job into the queue again, and ends this process
        except UncompletedJobError:
            return f"it reached its time limit, {kept}; hydra.launcher.max_num_timeout=9 would let it go on nine times"
    if _preempted():  # the time of grace is not over: now that the process ends, SLURM would not start it again
        subprocess.run(["scontrol", "requeue", os.environ["SLURM_JOB_ID"]], timeout=60, check=False)
        sys.exit(code)
    return f"{signal.Signals(code - 128).name} stopped it, by scancel or at its time limit; {kept}"


def _preempted() -> bool:
    """Whether SLURM has preempted this job and not cancelled it."""
    command = ["scontrol", "--oneliner", "show", "job", os.environ.get("SLURM_JOB_ID", "")]
    try:
        shown = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return False
    return "JobState=RUNNING" in shown and re.search(r"PreemptTime=\d", shown) is not None
