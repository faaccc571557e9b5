"""The paper's figures 1 to 7, drawn from the results of `scripts/reproduce`; does not import matplotlib."""

from reproduction.figures.processes import draw
from reproduction.figures.wording import FIGURES, captions

__all__ = ["FIGURES", "captions", "draw"]
