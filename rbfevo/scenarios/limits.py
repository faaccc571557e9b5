"""`scenario.max_displacement`: how far each vertex may move at most."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.geometry.lengths import length, number_or_percentage
from rbfevo.scenarios.templates import Template
from rbfevo.scenarios.vertex_arrays import vertex_array

KEY = "max_displacement"


def limits(value: Any, template: Template, diagonal: float, held: Array) -> tuple[Array, str]:
    """The largest displacement [n] of each vertex, model units, and a note.

    Args:
        value: a length, model units or a percentage of the box's diagonal; or a point or cell array, or a file of one.
        held: [n] bool, vertices that cannot move: no bound is needed there.

    Raises:
        UserError: for anything else, or where a vertex that is not held has no bound above 0.
    """
    number = not isinstance(value, str) or not math.isnan(number_or_percentage(value)[0])
    if number:
        bound = length(f"scenario.{KEY}", value, diagonal)
        return np.full(len(template.vertices), bound), f"a vertex moves by at most {bound:.4g}"
    found = vertex_array(value, template, KEY, kind="marks").values
    if found.ndim != 1:
        raise UserError(f"scenario.{KEY}={value}: it has {found.shape[1]} values per vertex; give one, a length")
    wrong = int((~(found > 0.0) & ~held).sum())
    if wrong:
        raise UserError(
            f"scenario.{KEY}={value}: {wrong} of {len(found)} vertices have no bound above 0; hold those that cannot "
            "move by scenario.hold"
        )
    found = np.where(held, np.maximum(found, found.max()), found)
    return found, f"vertices move by at most {found.min():.4g} to {found.max():.4g} ({value})"
