"""centers.png: the centers of the best setups, over the wanted displacement and over their residuals."""

from __future__ import annotations

import dataclasses

from matplotlib.figure import Figure

from rbfevo.errors import UserError
from rbfevo.figures import panels, plane, space, style
from rbfevo.figures.local_error import reached
from rbfevo.recorded.record import Record

MOST = 3  # objectives


def picture(record: Record, *, opengl: bool = True) -> Figure:
    """Draw the centers of the setups of best regularity, of the knee and of best improvement potential.

    Args:
        record: the run; d = 2 is drawn flat, d = 3 as renderings.
        opengl: whether renderings may use OpenGL; without it matplotlib draws them.

    Raises:
        UserError: if no setup has finite centers and scores.
    """
    titles, note = panels.choose(record), ""
    with style.typography():
        if record.gradients is not None:
            return _of_several(record, titles, opengl)
        choices, note = _choices(record, titles)
        if record.vertices.shape[1] == 2:
            return panels.compose(record, choices, plane.rows(record, choices), *plane.size(record), note)
        rows, height = space.rows(record, choices, opengl)
        return panels.compose(record, choices, rows, space.SIDE, height, note)


def _choices(record: Record, titles: dict[int, str]) -> tuple[list[panels.Choice], str]:
    """The setups with what they reach; without, and the reason, where it cannot be computed."""
    try:
        return [panels.Choice(index, title, reached(record, index)) for index, title in titles.items()], ""
    except UserError as error:  # a kernel that is unknown here still has centers to show
        return [panels.Choice(index, title, None) for index, title in titles.items()], str(error)


def _of_several(record: Record, titles: dict[int, str], opengl: bool) -> Figure:
    """The same with rows of panels for each of several objectives, but not for all of many."""
    rows, height, choices, note = [], 0.0, [], ""
    for name, alone in list(zip(record.objectives, record.each(), strict=True))[:MOST]:
        choices, note = _choices(alone, titles)
        more, height = space.rows(alone, choices, opengl, record)
        rows += [dataclasses.replace(row, label=f"{name}:\n{row.label}") for row in more[: 1 + (not note)]]
    if len(record.objectives) > MOST:
        note = note or f"the first {MOST} of {len(record.objectives)} objectives; report.html shows all"
    return panels.compose(record, choices, rows, space.SIDE, height, note)
