"""Scenario and kernel of a run, built again from the configuration that Hydra left in its directory."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from rbfevo.errors import UserError
from rbfevo.recorded.parts import representation_in
from rbfevo.recorded.record import Record
from rbfevo.runs.config import build
from rbfevo.runs.source import refuse_changed, settings_of
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.representations import RBF, Representation


class Source(NamedTuple):
    """What a run scored its setups on: the scenario, the kernel, and how the design is manipulated.

    Of another representation than RBFs, that takes the place of the kernel.
    """

    scenario: Scenario
    kernel: Kernel | Representation
    manipulation: str


def rebuild(run: Path, record: Record) -> Source:
    """Build the scenario and kernel of a run again, and check that they agree with its files.

    A relative path of a file is looked for here, and then in the directory that the run was started from.

    Raises:
        UserError: if the configuration is missing or wrong, or the scenario is another one by now.
    """
    recorded_as = representation_in(record)
    representation = None if isinstance(recorded_as, RBF) and recorded_as.plain else recorded_as
    if record.genotype is not None and recorded_as.places(record.genotype) is None:
        raise UserError(f"{run}: only setups of centers (representation=rbf), or of a lattice, can be fitted")
    settings = settings_of(run)
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
    refuse_changed(run, scenario, record)
    return Source(scenario, representation or kernel, settings.manipulation)
