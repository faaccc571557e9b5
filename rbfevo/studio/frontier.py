"""The picture of a front beside the mesh: improvement potential over regularity, one point a setup."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rbfevo.recorded.record import Record

if TYPE_CHECKING:
    import plotly.graph_objects as go

INK, GREY, LINE, ACCENT, CHOSEN = "#1c1c1c", "#5c5c5c", "#d9d9d9", "#0b4fa8", "#e0201b"


def figure(record: Record | None, chosen: int | None, knee: int | None) -> go.Figure:
    """The front of a record, with rings around the chosen setup and the knee (rows, or None)."""
    import plotly.graph_objects as go

    R = np.empty(0) if record is None else record.regularity
    P = np.empty(0) if record is None else record.potential
    text = [f"R {r:.4g}, P {p:.4g}" for r, p in zip(R, P, strict=True)]
    made = go.Figure()
    made.add_scatter(
        x=R.tolist(), y=P.tolist(), mode="lines+markers", text=text, hovertemplate="%{text}<extra></extra>",
        line={"shape": "vh", "color": ACCENT, "width": 1}, marker={"size": 8, "color": ACCENT}, name="front",
    )  # fmt: skip
    for row, name, color, size, width in ((knee, "knee", INK, 14, 1.2), (chosen, "chosen", CHOSEN, 19, 3.0)):
        here = [] if row is None or row >= len(R) else [row]
        made.add_scatter(
            x=R[here].tolist(), y=P[here].tolist(), mode="markers", name=name, hoverinfo="skip",
            marker={"symbol": "circle-open", "size": size, "color": color, "line": {"color": color, "width": width}},
        )  # fmt: skip
    axis = {"gridcolor": LINE, "zeroline": False, "rangemode": "tozero"}
    made.update_layout(
        margin={"l": 52, "r": 12, "t": 8, "b": 42}, showlegend=False, hovermode="closest", uirevision="front",
        font={"color": INK, "size": 12}, paper_bgcolor="rgba(0,0,0,0)", plot_bgcolor="rgba(0,0,0,0)", dragmode=False,
        xaxis={"title": {"text": "regularity R →"}, **axis},
        yaxis={"title": {"text": "improvement potential P →"}, **axis},
    )  # fmt: skip
    return made
