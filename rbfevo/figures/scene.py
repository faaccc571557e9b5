"""The state of `python -m rbfevo.show`, and how keys and the slider change it; without a window and drawing."""

from __future__ import annotations

import functools

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.figures.local_error import local_error
from rbfevo.recorded.moves import spatial
from rbfevo.recorded.objectives import index_of
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import setup

COLOURS = {"wanted": "wanted displacement", "left": "residual, what the setup cannot reach"}
SHAPES = {"template": "template", "reached": "shape within reach", "wanted": "wanted shape"}
NAMED = {"k": "knee", "r": "best-regularity", "p": "best-improvement-potential"}
KEYS = (
    ("k r p", "knee, best regularity, best improvement potential"),
    ("Left Right", "along the front, to lower or higher regularity"),
    ("c", "keep this setup for comparison, or drop the kept one"),
    ("x", "swap the two setups"),
    ("e", "colours: wanted displacement, residual"),
    ("t", "shape: template, within reach, wanted"),
    ("n", "next objective, of several"),
    ("v", "first view again"),
    ("s", "save a picture beside the run"),
    ("h", "show or hide the keys"),
    ("q Escape", "close"),
)
SOFTWARE = "rbfevo.show"  # recorded in a picture as the program that wrote it
MIDDLE = 0.5  # the first preference, unless the pick is one
NEAR = 1e-12  # smaller differences of preferences do not count
KEPT = 2**26  # numbers of reached displacements that are kept, 512 MB


