"""Pictures of a finished run: they read its directory and nothing else, so any of them can be redrawn later."""

from rbfevo.figures.processes import draw

__all__ = ["draw"]
