"""A rounded box in a laminar stream, half of it: less drag by another shape. `python examples/openfoam/body.py OUT`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
import steps

HALF = (0.8, 0.3, 0.25)  # half the length, the width and the height of the body
POWER = 2 / 0.45  # of |x/a|^p + |y/b|^p + |z/c|^p = 1
ROOM = ((-3, 0, -2), (5, 2, 2))  # the block about it; the symmetry plane is y = 0
CELLS = (40, 10, 20)
# python -m rbfevo.advise scenario=mesh scenario.template=outputs/body/case 'scenario.patches=[body]' \
#   hydra.run.dir=outputs/body/advice
# recommended (gain 0.786, in 80 s) the settings from manipulation on, before any step was tried:
SETTINGS = (
    *("scenario.patches=[body]", "manipulation=direct", "kernel=wendland", "kernel.support=1.248", "centers=10"),
    *("scenario.smooth=0.08318", "criterion.norm=16", "method=gradient"),
)


def body() -> pv.PolyData:
    """The closed surface, in triangles: a cube's, drawn in along its rays."""
    surface: Any = pv.Box(bounds=(-1.0, 1.0, -1.0, 1.0, -1.0, 1.0), level=40, quads=False).clean()
    cube = np.asarray(surface.points, np.float64)
    surface.points = np.array(HALF) * cube / (np.abs(cube) ** POWER).sum(axis=1, keepdims=True) ** (1 / POWER)
    return surface


def files(case: Path, scale: float) -> None:
    """Write constant/triSurface/body.stl and system/blockMeshDict."""
    surface = case / "constant" / "triSurface" / "body.stl"
    surface.parent.mkdir()
    body().save(surface)
    print(f"written: {surface}")
    low, high = ROOM
    corners = [(high[0] if k in (1, 2, 5, 6) else low[0], high[1] if k in (2, 3, 6, 7) else low[1]) for k in range(8)]
    vertices = "\n".join(f"    ({x} {y} {(low, high)[k > 3][2]})" for k, (x, y) in enumerate(corners))
    cells = " ".join(str(max(2, round(scale * n))) for n in CELLS)
    steps.write(
        case / "system" / "blockMeshDict",
        f"""scale 1;

vertices
(
{vertices}
);

blocks
(
    hex (0 1 2 3 4 5 6 7) ({cells}) simpleGrading (1 1 1)
);

boundary
(
    inlet {{ type patch; faces ((0 4 7 3)); }}
    outlet {{ type patch; faces ((1 2 6 5)); }}
    symmetry {{ type symmetryPlane; faces ((0 1 5 4)); }}
    far {{ type patch; faces ((3 7 6 2) (0 3 2 1) (4 5 6 7)); }}
);
""",
    )


MESHING = (("blockMesh",), ("snappyHexMesh", "-overwrite"))
EXAMPLE = steps.Example("body", files, MESHING, "dragdrag", SETTINGS, 0.01)

if __name__ == "__main__":
    sys.exit(steps.main(EXAMPLE))
