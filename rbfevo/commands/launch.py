"""From the arguments of the command line to one run, or the jobs of a sweep, and an exit code."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import traceback
import uuid
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, cast

# Hydra prints several lines and exits with 1 for its own errors unless it is told to raise them.
os.environ["HYDRA_FULL_ERROR"] = "1"

import hydra
import hydra.errors
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import setup_globals
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rbfevo import names
from rbfevo.commands import jobs, overrides, parsers, resume, usage
from rbfevo.errors import UserError
from rbfevo.files import refuse_missing, write_whole
from rbfevo.runs import lock
from rbfevo.runs.config import CONF, ROOTS, RunConfig, check_top
from rbfevo.runs.directory import refuse_results

HYDRA = ".hydra"


class Hydras(NamedTuple):
    """A run as Hydra has it: its directory, where Hydra was started, the overrides, and options of groups."""

    directory: Path
    cwd: str
    words: list[str]
    choices: dict[str, Any]

    @staticmethod
    def now() -> Hydras:
        """Of the run that Hydra is at.

        The paths are read as they stand, since Hydra has filled in what there was to be filled in, and has not marked
        what merely looks like it.
        """
        said = HydraConfig.get()
        runtime = cast(dict[str, Any], OmegaConf.to_container(said.runtime, resolve=False))
        words = cast(list[str], OmegaConf.to_container(said.overrides.task, resolve=False))
        of_hydra = cast(list[str], OmegaConf.to_container(said.overrides.hydra, resolve=False))
        # Where options from outside the package are found belongs to a run, for resume=.
        words = [*(word for word in of_hydra if word.startswith("hydra.searchpath=")), *words]
        return Hydras(Path(runtime["output_dir"]), runtime["cwd"], words, runtime["choices"])


def job(config: DictConfig) -> None:
    """One job of a sweep: never raises, so that one failed job does not end the others; its outcome is saved."""
    parsers.steady_streams()  # those of a launcher's process
    said, hydras = HydraConfig.get(), Hydras.now()
    sweep = Path(hydras.cwd, said.sweep.dir)
    outcome = jobs.Outcome(int(said.job.num), hydras.words, hydras.directory.name, str(sweep), None)
    jobs.tell(outcome)

    def work() -> int:
        """Check the settings and carry them out; return the exit code, or SKIPPED."""
        nonlocal outcome
        top = check_top(config)
        outcome = outcome._replace(figures=top.figures, quiet=top.quiet)
        return _swept(config, top, hydras, sweep)

    code, message = _guarded(work)
    skipped = code == SKIPPED
    jobs.tell(outcome._replace(code=0 if skipped else code, message=message, skipped=skipped))
    if message:
        parsers.complain("rbfevo", f"{outcome.directory}: {message}")
    if code in jobs.STOPPED:
        raise KeyboardInterrupt  # whoever interrupts a sweep means all of it


SKIPPED = -1


def _swept(config: DictConfig, top: RunConfig, hydras: Hydras, sweep: Path) -> int:
    """Carry out a job where it has worked before, or in a place of its own; an exit code, or SKIPPED."""
    _announce(top, hydras)

    import torch

    from rbfevo.runs.config import check
    from rbfevo.runs.identity import identity
    from rbfevo.runs.run import carry_out

    said = HydraConfig.get()
    share = jobs.threads(said.launcher)
    if share is not None:
        torch.set_num_threads(share)
    if torch.cuda.is_available() and torch.cuda.device_count() > 1:
        torch.cuda.set_device(int(said.job.num) % torch.cuda.device_count())
    settings, numbered = check(config), hydras.directory
    directory, how = jobs.place_of(sweep, numbered, identity(settings, whole=True))
    try:
        if how == "done":
            print(f"{directory.name}: done already ({' '.join(hydras.words)})", flush=True)
            return SKIPPED
        return _locked(
            directory,
            lambda: carry_out(settings, directory, hydras.words, how == "resume"),
            lambda: _write_hydra(config, directory) if how == "new" else None,
        )
    finally:
        if numbered != directory:
            with contextlib.suppress(OSError):
                numbered.rmdir()  # Hydra made it; it is empty unless another job works there


def single(config: DictConfig, resumed: bool) -> int:
    """One run that is no part of a sweep; its exit code."""
    hydras = Hydras.now()
    directory, words = hydras.directory, hydras.words

    def work() -> int:
        """Check the settings and carry out the run; its exit code."""
        _announce(check_top(config), hydras)

        from rbfevo.runs.config import check
        from rbfevo.runs.run import carry_out, unused_preferences

        settings = check(config)
        if resumed:
            code = carry_out(settings, directory, words, resumed)
            _write_hydra(config, directory, only=("config.yaml", "overrides.yaml"))  # with what has changed on the way
            return code

        for unused in unused_preferences(settings):  # in a sweep over methods it is a warning
            raise UserError(unused)

        def before() -> None:
            refuse_results(directory)
            _write_hydra(config, directory)

        return _locked(directory, lambda: carry_out(settings, directory, words), before)

    code, message = _guarded(work)
    if message:
        parsers.complain("rbfevo", message)
    if code == 2 and not resumed:
        with contextlib.suppress(OSError):
            directory.rmdir()  # Hydra may have made it; it goes only if it is empty
    return code


def _announce(top: RunConfig, hydras: Hydras) -> None:
    """The first line of a run, before all that takes a while is imported.

    Raises:
        UserError: if a file of the scenario is not there, which is the most usual mistake.
    """
    for key in names.FILES:
        if isinstance(path := top.scenario.get(key), str):
            refuse_missing(names.existing_home(path))
    if top.quiet:
        return
    groups = ["scenario", "kernel", "manipulation", "method"]
    if hydras.choices.get("representation") not in (None, "rbf"):
        groups[1] = "representation"
    chosen = [f"{group} {hydras.choices.get(group)}" for group in groups]
    print(f"{', '.join(chosen)}, {top.centers} centers, seed {top.seed}: {hydras.directory}", flush=True)


def _locked(directory: Path, work: Callable[[], int], before: Callable[[], object]) -> int:
    """Do some work in a directory that no other process works in; a mistake leaves no new directory behind."""
    with lock.locked(directory):
        try:
            before()
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
        parsers.complain("rbfevo", f"the sweep was not collected: {error}")
        return
    print("" if quiet else done.stdout, end="", flush=True)
    print(done.stderr if done.returncode in (0, 2) else done.stderr[-500:], end="", file=sys.stderr, flush=True)


def launch(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line and return its exit code.

    Raises:
        UserError: for a user's mistake.
    """
    setup_globals()  # Hydra's resolvers, which a word may name
    OmegaConf.register_new_resolver("unique", lambda: uuid.uuid4().hex[:6], use_cache=True, replace=True)
    words = names.quoted(sys.argv[1:] if arguments is None else arguments, ROOTS)
    try:
        if any(word in ("-h", "--help") for word in words):
            print(usage.text(words, CONF), flush=True)
            return 0
        run, others = resume.split(words)
        overrides.look_over(others, CONF)
        with lock.locked(run) if run is not None else _held(others):
            if names.is_sweep(words):
                return _sweep(others)
            others = others if run is None else resume.recorded(run, others)
            code = 0  # of an option that shows something, such as --cfg

            def task(config: DictConfig) -> None:
                nonlocal code
                code = single(config, run is not None)

            with contextlib.chdir(Path.cwd() if run is None else resume.began_in(run)):
                _hydra(task, others)
            return code
    except (hydra.errors.HydraException, OmegaConfBaseException, OSError) as error:
        raise UserError(overrides.explain(error, words, CONF)) from None


