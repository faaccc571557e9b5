"""A laminar diffuser, half of it: less loss of total pressure. `python examples/openfoam/diffuser.py OUT`."""

from __future__ import annotations

import sys

import channel
import steps

LENGTH = 2.0
NARROW, WIDE = (0.5, 1.0), (0.65, 1.8)  # half the width, and the height, before and after
# python -m rbfevo.advise scenario=mesh scenario.template=outputs/diffuser/case 'scenario.patches=[diffuser]' \
#   'scenario.hold=[walls]' hydra.run.dir=outputs/diffuser/advice
# recommended (gain 0.866, in 3 minutes) the settings from manipulation on, before any step was tried:
SETTINGS = (
    *("scenario.patches=[diffuser]", "scenario.hold=[walls]", "manipulation=direct", "kernel=wendland"),
    *("kernel.support=2.06", "centers=5", "scenario.smooth=0.1311", "criterion.norm=16", "method=gradient"),
)


def section(x: float) -> channel.Section:
    """The ceiling rises and the sides open; the floor stays."""
    (narrow, low), (wide, high) = NARROW, WIDE
    t = channel.ramp(x / LENGTH)
    return channel.Section(0.0, low + t * (high - low), narrow + t * (wide - narrow))


DIFFUSER = channel.Channel((1.0, LENGTH, 5.0), section, ((10, 30, 40), 8, 16), "diffuser")
EXAMPLE = steps.Example("diffuser", DIFFUSER.files, (("blockMesh",),), "losseslosses", SETTINGS, 0.005)

if __name__ == "__main__":
    sys.exit(steps.main(EXAMPLE))
