"""advice.png and advice.html: gain over the number of centers and over the support radius, and the recommendation."""

from __future__ import annotations

import html
import json
from typing import Any

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rbfevo.figures import style
from rbfevo.recorded.advice import GAINS, Advice, curves, label

LOOK = {"nested": ("-", None, 1.2), "optimized": ("none", "o", 0.0), "lloyd": (":", "x", 0.8)}  # line, marker, width
LABELS = {"nested": "one after the other", "optimized": "optimized", "lloyd": "evenly spread (Lloyd)"}
NUMBERS = "number of centers"
GAIN = "gain of a bounded step, share of the most there is"


def colours(advice: Advice) -> dict[tuple[str, float | None], str]:
    """A colour for each kernel and radius, from small radii (dark) to large ones; orange for a global kernel."""
    keys = list(curves(advice))
    local = [key for key in keys if key[1] is not None]
    ramp = colormaps["viridis"]
    shades = {key: to_hex(ramp(0.9 * i / max(1, len(local) - 1))) for i, key in enumerate(local)}
    return {key: shades.get(key, style.ORANGE) for key in keys}


def picture(advice: Advice) -> Figure:
    """Gain over the number of centers, and over the radius for the numbers that were optimized."""
    with style.typography():
        figure = Figure(figsize=(10.4, 4.8))
        left, right = figure.add_axes((0.07, 0.13, 0.37, 0.69)), figure.add_axes((0.69, 0.13, 0.29, 0.69))
        _over_numbers(left, advice)
        _over_radii(right, advice)
        handles, names = left.get_legend_handles_labels()
        figure.legend(handles, names, loc="upper left", bbox_to_anchor=(0.445, 0.835), fontsize=8)
        chosen = advice.chosen
        text = f"recommended: {chosen['centers']} centers, {label(chosen['kernel'], chosen['support'])}"
        figure.text(0.07, 0.94, text, fontsize=12, weight="bold", va="center")
        figure.text(0.07, 0.895, advice.design, color=style.GREY, va="center", fontsize=8)
    return figure


def _over_numbers(axes: Axes, advice: Advice) -> None:
    shades = colours(advice)
    for key, trials in curves(advice).items():
        for name in GAINS:
            known = [(trial["centers"], trial[name]) for trial in trials if trial[name] is not None]
            if known:
                legend = label(*key) if name == "nested" else None
                axes.plot(*zip(*known, strict=True), color=shades[key], label=legend, **_look(name))
    for name in GAINS:
        axes.plot([], [], color=style.GREY, label=LABELS[name], **_look(name))
    _ring(axes, advice.chosen["centers"], advice.chosen["gain"])
    axes.set(xlabel=NUMBERS, ylabel=GAIN, ylim=(0.0, None))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _over_radii(axes: Axes, advice: Advice) -> None:
    local = [trial for trial in advice.trials if trial["support"] is not None]
    radii = sorted({trial["support"] for trial in local})
    known = [trial["centers"] for trial in local if trial["optimized"] is not None]
    numbers = sorted({number for number in known if known.count(number) == len(radii)})
    ramp = colormaps["plasma"]
    for i, number in enumerate(numbers):
        shade = to_hex(ramp(0.15 + 0.65 * i / max(1, len(numbers) - 1)))
        chosen = sorted((trial for trial in local if trial["centers"] == number), key=lambda trial: trial["support"])
        for name, line in (("optimized", "o-"), ("lloyd", "x:")):
            known = [(trial["support"], trial[name]) for trial in chosen if trial[name] is not None]
            if known:
                legend = f"{number} centers" if name == "optimized" else None
                axes.plot(*zip(*known, strict=True), line, color=shade, ms=4.5, lw=1.2, label=legend)
    if advice.chosen["support"] is not None:
        _ring(axes, advice.chosen["support"], advice.chosen["gain"])
    axes.set(xlabel="support radius", ylim=(0.0, None))
    if len(radii) > 1:
        axes.set_xscale("log")
        axes.set_xticks(radii, [f"{radius:.3g}" for radius in radii], fontsize=8)
        axes.set_xticks([], minor=True)
    if numbers and radii:
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(numbers), fontsize=8, columnspacing=1.0)


def _look(name: str) -> dict[str, Any]:
    """How a series is drawn."""
    line, marker, width = LOOK[name]
    return {"linestyle": line, "marker": marker, "linewidth": width, "markersize": 4.5}