class State:
    """The shown setups of a run, and how they are shown.

    Attributes:
        record: the run; names: the rows of its named setups, those that it has.
        row: the setup shown; other: the one it is compared with, or None.
        colour, shape: keys of COLOURS and SHAPES; objective: of several, the one whose displacements are shown.
        preference: where the slider stands, from 0 (improvement potential) to 1 (regularity).
        keys_shown: whether the list of keys is shown; message: the answer to the last key, or "".
    """

    def __init__(
        self,
        record: Record,
        choice: str,
        other: int | None = None,
        colour: str = "wanted",
        shape: str = "template",
        objective: str | None = None,
    ) -> None:
        """Start with the setup that `choice` picks (`rbfevo.recorded.picks`).

        Raises:
            UserError: if there is no such setup or objective, or this run does not hold what `colour` or `shape` needs.
        """
        self.objective = 0 if objective is None else index_of(record, objective, "--objective")
        self.record, self.row, self.other = record, pick(record, choice), other
        self.names = {}
        for name in NAMED.values():
            try:
                self.names[name] = pick(record, name)
            except UserError:  # no knee without a front
                continue
        self._no_colour, self._no_shape = _refusals(record)
        for option, key, refusals in (("colour", colour, self._no_colour), ("shape", shape, self._no_shape)):
            if key in refusals:
                raise UserError(f"--{option} {key}: {refusals[key]}")
        self.colour, self.shape = colour, shape
        self.keys_shown, self.message = False, ""
        kind, _, value = choice.strip().partition(":")
        self.preference = float(value) if kind == "preference" else MIDDLE
        self._follow()

    def can(self, option: str, key: str) -> bool:
        """Whether this run can be shown in the `colour` or the `shape` that `key` names."""
        return key not in (self._no_colour if option == "colour" else self._no_shape)

    @property
    def rows(self) -> list[int]:
        """The rows shown, from left to right."""
        return [self.row] if self.other is None else [self.row, self.other]

    @property
    def path(self) -> Array:
        """The rows that Left and Right walk along by rising regularity: the usable front, or else all usable rows."""
        usable = self.record.usable
        front = self.record.front[np.isin(self.record.front, usable)]
        return front if front.size else usable[np.argsort(self.record.regularity[usable], kind="stable")]

    def press(self, key: str) -> bool:
        """Carry out the action of `key` (a keysym, letters in lower case); return whether it has one."""
        self.message = ""
        if key in NAMED:
            self._choose(NAMED[key])
        elif key in ("Left", "Right"):
            self._walk(key == "Right")
        elif key == "c":
            self.other = self.row if self.other is None else None
            self.message = "" if self.other is None else f"row {self.row} is kept: now choose another setup"
        elif key == "x":
            self._swap()
        elif key == "e":
            self.colour = self._next(self.colour, COLOURS, self._no_colour)
        elif key == "t":
            self.shape = self._next(self.shape, SHAPES, self._no_shape)
        elif key == "n":
            self.objective = (self.objective + 1) % max(1, len(self.record.objectives))
            self.message = "" if self.record.objectives else "this run has one objective"
        elif key == "h":
            self.keys_shown = not self.keys_shown
        else:
            return False
        return True

    def prefer(self, preference: float) -> None:
        """Show the setup that maximizes preference R + (1 - preference) P (paper, eq. 9)."""
        self.preference, self.message = min(max(float(preference), 0.0), 1.0), ""
        self.row = pick(self.record, f"preference:{self.preference!r}")

    def preferences(self, row: int) -> tuple[float, float] | None:
        """The preferences, from and to, for which no usable setup beats `row`; None if there are none."""
        usable, (R, P) = self.record.usable, (self.record.regularity, self.record.potential)
        more_R, more_P = R[row] - R[usable], P[row] - P[usable]
        slope = more_R - more_P  # preference * slope + more_P >= 0 must hold for every setup
        if (more_P[slope == 0] < 0).any():
            return None
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -more_P / slope
        low = max(0.0, float(crossing[slope > 0].max(initial=0.0)))
        high = min(1.0, float(crossing[slope < 0].min(initial=1.0)))
        return (low, high) if low <= high + NEAR else None

    def titles(self, row: int) -> list[str]:
        """The lines over a setup: its names, its row and its scores."""
        record = self.record
        names = [name.replace("-", " ") for name, its in self.names.items() if its == row]
        source, preference = str(record.method[row]), record.preference[row]
        if np.isfinite(preference):
            source += f", preference {preference:g}"
        first = ", ".join([*names, f"row {row}"])
        return [
            f"{first} ({source})",
            f"R = {record.regularity[row]:.4g}   {record.potential_symbol} = {record.potential[row]:.4f}"
            + (f"   ({record.listed(row)})" if record.objectives else ""),
        ]

    def slider_title(self) -> str:
        """The title of the slider."""
        fits = self.preferences(self.row)
        if fits is None:
            return f"preference (row {self.row} is the best setup for none)"
        return f"preference: 0 {self.record.potential_name}, 1 regularity"

    def _choose(self, name: str) -> None:
        if name in self.names:
            self.row = self.names[name]
            self._follow()
        else:
            self.message = f"there is no {name}: this run has no front (no usable setup is nondominated)"

    def _walk(self, up: bool) -> None:
        """One setup along the path; from beside it to the next one of higher or lower regularity."""
        path = self.path
        here = np.flatnonzero(path == self.row)
        if here.size:
            place = int(here[0]) + (1 if up else -1)
        else:
            regularity = self.record.regularity
            side = "right" if up else "left"
            place = int(np.searchsorted(regularity[path], regularity[self.row], side)) - (0 if up else 1)
        if 0 <= place < len(path):
            self.row = int(path[place])
            self._follow()
        else:
            self.message = f"the front ends here: no setup on it has {'higher' if up else 'lower'} regularity"

    def _swap(self) -> None:
        if self.other is None:
            self.message = "there is no setup to swap with: press c to keep one"
        else:
            self.row, self.other = self.other, self.row
            self._follow()

    def _next(self, key: str, choices: dict[str, str], refusals: dict[str, str]) -> str:
        possible = [choice for choice in choices if choice not in refusals]
        if len(possible) < len(choices):
            self.message = next(iter(refusals.values()))
        return possible[(possible.index(key) + 1) % len(possible)]

    def _follow(self) -> None:
        """Move the slider to the nearest preference that leads to the row shown, if there is one."""
        fits = self.preferences(self.row)
        if fits is not None:
            self.preference = min(max(self.preference, fits[0]), fits[1])


