"""Hydra: it composes the configuration, starts the run or the jobs of a sweep, and knows where each one works."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, cast

# Hydra prints several lines and exits with 1 for its own errors unless this makes it raise them.
os.environ["HYDRA_FULL_ERROR"] = "1"

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from rbfevo import names
from rbfevo.commands import combinations, overrides
from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.runs.config import CONF

HYDRA = ".hydra"


class Composition(NamedTuple):
    """A run as Hydra has it: its directory, where Hydra was started, its overrides, and the options of groups."""

    directory: Path
    cwd: str
    overrides: list[str]
    choices: dict[str, Any]

    @staticmethod
    def current() -> Composition:
        """Of the run that Hydra is at.

        The paths are read as they stand, since Hydra has filled in what there was to be filled in, and has not marked
        what merely looks like it.
        """
        config = HydraConfig.get()
        runtime = cast(dict[str, Any], OmegaConf.to_container(config.runtime, resolve=False))
        of_task = cast(list[str], OmegaConf.to_container(config.overrides.task, resolve=False))
        of_hydra = cast(list[str], OmegaConf.to_container(config.overrides.hydra, resolve=False))
        # Where options from outside the package are found belongs to a run, for resume=.
        searched = [override for override in of_hydra if override.startswith("hydra.searchpath=")]
        return Composition(Path(runtime["output_dir"]), runtime["cwd"], [*searched, *of_task], runtime["choices"])


def start(task: Callable[[DictConfig], None], arguments: Sequence[str]) -> None:
    """Let Hydra compose the configuration and start the task, or each job of a sweep with it.

    Hydra writes no `.hydra/` itself: `write_hydra` does once the lock is held.

    Raises:
        UserError: for an option that Hydra does not have.
    """
    mode, none = "MULTIRUN" if names.is_sweep(arguments) else "RUN", "hydra.output_subdir=null"
    settings = [argument for argument in arguments if argument not in names.SWEEP]
    if any(setting.startswith("-") or setting.partition("=")[0] == "hydra.mode" for setting in settings):
        _refuse_options(arguments)
        sys.argv = ["rbfevo", *arguments, none]
        hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(task)()
        return
    for_all, held, swept = combinations.held_back(settings, CONF) if mode == "MULTIRUN" else (settings, [], None)
    with overrides.initialized(CONF) as made, combinations.apart(settings, held, swept):
        # Its own command line composes the configuration once more, to look for hydra.mode: a tenth of a second.
        begin = made.multirun if mode == "MULTIRUN" else made.run
        begin(config_name="config", task_function=task, overrides=[*for_all, none, f"hydra.mode={mode}"])


def _refuse_options(arguments: Sequence[str]) -> None:
    """Raise UserError for options at which Hydra's own parser would print several lines of usage."""
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise UserError(f"{message}; see python -m rbfevo --help, and --hydra-help")

    parser.error = refuse
    parser.parse_args(arguments)


def write_hydra(
    config: DictConfig, directory: Path, only: Sequence[str] = ("config.yaml", "hydra.yaml", "overrides.yaml")
) -> None:
    """Write `.hydra/` as Hydra does, each file whole.

    Raises:
        UserError: if it cannot be written.
    """
    current = HydraConfig.get()
    contents = {
        "config.yaml": OmegaConf.to_yaml(config),
        "hydra.yaml": OmegaConf.to_yaml(OmegaConf.create({"hydra": OmegaConf.to_container(current, resolve=False)})),
        "overrides.yaml": OmegaConf.to_yaml(current.overrides.task),
    }
    try:
        (directory / HYDRA).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{directory} cannot be written: {error.strerror or error}") from None
    for name in only:
        write_whole(directory / HYDRA / name, contents[name].encode())
