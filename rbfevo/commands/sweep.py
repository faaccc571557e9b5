"""A sweep: its jobs, each in a directory of its own, and its exit code."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import uuid
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import hydra.errors
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from rbfevo import names
from rbfevo.commands import gpus, jobs, parsers
from rbfevo.commands.composition import Composition, start, write_hydra
from rbfevo.commands.launching import JOBLIB, SLURM, remaining
from rbfevo.commands.leader import Leader
from rbfevo.commands.single import announce, guarded, locked, tidy
from rbfevo.errors import UserError
from rbfevo.runs.config import RunConfig, check_top

SKIPPED = -1
LONGEST = 3600  # seconds that a sweep is collected: each nested sequence may take two minutes


def job(config: DictConfig) -> None:
    """One job of a sweep: never raises, so that one failed job does not end the others; its outcome is saved."""
    parsers.steady_streams()  # those of a launcher's process
    current, composition = HydraConfig.get(), Composition.current()
    launcher = str(current.launcher.get("_target_", "")).rpartition(".")[2]
    worker = launcher == JOBLIB and not jobs.leads()
    if worker:
        jobs.hear_no_signals()
    sweep = Path(composition.cwd, current.sweep.dir)
    outcome = jobs.Outcome(
        int(current.job.num), composition.overrides, composition.directory.name, str(sweep), None, process=os.getpid()
    )
    jobs.save(outcome)
    if jobs.stopping():  # asked after that, so that whoever stops the sweep sees this job
        jobs.forget(outcome)
        with contextlib.suppress(OSError):
            composition.directory.rmdir()
        _leave_if_orphaned()
        return

    def work() -> int:
        """Check the settings and carry them out; return the exit code, or SKIPPED."""
        nonlocal outcome
        top = check_top(config)
        outcome = outcome._replace(figures=top.figures, quiet=top.quiet)
        return _carry_out_job(config, top, composition, sweep)

    code, message = guarded(work)
    left = None
    if code > 128 and (launcher == SLURM or code not in jobs.STOPPED):
        from rbfevo.commands import slurm

        message, left, code = slurm.stopped(code), code, 1
    skipped = code == SKIPPED
    jobs.save(outcome._replace(code=0 if skipped else code, message=message, skipped=skipped))
    if message:
        parsers.complain("rbfevo", f"{outcome.directory}: {message}")
    _leave_if_orphaned()
    if left is not None:
        sys.exit(left)  # submitit saves no result, for SLURM may start the job again
    if code in jobs.STOPPED and worker:
        (jobs.place() / jobs.STOP).touch()
    elif code in jobs.STOPPED:
        raise KeyboardInterrupt  # whoever interrupts a sweep means all of it


def _leave_if_orphaned() -> None:
    """End this process of joblib's where nobody is left whom it could tell."""
    if jobs.orphaned():
        os._exit(1)


def _carry_out_job(config: DictConfig, top: RunConfig, composition: Composition, sweep: Path) -> int:
    """Carry out a job where it has worked before, or in a place of its own; an exit code, or SKIPPED."""
    announce(top, composition)

    current = HydraConfig.get()
    target = str(current.launcher.get("_target_", ""))
    if target.endswith(JOBLIB):
        gpus.take(jobs.place())
    elif "submitit" in target:
        gpus.choose(int(current.job.num))

    import torch

    from rbfevo.runs.config import check
    from rbfevo.runs.identity import identity
    from rbfevo.runs.run import carry_out

    share = jobs.threads(current.launcher)
    if share is not None:
        torch.set_num_threads(share)
    settings, numbered = check(config, composition.overrides), composition.directory
    directory, how = jobs.place_of(sweep, numbered, identity(settings, whole=True))
    try:
        if how == "done":
            print(f"{directory.name}: done already ({' '.join(composition.overrides)})", flush=True)
            return SKIPPED
        return locked(
            directory,
            lambda: carry_out(settings, directory, composition.overrides, how == "resume", jobs.stopping),
            lambda: write_hydra(config, directory) if how == "new" else None,
        )
    finally:
        if numbered != directory:
            with contextlib.suppress(OSError):
                numbered.rmdir()  # Hydra made it; it is empty unless another job works there


