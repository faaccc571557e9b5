"""`python -m rbfevo`: configuration in, run directory out."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import traceback
import uuid
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path

# Hydra prints several lines and exits with 1 for its own errors unless it is told to raise them.
os.environ["HYDRA_FULL_ERROR"] = "1"

import hydra
import hydra.errors
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rbfevo import jobs, lock, overrides, resume
from rbfevo.errors import UserError
from rbfevo.files import write_whole

CONF = next(path for path in (Path(__file__).parent / "conf", Path(__file__).parents[1] / "conf") if path.is_dir())
HYDRA = ".hydra"
STOPPED = (130, 143)


def job(config: DictConfig) -> None:
    """One job of a sweep: never raises, so that one failed job does not end the others; tells what became of it."""
    said = HydraConfig.get()
    sweep = Path(said.runtime.cwd, said.sweep.dir)
    outcome = jobs.Outcome(int(said.job.num), list(said.overrides.task), Path(said.runtime.output_dir).name, None)
    jobs.tell(sweep, outcome)
    code, message = _guarded(lambda: _swept(config, sweep))
    skipped = code == SKIPPED
    jobs.tell(sweep, outcome._replace(code=0 if skipped else code, message=message, skipped=skipped))
    if message:
        print(f"rbfevo: {outcome.directory}: {message}", file=sys.stderr)
    if code in STOPPED:
        raise KeyboardInterrupt  # whoever interrupts a sweep means all of it


SKIPPED = -1


def _swept(config: DictConfig, sweep: Path) -> int:
    """Carry out a job where it has worked before, or in a place of its own; an exit code, or SKIPPED."""
    import torch

    from rbfevo.config import check
    from rbfevo.run import carry_out, identity

    said = HydraConfig.get()
    share = jobs.threads(said.launcher)
    if share is not None:
        torch.set_num_threads(share)
    if torch.cuda.is_available() and torch.cuda.device_count() > 1:
        torch.cuda.set_device(int(said.job.num) % torch.cuda.device_count())
    settings, numbered = check(config), Path(said.runtime.output_dir)
    directory, how = jobs.place_of(sweep, numbered, identity(settings, whole=True))
    try:
        if how == "done":
            print(f"{directory.name}: done already ({' '.join(said.overrides.task)})", flush=True)
            return SKIPPED
        with lock.locked(directory):
            if how == "new":
                _write_hydra(config, directory)
            return _carried_out(
                lambda: carry_out(settings, directory, list(said.overrides.task), how == "resume"), directory
            )
    finally:
        if numbered != directory:
            with contextlib.suppress(OSError):
                numbered.rmdir()  # Hydra made it; it is empty unless another job works there


def single(config: DictConfig, resumed: bool) -> int:
    """One run that is no part of a sweep; its exit code."""
    said = HydraConfig.get()
    directory, words = Path(said.runtime.output_dir), list(said.overrides.task)

    def work() -> int:
        from rbfevo.config import check
        from rbfevo.run import carry_out

        settings = check(config)
        code = carry_out(settings, directory, words, resumed)
        if resumed:  # with what has changed on the way
            _write_hydra(config, directory, only=("config.yaml", "overrides.yaml"))
        return code

    code, message = _guarded(work)
    if code == 2:
        _tidy(directory)
    if message:
        print(f"rbfevo: {message}", file=sys.stderr)
    return code


def _carried_out(work: Callable[[], int], directory: Path) -> int:
    try:
        return work()
    except UserError:
        _tidy(directory)
        raise


def _guarded(work: Callable[[], int]) -> tuple[int, str]:
    """The exit code of `work` and one line for what went wrong."""
    try:
        return work(), ""
    except UserError as error:
        return 2, " ".join(str(error).split())
    except KeyboardInterrupt:
        return 130, "interrupted"
    except Exception as error:
        traceback.print_exc()
        return 1, " ".join(f"{type(error).__name__}: {error}".split())


def _tidy(directory: Path) -> None:
    """Remove a directory in which nothing is but what came before the run: a mistake leaves none behind."""
    with contextlib.suppress(OSError):
        if {path.name for path in directory.iterdir()} <= {HYDRA, lock.NAME}:
            shutil.rmtree(directory, ignore_errors=True)


def _write_hydra(
    config: DictConfig, directory: Path, only: Sequence[str] = ("config.yaml", "hydra.yaml", "overrides.yaml")
) -> None:
    """Write `.hydra/` as Hydra does, each file whole."""
    said = HydraConfig.get()
    contents = {
        "config.yaml": OmegaConf.to_yaml(config),
        "hydra.yaml": OmegaConf.to_yaml(OmegaConf.create({"hydra": OmegaConf.to_container(said, resolve=False)})),
        "overrides.yaml": OmegaConf.to_yaml(said.overrides.task),
    }
    try:
        (directory / HYDRA).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{directory} cannot be written: {error.strerror or error}") from None
    for name in only:
        write_whole(directory / HYDRA / name, contents[name].encode())


def collected(directory: Path, quiet: bool) -> None:
    """Make the tables and the page of a sweep, in a process of its own; what goes wrong there is one line."""
    try:
        command = [sys.executable, "-m", "rbfevo.collect", str(directory)]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=600)
    except (OSError, subprocess.SubprocessError) as error:
        print(f"rbfevo: the sweep was not collected: {' '.join(str(error).split())}", file=sys.stderr)
        return
    print("" if quiet else done.stdout, end="", flush=True)
    print(done.stderr if done.returncode in (0, 2) else done.stderr[-500:], end="", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 for a user's mistake, 130, 143, or 1."""
    words = overrides.quoted(sys.argv[1:] if arguments is None else arguments)
    OmegaConf.register_new_resolver("unique", lambda: uuid.uuid4().hex[:6], use_cache=True, replace=True)
    try:
        run, others = resume.split(words)
        overrides.look_over(others)
        with _held(others if run is None else [f"hydra.run.dir={run}"]):
            if any(word in ("-m", "--multirun") for word in words):
                return _sweep(others)
            if run is not None:
                others = [*resume.recorded(run, others), *overrides.quoted([f"hydra.run.dir={run}"])]
                others.append("hydra.output_subdir=null")
            code = 0  # of an option that shows something, such as --help

            def task(config: DictConfig) -> None:
                nonlocal code
                code = single(config, run is not None)

            _hydra(task, others)
            return code
    except KeyboardInterrupt:
        return 130
    except UserError as error:
        print(f"rbfevo: {error}", file=sys.stderr)
    except (hydra.errors.HydraException, OmegaConfBaseException, OSError) as error:
        print(f"rbfevo: {overrides.explain(error, words, CONF)}", file=sys.stderr)
    return 2


