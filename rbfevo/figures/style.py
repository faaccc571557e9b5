"""What all figures share: colours, type, and a way to write a picture whole or not at all."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from pathlib import Path

import matplotlib
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

DPI = 200
GREEN, BLUE, MAGENTA, ORANGE, RED = "#57b55a", "#0b4fa8", "#d3148f", "#f28e00", "#e0201b"
INK, GREY, PALE = "#1c1c1c", "#6b6b6b", "#d9d9d9"
KEPT = INK  # a center that a run keeps

# Blue to yellow as in the paper, with lightness rising evenly, so that it also reads in grey and to the colour-blind.
ERROR = LinearSegmentedColormap.from_list(
    "blue to yellow", ["#1d2c7c", "#1f5aa8", "#2b88b5", "#57b3a6", "#a5d48a", "#f6e84f"]
)


@contextlib.contextmanager
def typography() -> Iterator[None]:
    """Matplotlib's defaults with this project's type and lines, whatever the user's own settings are."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(
            {
                "font.size": 9.5,
                "axes.labelsize": 10.5,
                "axes.edgecolor": GREY,
                "axes.linewidth": 0.8,
                "axes.labelcolor": INK,
                "text.color": INK,
                "xtick.color": GREY,
                "ytick.color": GREY,
                "xtick.labelcolor": INK,
                "ytick.labelcolor": INK,
                "legend.frameon": False,
                "figure.facecolor": "white",
            }
        )
        yield


def save(figure: Figure, path: Path) -> None:
    """Write `figure` as a PNG to `path`, whole or not at all.

    Raises:
        OSError: if the directory cannot be written to.
    """
    picture = io.BytesIO()
    with typography():
        figure.savefig(picture, format="png", dpi=DPI)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.write_bytes(picture.getvalue())
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