def carry_out_sweep(arguments: list[str]) -> int:
    """Carry out a sweep; its exit code is the worst of its jobs'.

    Raises:
        UserError: for a user's mistake before any job began.
    """
    given = any(argument.partition("=")[0].lstrip("+") == "hydra.sweep.dir" for argument in arguments)
    literal, now = names.given(arguments, "hydra.sweep.dir"), datetime.now()
    sweep = Path(f"outputs/{now:%Y-%m-%d}/{now:%H-%M-%S-%f}-{uuid.uuid4().hex[:6]}")
    if not given:
        arguments = [*arguments, names.override("hydra.sweep.dir", sweep)]
    elif literal:
        sweep = Path(literal[-1])
    else:  # what Hydra has to work out; the outcomes hold it
        elsewhere = any("submitit" in argument for argument in arguments)  # jobs on other machines see this one
        sweep = Path(tempfile.mkdtemp(prefix=".rbfevo-", dir=Path.cwd() if elsewhere else None))
    place = jobs.begin(sweep)
    interrupted, broken = False, ""
    with Leader(place) as leader:
        try:
            with remaining():
                start(job, arguments)
        except KeyboardInterrupt:
            interrupted = True
        except (UserError, hydra.errors.HydraException, OmegaConfBaseException, OSError) as error:
            if isinstance(error, UserError) or not jobs.outcomes(place):
                jobs.end(sweep)
                tidy(sweep)
                raise
            broken = "the launcher broke down"
        except Exception as error:  # a worker of the launcher's that died
            broken = " ".join(f"{type(error).__name__}: {error}".split())[:300]
    queued = (place / jobs.QUEUED).exists()
    found = [outcome for outcome in jobs.outcomes(place) if outcome.code is not None or not queued]
    jobs.end(sweep)
    if given and not literal and not queued:
        shutil.rmtree(sweep, ignore_errors=True)
    for line in [*([f"rbfevo: {broken}"] if broken else []), *jobs.summary(found)]:
        print(line, file=sys.stderr, flush=True)
    codes = [1 if outcome.code is None else outcome.code for outcome in found]
    stops = [code for code in codes if code in jobs.STOPPED]
    if stops or interrupted:
        return leader.code or (stops[0] if stops else 130)
    done = [outcome for outcome in found if outcome.code == 0]
    if any(outcome.figures for outcome in done):
        with leader:
            try:
                collect(Path(found[0].sweep), all(outcome.quiet for outcome in done))
            except KeyboardInterrupt:
                parsers.complain("rbfevo", f"interrupted; python -m rbfevo.collect {found[0].sweep} makes its page")
                return leader.code or 130
    return max([*codes, int(bool(broken))], default=0)


def collect(directory: Path, quiet: bool) -> None:
    """Make the tables and the page of a sweep, in a process of its own; what goes wrong there is one line."""
    command = [sys.executable, "-m", "rbfevo.collect", str(directory)]
    late = threading.Event()
    try:
        with (
            tempfile.TemporaryFile("w+") as complaints,
            subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=complaints, text=True
            ) as process,
            _ended(process, late),
        ):
            for line in process.stdout or ():  # a nested sequence may take minutes: its line comes before
                print("" if quiet else line, end="", flush=True)
            code = process.wait()
            complaints.seek(0)
            error = complaints.read()
    except OSError as error:
        parsers.complain("rbfevo", f"the sweep was not collected: {error}")
        return
    if late.is_set():
        parsers.complain("rbfevo", f"the sweep was not collected: it was not done after {LONGEST} s")
    print(error if code in (0, 2) else error[-500:], end="", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _ended(process: subprocess.Popen[str], late: threading.Event) -> Iterator[None]:
    """End a process after `LONGEST` seconds, and where this one is interrupted."""

    def end() -> None:
        late.set()
        process.kill()

    timer = threading.Timer(LONGEST, end)
    timer.daemon = True
    timer.start()
    try:
        yield
    except BaseException:
        process.kill()
        raise
    finally:
        timer.cancel()
