"""Scenario and kernel of a run, built again from the configuration that Hydra left in its directory."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from rbfevo.errors import UserError
from rbfevo.names import MAYBE_FILES, existing_home, file_and_name, literal
from rbfevo.recorded.record import Record
from rbfevo.runs.config import build, check
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.kernels import Kernel

SAME = 1e-9  # how far vertices and gradient may be from those of the files, which another machine may have rounded


class Source(NamedTuple):
    """What a run scored its setups on: the scenario, the kernel, and how the design is manipulated."""

    scenario: Scenario
    kernel: Kernel
    manipulation: str


def rebuild(run: Path, record: Record) -> Source:
    """Build the scenario and kernel of a run again, and check that they agree with its files.

    A relative path of a file is looked for here, and then in the directory that the run was started from.

    Raises:
        UserError: if the configuration is missing or wrong, or the scenario is another one by now.
    """
    if record.genotype is not None:
        raise UserError(f"{run}: only setups of centers (representation=rbf) can be fitted")
    config = _load(run / ".hydra" / "config.yaml")
    for name in MAYBE_FILES:
        value = OmegaConf.select(config, f"scenario.{name}")
        listed = list(value) if name == "sensitivity" and isinstance(value, ListConfig) else [value]
        places = [_elsewhere(run, path) if isinstance(path, str) else None for path in listed]
        for index, place in enumerate(places):
            if place is not None and isinstance(value, str):
                config.scenario[name] = place
            elif place is not None:
                config.scenario[name][index] = place
    try:
        settings = check(config)
    except UserError as error:
        raise UserError(f"{run / '.hydra' / 'config.yaml'} is not the configuration of a run: {error}") from None
    try:
        scenario = build(settings.scenario)
        kernel: Kernel = build(settings.kernel, scenario.vertices.shape[1], scenario.support, scenario.diagonal)
    except (OmegaConfBaseException, HydraException) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{run / '.hydra' / 'config.yaml'} is not the configuration of a run: {reason}") from None
    recorded = {name: record.summary.get(name) for name in ("kernel", "support", "manipulation")}
    found = {"kernel": kernel.name, "support": kernel.support, "manipulation": settings.manipulation}
    for name, value in found.items():
        if recorded[name] != value:
            raise UserError(f"{run}: {name} is {recorded[name]} in summary.json and {value} in .hydra/config.yaml; "
                            "restore the file that was changed")  # fmt: skip
    for name in ("vertices", "faces", "gradient", "weights"):
        now, then = getattr(scenario, name).numpy(), getattr(record, name)
        if now.shape != then.shape or not np.allclose(now, then, rtol=0.0, atol=SAME):
            raise UserError(
                f"{run}: {name} of the scenario changed since this run scored its setups "
                "(was a file of the scenario replaced?); start a new run"
            )
    return Source(scenario, kernel, settings.manipulation)


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
