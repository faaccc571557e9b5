"""The paper's twelve panels: two scenarios, three kernels, two manipulations (figures 3 and 6)."""

from __future__ import annotations

from typing import NamedTuple

import hydra
from hydra.core.global_hydra import GlobalHydra

from rbfevo.errors import UserError
from rbfevo.runs.config import CONF, Settings, check


class Panel(NamedTuple):
    """One panel; `support` is None for the triharmonic kernel."""

    scenario: str
    kernel: str
    support: float | None
    manipulation: str

    @property
    def name(self) -> str:
        """Such as `plane-wendland-0.25-indirect`."""
        kernel = self.kernel if self.support is None else f"{self.kernel}-{self.support:g}"
        return f"{self.scenario}-{kernel}-{self.manipulation}"

    @property
    def overrides(self) -> list[str]:
        """The Hydra overrides that select this panel."""
        overrides = [f"scenario={self.scenario}", f"kernel={self.kernel}", f"manipulation={self.manipulation}"]
        return overrides if self.support is None else [*overrides, f"kernel.support={self.support}"]

    def settings(self, *overrides: str) -> Settings:
        """Checked settings of a run on this panel; `overrides` are further Hydra overrides."""
        GlobalHydra.instance().clear()
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            return check(hydra.compose("config", overrides=[*self.overrides, *overrides]))


SUPPORTS = {"plane": (0.25, 0.5), "face": (0.5, 1.0)}
PANELS = tuple(
    Panel(scenario, kernel, support, manipulation)
    for scenario, supports in SUPPORTS.items()
    for kernel, support in (("wendland", supports[0]), ("wendland", supports[1]), ("triharmonic", None))
    for manipulation in ("indirect", "direct")
)


def chosen(names: list[str]) -> tuple[Panel, ...]:
    """The panels whose names contain one of `names`, in the paper's order; all of them if `names` is empty.

    Raises:
        UserError: if a name matches no panel.
    """
    for name in names:
        if not any(name in panel.name for panel in PANELS):
            raise UserError(f"{name}: no panel has this name; choose from {', '.join(panel.name for panel in PANELS)}")
    return tuple(panel for panel in PANELS if not names or any(name in panel.name for name in names))