def _hydra(task: Callable[[DictConfig], None], words: Sequence[str]) -> None:
    """Let Hydra compose the configuration and start the task, or each job of a sweep with it.

    It writes no `.hydra/` itself: that is written when the lock is held.

    Raises:
        UserError: for an option that Hydra does not have.
    """
    mode, none = "MULTIRUN" if names.is_sweep(words) else "RUN", "hydra.output_subdir=null"
    settings = [word for word in words if word not in names.SWEEP]
    if any(word.startswith("-") or word.partition("=")[0] == "hydra.mode" for word in settings):
        _refuse_options(words)
        sys.argv = ["rbfevo", *words, none]
        hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(task)()
        return
    with overrides.initialized(CONF) as made:
        # Its own command line composes the configuration once more, to look for hydra.mode: a tenth of a second.
        start = made.multirun if mode == "MULTIRUN" else made.run
        start(config_name="config", task_function=task, overrides=[*settings, none, f"hydra.mode={mode}"])


def _refuse_options(words: Sequence[str]) -> None:
    """Raise UserError for what Hydra's own parser would answer with several lines of usage."""
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise UserError(f"{message}; see python -m rbfevo --help, and --hydra-help")

    parser.error = refuse
    parser.parse_args(words)


@contextlib.contextmanager
def _held(words: Sequence[str]) -> Iterator[None]:
    """Hold the lock of the run or sweep directory that an argument names, before Hydra writes anything there."""
    named = [name for key in names.DIRECTORIES for name in names.given(words, key)]
    with contextlib.ExitStack() as stack:
        for name in named:
            stack.enter_context(lock.locked(Path(name)))
            stack.callback(_tidy, Path(name))  # before the lock is let go of
        yield


def _sweep(words: list[str]) -> int:
    """Carry out a sweep; its exit code is the worst of its jobs'."""
    given, now = any(word.partition("=")[0].lstrip("+") == "hydra.sweep.dir" for word in words), datetime.now()
    literal = names.given(words, "hydra.sweep.dir")
    sweep = Path(f"outputs/{now:%Y-%m-%d}/{now:%H-%M-%S-%f}-{uuid.uuid4().hex[:6]}")
    if not given:
        words = [*words, names.word("hydra.sweep.dir", sweep)]
    elif literal:
        sweep = Path(literal[-1])
    else:  # what Hydra has to work out; the outcomes tell
        sweep = Path(tempfile.mkdtemp(prefix="rbfevo-"))
    place = jobs.begin(sweep)
    interrupted, broken = False, ""
    try:
        _hydra(job, words)
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
    if given and not literal:
        shutil.rmtree(sweep, ignore_errors=True)
    for line in [*([f"rbfevo: {broken}"] if broken else []), *jobs.summary(found)]:
        print(line, file=sys.stderr, flush=True)
    codes = [1 if outcome.code is None else outcome.code for outcome in found]
    stops = [code for code in codes if code in jobs.STOPPED]
    if stops or interrupted:
        return stops[0] if stops else 130
    done = [outcome for outcome in found if outcome.code == 0]
    if any(outcome.figures for outcome in done):
        collected(Path(found[0].sweep), all(outcome.quiet for outcome in done))
    return max([*codes, int(bool(broken))], default=0)
