"""A laminar S-bend, half of it: less loss of total pressure by another bend. `python examples/openfoam/duct.py OUT`."""

from __future__ import annotations

import sys

import channel
import steps

BEND, RISE = 3.0, 1.5
HALF_WIDTH, HEIGHT = 0.5, 1.0
# python -m rbfevo.advise scenario=mesh scenario.template=outputs/duct/case 'scenario.patches=[bend]' \
#   'scenario.hold=[walls]' hydra.run.dir=outputs/duct/advice
# recommended (gain 0.941, in 3 minutes) the settings from manipulation on, before any step was tried:
SETTINGS = (
    *("scenario.patches=[bend]", "scenario.hold=[walls]", "manipulation=direct", "kernel=wendland"),
    *("kernel.support=2.911", "centers=6", "scenario.smooth=0.1332", "criterion.norm=16", "method=gradient"),
)


def section(x: float) -> channel.Section:
    """Half a rectangle, which the bend lifts by RISE."""
    floor = RISE * channel.ramp(x / BEND)
    return channel.Section(floor, floor + HEIGHT, HALF_WIDTH)


DUCT = channel.Channel((1.0, BEND, 3.0), section, ((10, 40, 26), 8, 16), "bend")
EXAMPLE = steps.Example("duct", DUCT.files, (("blockMesh",),), "losseslosses", SETTINGS, 0.005)

if __name__ == "__main__":
    sys.exit(steps.main(EXAMPLE))
