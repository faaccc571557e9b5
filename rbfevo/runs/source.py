"""The settings of a run, from what Hydra left in its directory, and whether its scenario is still the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from rbfevo.errors import UserError
from rbfevo.names import MAYBE_FILES, existing_home, file_and_name, literal
from rbfevo.runs.config import Settings, check
from rbfevo.scenarios.scenario import Scenario

SAME = 1e-9  # how far vertices and gradient may be from those of the files, which another machine may have rounded


def settings_of(run: Path) -> Settings:
    """The checked settings of a run.

    A relative path of a file is looked for here, and then in the directory that the run was started from.

    Raises:
        UserError: if the configuration is missing or wrong.
    """
    config = _load(run / ".hydra" / "config.yaml")
    for name in MAYBE_FILES:
        value = OmegaConf.select(config, f"scenario.{name}")
        places = [value] if isinstance(value, str) else list(value) if isinstance(value, ListConfig) else []
        for index, path in enumerate(places):
            found = _elsewhere(run, path) if isinstance(path, str) else None
            if found is not None and isinstance(value, str):
                config.scenario[name] = found
            elif found is not None:
                config.scenario[name][index] = found
    try:
        return check(config)
    except UserError as error:
        raise UserError(f"{run / '.hydra' / 'config.yaml'} is not the configuration of a run: {error}") from None


def refuse_changed(run: Path, scenario: Scenario, then: Any) -> None:
    """Raise UserError where the scenario is not that of `then`, what the run saved of it as arrays, any more."""
    for name in ("vertices", "faces", "gradient", "weights"):
        now, before = getattr(scenario, name).numpy(), getattr(then, name)
        if now.shape != before.shape or not np.allclose(now, before, rtol=0.0, atol=SAME):
            raise UserError(
                f"{run}: {name} of the scenario changed since this run scored its setups "
                "(was a file of the scenario replaced?); start a new run"
            )


def _elsewhere(run: Path, path: str) -> str | None:
    """A file that is not found from here, but from where the run was started, as it is found then."""
    if existing_home(file_and_name(path)[0]).exists() or not (run / ".hydra" / "hydra.yaml").exists():
        return None
    before = _began_in(run)
    found = before is not None and (before / file_and_name(str(before / path))[0]).exists()
    return literal(str(before / path)) if before is not None and found else None


def _began_in(run: Path) -> Path | None:
    """The directory that a run was started from; Hydra writes it literally, so nothing in it is filled in."""
    runtime = OmegaConf.select(_load(run / ".hydra" / "hydra.yaml"), "hydra.runtime")
    entries = OmegaConf.to_container(runtime, resolve=False) if isinstance(runtime, DictConfig) else {}
    before = entries.get("cwd") if isinstance(entries, dict) else None
    return Path(before) if isinstance(before, str) else None


def _load(path: Path) -> DictConfig:
    try:
        config = OmegaConf.load(path)
    except FileNotFoundError:
        raise UserError(f"{path} is missing: it is needed to build the scenario of this run again") from None
    except (OSError, ValueError, YAMLError, OmegaConfBaseException) as error:
        raise UserError(f"{path} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(config, DictConfig):
        raise UserError(f"{path} cannot be read: it holds no configuration")
    return config
