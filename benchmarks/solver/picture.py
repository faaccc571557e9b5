"""The picture of docs/solver.md: the best J of each descent by adjoint solution."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.solver.report import Descent, of

COLORS = {"advised": "#d3148f", "Lloyd": "#0b4fa8", "grid": "#57b55a", "FFD": "#e08214"}


def draw(found: Sequence[Descent], out: Path) -> None:
    """A panel for each case: solid lines with at most 6 centers, dashed ones with 16, dotted ones steepest descent."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    cases = list(dict.fromkeys(one.case for one in found))
    figure, grid = plt.subplots(1, len(cases), figsize=(4.2 * len(cases), 4.2), layout="constrained", squeeze=False)
    for axes, case in zip(grid[0], cases, strict=True):
        shown: Any = axes
        for one in of(found, case=case):
            style = ":" if one.rule == "steepest" else "-" if one.size == "few" else "--"
            label = f"{one.family}, {'at most 6' if one.size == 'few' else '16'}"
            label += ", steepest descent" if one.rule == "steepest" else ""
            known = label in shown.get_legend_handles_labels()[1]
            y = [0.0, *(one.reduction(n + 1) for n in range(len(one.best)))]
            shown.plot(y, style, color=COLORS[one.family], lw=1.1, alpha=0.8, label="" if known else label)
        shown.set_title(case, fontsize=10)
        shown.set_xlabel("adjoint solutions after the first", fontsize=9)
        shown.invert_yaxis()
    handles = {
        label: handle for axes in grid[0] for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    grid[0][0].set_ylabel("reduction of J [%]", fontsize=9)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=120)
    plt.close(figure)
