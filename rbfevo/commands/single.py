"""One run in one directory: its first line, its lock, its exit code, and nothing left behind after a mistake."""

from __future__ import annotations

import contextlib
import shutil
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from omegaconf import DictConfig

from rbfevo import names
from rbfevo.commands import parsers
from rbfevo.commands.composition import HYDRA, Composition, write_hydra
from rbfevo.errors import UserError
from rbfevo.files import refuse_missing
from rbfevo.runs import lock
from rbfevo.runs.config import RunConfig, check_top
from rbfevo.runs.directory import refuse_results


def single(config: DictConfig, resumed: bool) -> int:
    """Carry out one run that is no part of a sweep; return its exit code."""
    composition = Composition.current()
    directory, arguments = composition.directory, composition.overrides

    def work() -> int:
        """Check the settings and carry out the run; return its exit code."""
        announce(check_top(config), composition)

        from rbfevo.runs.assembly import unused_preferences
        from rbfevo.runs.config import check
        from rbfevo.runs.run import carry_out

        settings = check(config, arguments)
        if resumed:
            code = carry_out(settings, directory, arguments, resumed)
            write_hydra(config, directory, only=("config.yaml", "overrides.yaml"))  # with what has changed on the way
            return code

        for unused in unused_preferences(settings):  # in a sweep over methods it is a warning
            raise UserError(unused)

        def before() -> None:
            refuse_results(directory)
            write_hydra(config, directory)

        return locked(directory, lambda: carry_out(settings, directory, arguments), before)

    code, message = guarded(work)
    if message:
        parsers.complain("rbfevo", message)
    if code == 2 and not resumed:
        with contextlib.suppress(OSError):
            directory.rmdir()  # Hydra may have made it; it goes only if it is empty
    return code


def announce(top: RunConfig, composition: Composition) -> None:
    """Print the first line of a run, before all that takes a while is imported.

    Raises:
        UserError: if a file of the scenario or the method is missing, which is the most usual mistake.
    """
    for key in names.FILES:
        if isinstance(path := top.scenario.get(key), str):
            refuse_missing(names.existing_home(path))
    given = top.method.get("centers") if isinstance(top.method, dict) else None
    files = [given] if isinstance(given, str) else given if isinstance(given, list) else []
    for path in files:
        if isinstance(path, str):
            refuse_missing(names.existing_home(path))
    if top.quiet:
        return
    groups = ["scenario", "kernel", "manipulation", "method"]
    if composition.choices.get("representation") not in (None, "rbf"):
        groups[1] = "representation"
    chosen = [f"{group} {composition.choices.get(group)}" for group in groups]
    lattice = top.representation.get("lattice") if isinstance(top.representation, dict) else None
    centers = f"{top.centers} centers"
    if files:
        centers = f"centers of {', '.join(map(str, files))}"
    elif isinstance(lattice, list):
        centers = f"lattice {' x '.join(map(str, lattice))}"
    print(f"{', '.join(chosen)}, {centers}, seed {top.seed}: {composition.directory}", flush=True)


def locked(directory: Path, work: Callable[[], int], before: Callable[[], object]) -> int:
    """Do some work in a directory that no other process works in; a mistake leaves no new directory behind."""
    with lock.locked(directory):
        try:
            before()
            return work()
        except UserError:
            tidy(directory)
            raise


@contextlib.contextmanager
def held(arguments: Sequence[str]) -> Iterator[None]:
    """Hold the lock of the run or sweep directory that an argument names, before Hydra writes anything there."""
    directories = [name for key in names.DIRECTORIES for name in names.given(arguments, key)]
    with contextlib.ExitStack() as stack:
        for name in directories:
            stack.enter_context(lock.locked(Path(name)))
            stack.callback(tidy, Path(name))  # before the lock is released
        yield


def guarded(work: Callable[[], int]) -> tuple[int, str]:
    """Return the exit code of `work` and one line that states what went wrong."""
    try:
        return work(), ""
    except UserError as error:
        return 2, " ".join(str(error).split())
    except KeyboardInterrupt:
        return 130, "interrupted"
    except Exception as error:
        traceback.print_exc()
        return 1, " ".join(f"{type(error).__name__}: {error}".split())


def tidy(directory: Path) -> None:
    """Remove a directory that holds nothing but what is written before a run: a mistake leaves none behind."""
    with contextlib.suppress(OSError):
        if {path.name for path in directory.iterdir()} <= {HYDRA, lock.NAME}:
            shutil.rmtree(directory, ignore_errors=True)
