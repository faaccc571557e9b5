"""centers.png: the centers of the best setups, over the wanted displacement and over their residuals."""

from __future__ import annotations

from matplotlib.figure import Figure

from rbfevo.errors import UserError
from rbfevo.figures import panels, plane, space, style
from rbfevo.figures.local_error import reached
from rbfevo.recorded.record import Record


def picture(record: Record, *, opengl: bool = True) -> Figure:
    """Draw the centers of the setups of best regularity, of the knee and of best improvement potential.

    Args:
        record: the run; d = 2 is drawn flat, d = 3 as renderings.
        opengl: whether renderings may use OpenGL; without it matplotlib draws them.

    Raises:
        UserError: if no setup has finite centers and scores.
    """
    titles, note = panels.choose(record), ""
    try:
        choices = [panels.Choice(index, title, reached(record, index)) for index, title in titles.items()]
    except UserError as error:  # a kernel that is unknown here still has centers to show
        choices, note = [panels.Choice(index, title, None) for index, title in titles.items()], str(error)
    with style.typography():
        if record.vertices.shape[1] == 2:
            return panels.compose(record, choices, plane.rows(record, choices), *plane.size(record), note)
        rows, height = space.rows(record, choices, opengl)
        return panels.compose(record, choices, rows, space.SIDE, height, note)
