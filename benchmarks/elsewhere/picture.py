"""The picture of docs/elsewhere.md: predictions against reductions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.elsewhere.tables import KNOWN, Entry, numbers, series, spearman

SHOWN = ("P_smooth", "P16_smooth", "P16_raw")
COLORS, MARKS = ("#c4601d", "#1f5fa8"), ("o", "^")


def draw(entries: Sequence[Entry], out: Path) -> None:
    """For each case, at r/4, the reduction after 4 max-norm steps over three numbers known beforehand."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    cases = series([entry for entry in entries if entry["reach"] == "r/4"])
    figure, grid = plt.subplots(3, len(cases), figsize=(2.3 * len(cases), 7.2), layout="constrained", squeeze=False)
    for column, (name, own) in enumerate(cases.items()):
        for row, known in enumerate(SHOWN):
            axes: Any = grid[row, column]
            counts, radii = (list(dict.fromkeys(entry[key] for entry in own)) for key in ("centers", "radius"))
            for i, count in enumerate(counts):
                for j, radius in enumerate(radii):
                    part = [e for e in own if (e["centers"], e["radius"]) == (count, radius)]
                    x, y = numbers(part, known), numbers(part, "max-norm_after_4")
                    axes.scatter(x, y, 14, COLORS[i], MARKS[j], alpha=0.7, linewidths=0, label=f"{count}, r {radius}")
            correlation = spearman(numbers(own, known), numbers(own, "max-norm_after_4"))
            axes.set_title(f"{name}: {correlation:.2f}", fontsize=9)
            axes.set_xlabel(KNOWN[known], fontsize=8)
            axes.tick_params(labelsize=7)
            axes.set_xlim(left=0.0)
            axes.set_ylim(bottom=0.0)
            if column == 0:
                axes.set_ylabel("reduction after 4 max-norm steps [%]", fontsize=8)
            if row == 0:
                axes.legend(fontsize=6, loc="upper left", frameon=False, handletextpad=0.1)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)
    plt.close(figure)
