"""What a designer chooses beside the painting: kernel, radius, manipulation, number of centers, symmetry."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.choices import MANIPULATIONS
from rbfevo.errors import UserError
from rbfevo.names import quoted
from rbfevo.runs.config import CONF, ROOTS

FIELD, HELD = "painted", "held"  # point arrays of the painted mesh
DENSE = 20_000  # vertices above which a search looks at fewer, weighted ones
LENGTHS = {  # keys of the length of each kernel that has one
    path.stem: key
    for path in sorted((CONF / "kernel").glob("*.yaml"))
    for key in ("support", "scale")
    if f"\n{key}:" in path.read_text(encoding="utf-8")
}
KERNELS = tuple(sorted(path.stem for path in (CONF / "kernel").glob("*.yaml")))
AXES = ("x", "y", "z")


@dataclasses.dataclass(frozen=True)
class Choices:
    """What is searched.

    Attributes:
        kernel: one of `KERNELS`; radius: its support radius or scale, model units, None for the default.
        manipulation: as `manipulation=`; centers: m.
        symmetry: an axis, or None; up: the axis that is up.

    Raises:
        UserError: for an unknown choice or a number out of range.
    """

    kernel: str = "wendland"
    radius: float | None = None
    manipulation: str = "direct"
    centers: int = 25
    symmetry: str | None = None
    up: str = "z"

    def __post_init__(self) -> None:
        for name, value, valid in (
            ("kernel", self.kernel, KERNELS),
            ("manipulation", self.manipulation, MANIPULATIONS),
            ("symmetry", self.symmetry or "x", AXES),
            ("up", self.up, AXES),
        ):
            if value not in valid:
                raise UserError(f"{name}={value}: choose one of {', '.join(valid)}")
        if self.radius is not None and not 0.0 < self.radius < np.inf:
            raise UserError(f"radius {self.radius:g}: give a positive length")
        if self.centers < 1:
            raise UserError(f"centers={self.centers}: give at least 1")

    @property
    def length_key(self) -> str | None:
        """The key of the kernel's length; None of one that has none."""
        key = LENGTHS.get(self.kernel)
        return None if key is None else f"kernel.{key}"

    def arguments(self, mesh: Path, vertices: int, held: bool) -> list[str]:
        """The arguments of `python -m rbfevo` that search the field painted on a mesh, but for the method.

        Args:
            mesh: a file with the point arrays `FIELD` and `HELD`; vertices: how many it has.
            held: whether vertices are marked that must stay.
        """
        found = ["scenario=mesh", f"scenario.template={mesh}", f"scenario.sensitivity={FIELD}"]
        found += ["scenario.sensitivity_kind=nodal", "scenario.objective=maximize"]
        found += [f"scenario.hold={HELD}"] if held else []
        found += [f"scenario.symmetry={self.symmetry}"] if self.symmetry else []
        found += [f"scenario.search_vertices={DENSE}"] if vertices > DENSE else []
        found += [f"scenario.up={self.up}", f"kernel={self.kernel}"]
        found += [f"{self.length_key}={self.radius!r}"] if self.length_key and self.radius is not None else []
        return [*found, f"manipulation={self.manipulation}", f"centers={self.centers}"]

    def written(self) -> dict[str, Any]:
        """The choices as JSON has them; `Choices(**written)` are the same."""
        return dataclasses.asdict(self)


def overrides(arguments: list[str]) -> list[str]:
    """Arguments as Hydra reads them."""
    return quoted(arguments, ROOTS)