def _refusals(record: Record) -> tuple[dict[str, str], dict[str, str]]:
    """The colours and the shapes in which this run cannot be shown, with the reasons."""
    colours, shapes, (d, k) = {}, {}, (record.vertices.shape[1], record.alone(0).gradient.shape[1])
    try:
        setup(record, int(record.usable[0]))
    except UserError as error:
        colours["left"] = shapes["reached"] = str(error)
    if d == 3 and k != 3:
        reason = f"the gradient of this run has {k} component{'s' * (k != 1)}, not the three of a displacement"
        shapes |= dict.fromkeys(("reached", "wanted"), reason)
    return colours, shapes


class Fields:
    """The arrays that are drawn: points and colours of the template, and centers; a plane lies at z = 0.

    Of several objectives they are those of one of them.

    Attributes:
        highest: the value [model units, or unit norm] at which the colours end: the largest wanted displacement of a
            vertex, whatever is shown, so that all pictures of a run compare.
        unit: of the values, in brackets; remark: on the scale of shapes, or "".
        radius: of the balls that centers are drawn as, model units.
    """

    def __init__(self, record: Record) -> None:
        from rbfevo.figures.space import stretch  # with matplotlib, which takes a while

        self.record, errors = record, local_error(record.gradient)
        self._scale = record.gradient_norm or 1.0
        factor, remark = stretch(record, errors)
        self._stretch, self.remark = factor, remark.strip("\n()")
        self.highest = self._scale * float(errors.max())
        self.unit = "[model units]" if record.gradient_norm else "(unit norm)"
        diagonal = float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
        self.radius = 0.0125 * diagonal * min(1.0, np.sqrt(25 / max(record.centers.shape[1], 1)))
        kept = max(2, KEPT // record.gradient.size)
        self._weights = functools.lru_cache(kept)(lambda row: setup(record, row).fit(record))
        self._reached = functools.lru_cache(kept)(self._reach)

    def points(self, row: int, shape: str) -> Array:
        """The vertices [n, 3] of the template as `shape` has it."""
        template = np.zeros((len(self.record.vertices), 3))
        template[:, : self.record.vertices.shape[1]] = self.record.vertices
        if shape == "template":
            return template
        moved = self.record.gradient if shape == "wanted" else self._reached(row)
        return template + self._stretch * spatial(moved)

    def values(self, row: int, colour: str) -> Array:
        """The lengths [n] of the wanted displacement, or of the setup's residual."""
        left = self.record.gradient if colour == "wanted" else self.record.gradient - self._reached(row)
        return self._scale * local_error(left)

    def centers(self, row: int, shape: str) -> tuple[Array, Array, Array]:
        """All centers [q, 3] of a setup, and which are mirror images and which were kept [q].

        In the shape within reach they have moved.
        """
        try:
            chosen = setup(self.record, row)
        except UserError:  # a kernel that is unknown here still has centers to show
            centers = self.record.centers[row]
            places = np.pad(centers, ((0, 0), (0, 3 - centers.shape[1])))
            return places, np.zeros(len(centers), dtype=bool), np.arange(len(centers)) < self.record.kept
        physical = chosen.centers_and_images()
        places = np.pad(physical.points, ((0, 0), (0, 3 - physical.points.shape[1])))
        if shape == "reached":
            moves = chosen.moved(chosen.handles_moved(self._weights(row)))
            places = places + self._stretch * spatial(chosen.with_images(moves))
        return places, physical.mirrored, physical.column < self.record.kept

    def _reach(self, row: int) -> Array:
        return setup(self.record, row).displacement(self.record.vertices, self._weights(row))