def _hydra(task: Callable[[DictConfig], None], words: Sequence[str]) -> None:
    sys.argv = ["rbfevo", *words]
    hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(task)()


@contextlib.contextmanager
def _held(words: Sequence[str]) -> Iterator[None]:
    """Hold the lock of the run or sweep directory that a word names, before Hydra writes anything there."""
    named = [
        word.partition("=")[2].strip("'\"") for word in words if word.startswith(("hydra.run.dir=", "hydra.sweep.dir="))
    ]
    named = [value for value in named if "${" not in value]
    with contextlib.ExitStack() as stack:
        for value in named:
            stack.enter_context(lock.locked(Path(value)))
            stack.callback(_tidy, Path(value))  # before the lock is let go of
        yield


def _sweep(words: list[str]) -> int:
    """Carry out a sweep; its exit code is the worst of its jobs'."""
    given = [word.partition("=")[2].strip("'\"") for word in words if word.startswith("hydra.sweep.dir=")]
    now = datetime.now()
    sweep = Path(given[-1]) if given else Path(f"outputs/{now:%Y-%m-%d}/{now:%H-%M-%S-%f}-{uuid.uuid4().hex[:6]}")
    if not given:
        words = [*words, *overrides.quoted([f"hydra.sweep.dir={sweep}"])]
    place = jobs.begin(sweep)
    interrupted, broken = False, ""
    try:
        _hydra(job, [*words, "hydra.output_subdir=null"])
    except KeyboardInterrupt:
        interrupted = True
    except (UserError, hydra.errors.HydraException, OmegaConfBaseException, OSError):
        if not jobs.outcomes(place):
            shutil.rmtree(sweep / jobs.STATUS, ignore_errors=True)
            _tidy(sweep)
            raise
        broken = "the launcher broke down"
    except Exception as error:  # a worker of the launcher's that died
        broken = " ".join(f"{type(error).__name__}: {error}".split())[:300]
    found = jobs.outcomes(place)
    shutil.rmtree(sweep / jobs.STATUS, ignore_errors=True)
    for line in [*([f"rbfevo: {broken}"] if broken else []), *jobs.summary(found)]:
        print(line, file=sys.stderr, flush=True)
    codes = [1 if outcome.code is None else outcome.code for outcome in found]
    stops = [code for code in codes if code in STOPPED]
    if stops or interrupted:
        return stops[0] if stops else 130
    if 0 in codes and "figures=false" not in words:
        collected(sweep, "quiet=true" in words)
    return max([*codes, int(bool(broken))], default=0)


if __name__ == "__main__":
    sys.exit(main())