def _ring(axes: Axes, x: float, y: float) -> None:
    axes.plot([x], [y], "o", ms=12, mfc="none", mec=style.RED, mew=1.6)


def page(advice: Advice) -> str:
    """A page with the curves, the recommendation and the table; it loads nothing from outside."""
    from plotly.offline import get_plotlyjs

    shades, traces = colours(advice), []
    for key, trials in curves(advice).items():
        for name in GAINS:
            known = [(trial["centers"], trial[name]) for trial in trials if trial[name] is not None]
            if known:
                traces.append(_trace(key, name, known, shades[key]))
    chosen = advice.chosen
    ring = {"x": [chosen["centers"]], "y": [chosen["gain"]], "name": "recommended", "mode": "markers"}
    ring["marker"] = {"symbol": "circle-open", "size": 18, "color": style.RED, "line": {"width": 3}}
    layout = {
        "xaxis": {"title": {"text": NUMBERS}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": GAIN}, "rangemode": "tozero"},
        "margin": {"t": 20, "r": 20},
        "template": "none",
        "hovermode": "closest",
    }
    drawn = json.dumps([*traces, ring]).replace("<", "\\u003c"), json.dumps(layout)
    sentences = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in advice.reasons)
    commands = html.escape("\n".join(advice.commands))
    smooth = "not smoothed" if advice.smooth is None else f"smoothed over {advice.smooth:.4g}"
    plotly = get_plotlyjs().replace("</script", "<\\/script")
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Advice · rbfevo</title><style>{STYLE}</style></head><body>
<h1>{chosen["centers"]} centers, {html.escape(label(chosen["kernel"], chosen["support"]))}</h1>
<p>{html.escape(advice.design)}; p = {advice.norm:g}, {smooth}</p>
<ul>{sentences}</ul>
<pre>{commands}</pre>
<div id="curves"></div>
<p>Lines: centers placed one after the other. Dots: optimized. Crosses: evenly spread (Lloyd).
A click in the legend hides a radius.</p>
{_table(advice)}
<script>{plotly}</script>
<script>Plotly.newPlot("curves", {drawn[0]}, {drawn[1]}, {{responsive: true}});</script>
</body></html>
"""


def _trace(key: tuple[str, float | None], name: str, known: list[tuple[int, float]], shade: str) -> dict[str, Any]:
    """A curve of the page; all of one kernel and radius share an entry of the legend."""
    trace: dict[str, Any] = {
        "x": [number for number, _ in known],
        "y": [gain for _, gain in known],
        "legendgroup": label(*key),
        "name": label(*key),
        "showlegend": name == "nested",
        "hovertemplate": f"{html.escape(label(*key))}, {LABELS[name]}<br>%{{x}} centers: %{{y:.3f}}<extra></extra>",
        "line": {"color": shade, "dash": "dot" if name == "lloyd" else "solid"},
        "marker": {"color": shade, "size": 9, "symbol": "x-thin-open" if name == "lloyd" else "circle"},
    }
    trace["mode"] = {"nested": "lines", "optimized": "markers", "lloyd": "lines+markers"}[name]
    return trace


def _table(advice: Advice) -> str:
    """All trials."""
    head = "".join(f"<th>{text}</th>" for text in ("kernel", "radius", "centers", *(LABELS[name] for name in GAINS)))
    rows = []
    for trial in advice.trials:
        support = "" if trial["support"] is None else f"{trial['support']:.4g}"
        gains = ("" if trial[name] is None else f"{trial[name]:.3f}" for name in GAINS)
        cells = "".join(
            f"<td>{html.escape(str(cell))}</td>" for cell in (trial["kernel"], support, trial["centers"], *gains)
        )
        mark = (
            ' class="chosen"'
            if all(trial[key] == advice.chosen[key] for key in ("kernel", "support", "centers"))
            else ""
        )
        rows.append(f"<tr{mark}>{cells}</tr>")
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#1c1c1c}
pre{background:#f3f3f3;padding:1em;white-space:pre-wrap;overflow-wrap:anywhere}#curves{height:480px}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}td,th{padding:.15em .9em;text-align:right}
tr.chosen{background:#fde7e3;font-weight:bold}th{border-bottom:1px solid #6b6b6b}"""
