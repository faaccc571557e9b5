"""From the arguments of the command line to one run, or the jobs of a sweep, and an exit code."""

from __future__ import annotations

import contextlib
import sys
import uuid
from collections.abc import Sequence
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
    setup_globals()  # Hydra's resolvers, which an argument may name
    OmegaConf.register_new_resolver("unique", lambda: uuid.uuid4().hex[:6], use_cache=True, replace=True)
    given = names.quoted(sys.argv[1:] if arguments is None else arguments, ROOTS)
    try:
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
    except (hydra.errors.HydraException, OmegaConfBaseException, OSError) as error:
        raise UserError(overrides.explain(error, given, CONF)) from None
