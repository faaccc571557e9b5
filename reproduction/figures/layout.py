"""A figure measured in inches from its upper left corner, with its caption at the bottom."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from PIL import Image

from rbfevo.figures import style
from rbfevo.figures.panels import Colors
from rbfevo.runs import storage

MARGIN = 0.15  # inches
CAPTION, LINE = 7.5, 0.137  # size of the caption's type in points, height of its lines in inches
STEP = 2  # of 256 shades
LETTER = 0.53  # mean width of a letter in its size


class Sheet:
    """A figure of `width` x `height` inches, plus the height of the caption below."""

    def __init__(self, width: float, height: float, caption: str) -> None:
        kept = caption.replace("--budget ", "--budget\u00a0").replace(" = ", "\u00a0=\u00a0")  # not broken across lines
        lines = textwrap.wrap(kept, int((width - 2 * MARGIN) * 72 / (LETTER * CAPTION)), break_on_hyphens=False)
        self.width, self.height = width, height + LINE * len(lines) + MARGIN
        self.figure = Figure(figsize=(self.width, self.height))
        self.text(MARGIN, height, "\n".join(lines), color=style.GREY, fontsize=CAPTION, va="top", linespacing=1.3)

    def axes(self, left: float, top: float, width: float, height: float, **kind: str) -> Axes:
        """Add axes at a position in inches."""
        low = self.height - top - height
        box = (left / self.width, low / self.height, width / self.width, height / self.height)
        return self.figure.add_axes(box, **kind)  # pyright: ignore[reportArgumentType, reportCallIssue]

    def text(self, left: float, top: float, text: str, **look: object) -> None:
        """Add text at a position in inches."""
        self.figure.text(left / self.width, 1 - top / self.height, text, **look)  # pyright: ignore[reportArgumentType]

    def bar(self, left: float, top: float, height: float, colors: Colors, unit: str, cut: bool = False) -> None:
        """Add a colour bar; `cut` if some values lie above its range."""
        extend = "max" if cut else "neither"
        bar = self.figure.colorbar(ScalarMappable(*colors), cax=self.axes(left, top, 0.11, height), extend=extend)
        bar.set_label(unit, fontsize=8.5)
        bar.ax.tick_params(labelsize=8)
        bar.outline.set_linewidth(0.5)  # pyright: ignore[reportCallIssue]


def save(figure: Figure, path: Path) -> None:
    """Write `figure` atomically as a PNG, with 128 steps per colour: a smaller file without a visible difference.

    Raises:
        UserError: if it cannot be written.
    """
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(style.DPI)
    with style.typography():
        canvas.draw()
    colors = np.asarray(canvas.buffer_rgba())[..., :3].astype(np.int64)
    steps = np.where(colors > 255 - STEP, 255, (colors + STEP // 2) // STEP * STEP).astype(np.uint8)
    picture = io.BytesIO()
    Image.fromarray(steps).save(picture, "PNG", optimize=True, dpi=(style.DPI, style.DPI))
    storage.write_whole(path, picture.getvalue())


def blank(axes: Axes, text: str) -> None:
    """Show in empty axes why there is nothing to draw."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor("#f6f6f6")
    axes.spines[:].set_color(style.PALE)
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=style.GREY, fontsize=8.5)
