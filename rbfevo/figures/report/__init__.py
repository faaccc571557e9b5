"""report.html: one page to choose a setup from, for a run or for all runs of a sweep; it opens offline in a browser."""

from rbfevo.figures.report.html import page, page_of_sweep

__all__ = ["page", "page_of_sweep"]
