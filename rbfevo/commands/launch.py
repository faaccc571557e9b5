"""From the arguments of the command line to one run, or the jobs of a sweep, and an exit code."""

from __future__ import annotations

import contextlib
import sys
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra.errors
from hydra.core.utils import setup_globals
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rbfevo import names
from rbfevo.commands import composition, overrides, resume, usage
from rbfevo.commands.single import held, single
from rbfevo.commands.sweep import carry_out_sweep
from rbfevo.errors import UserError
from rbfevo.runs import lock
from rbfevo.runs.config import CONF, ROOTS


def launch(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line and return its exit code.

    Raises:
        UserError: for a user's mistake.
    """
    given = prepared(arguments)
    with explained(given):
        if any(argument in ("-h", "--help") for argument in given):
            print(usage.text(given, CONF), flush=True)
            return 0
        run, others = resume.split(given)
        overrides.look_over(others, CONF)
        with lock.locked(run) if run is not None else held(others):
            if names.is_sweep(given):
                return carry_out_sweep(others)
            others = others if run is None else resume.recorded(run, others)
            code = 0  # of an option that shows something, such as --cfg

            def task(config: DictConfig) -> None:
                nonlocal code
                code = single(config, run is not None)

            with contextlib.chdir(Path.cwd() if run is None else resume.began_in(run)):
                composition.start(task, others)
            return code


def prepared(arguments: Sequence[str] | None) -> list[str]:
    """The arguments as Hydra reads them, with the resolvers registered that they may name."""
    setup_globals()  # Hydra's resolvers
    OmegaConf.register_new_resolver("unique", lambda: uuid.uuid4().hex[:6], use_cache=True, replace=True)
    return names.quoted(sys.argv[1:] if arguments is None else arguments, ROOTS)


@contextlib.contextmanager
def explained(given: Sequence[str]) -> Iterator[None]:
    """Turn errors of Hydra and OmegaConf, and of the file system, into one line.

    Raises:
        UserError: that line.
    """
    try:
        yield
    except (hydra.errors.HydraException, OmegaConfBaseException, OSError) as error:
        raise UserError(overrides.explain(error, given, CONF)) from None
