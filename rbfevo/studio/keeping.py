"""What the studio keeps on disk, so that nothing is lost when a browser, the program or the machine stops."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rbfevo.arrays import Array, Points, Triangles
from rbfevo.errors import UserError
from rbfevo.files import npz, write_whole
from rbfevo.studio.choices import Choices

FILE = "studio.npz"
ARRAYS = ("vertices", "triangles", "field", "held", "centers", "moved")


@dataclasses.dataclass
class State:
    """A painting, what is searched, and the setup that is shown.

    Attributes:
        source: the file or run directory that the surface comes from.
        vertices, triangles: [n, 3] model units, [f, 3]; field, held: [n, 3], [n] as painted.
        choices: what is searched; centers: [p, m, 3] setups of the front, by rising regularity; p may be 0.
        chosen: which of them is shown, or None; share, moved: as `Pulls` has them, [m, 3] or empty.
        brush: the settings of the brush, as the page shows them.
    """

    source: str
    vertices: Points
    triangles: Triangles
    field: Points
    held: NDArray[np.bool_]
    choices: Choices
    centers: Array = dataclasses.field(default_factory=lambda: np.empty((0, 0, 3)))
    chosen: int | None = None
    share: float = 1.0
    moved: Points = dataclasses.field(default_factory=lambda: np.empty((0, 3)))
    brush: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def begun(self) -> bool:
        """Whether there is anything that could be lost."""
        return bool(self.field.any() or self.held.any() or len(self.centers))

    def same_surface(self, other: State) -> bool:
        """Whether two states are of one and the same surface."""
        return np.array_equal(self.vertices, other.vertices) and np.array_equal(self.triangles, other.triangles)


def keep(directory: Path, state: State) -> None:
    """Write a state into a directory, whole.

    Raises:
        UserError: if it cannot be written there.
    """
    arrays = {name: getattr(state, name) for name in ARRAYS}
    numbers = {"source": state.source, "choices": state.choices.written(), "chosen": state.chosen}
    numbers |= {"share": state.share, "brush": state.brush}
    write_whole(directory / FILE, npz(arrays | {"state": np.array(json.dumps(numbers))}))


def kept(directory: Path) -> State | None:
    """The state that a directory holds, or None.

    Raises:
        UserError: if its file is damaged, or of another version.
    """
    path = directory / FILE
    if not path.exists():
        return None
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in ARRAYS}
            numbers = json.loads(str(archive["state"]))
        numbers["choices"] = Choices(**numbers["choices"])
        state = State(**arrays, **numbers)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, UserError):
            raise UserError(f"{path}: {error}") from None
        raise UserError(f"{path} is damaged, or of another version of rbfevo; move it away to begin anew") from None
    n = len(state.vertices)
    fits = state.vertices.shape == state.field.shape == (n, 3) and state.held.shape == (n,)
    fits = fits and state.triangles.ndim == 2 and state.triangles.shape[1] == 3 and state.centers.ndim == 3
    fits = fits and (not state.triangles.size or 0 <= state.triangles.min() <= state.triangles.max() < n)
    if not fits or (state.chosen is not None and not 0 <= state.chosen < len(state.centers)):
        raise UserError(f"{path}: its arrays do not match; move it away to begin anew")
    return state


def put_aside(directory: Path) -> Path | None:
    """Rename the state of a directory, so that another one can be kept there; return its new name."""
    path = directory / FILE
    if not path.exists():
        return None
    number = 1
    while (aside := directory / f"studio-{number}.npz").exists():
        number += 1
    path.replace(aside)
    return aside
