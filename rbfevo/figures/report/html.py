"""The page itself: its parts, the plotting library's script and the content, put into one self-contained file."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rbfevo.figures.report.comparison import comparison
from rbfevo.figures.report.content import Shown, content
from rbfevo.figures.report.curves import numbers_of_centers
from rbfevo.recorded.record import Record
from rbfevo.recorded.sweep import Curve, Member, NestedSequence

PARTS = Path(__file__).parent / "page"


def page(record: Record, directory: Path) -> str:
    """The page of one run as HTML.

    Raises:
        UserError: if no setup has finite centers and scores.
    """
    m, n = record.centers.shape[1], len(record.vertices)
    facts = [f"{len(record.regularity):,} setup{'s' * (len(record.regularity) != 1)}"]
    facts[0] += f" of {m} center{'s' * (m != 1)} on {n:,} vertices"
    volume, symmetry = record.summary.get("hypervolume"), record.summary.get("symmetry")
    if isinstance(volume, int | float):
        facts.append(f"hypervolume {volume:.4g}")
    if record.objectives:
        facts.append(record.combination)
    if record.summary.get("seed") is not None:
        facts.append(f"seed {record.summary['seed']}")
    if isinstance(symmetry, dict):
        facts.append(f"symmetric about {symmetry.get('axis')} = {symmetry.get('at')}")
    shown_content = content([Shown("", ".", directory, record, {})], [""])
    if shown_content["left_out"]:
        facts.append(f"{shown_content['left_out']:,} dominated setups left out here")
    return assembled({**shown_content, "title": record.title, "subtitle": " · ".join(facts)})


def page_of_sweep(
    members: Sequence[Member],
    directory: Path,
    out: Path,
    curves: Sequence[Curve] = (),
    sequences: Sequence[NestedSequence] = (),
) -> str:
    """The page of all runs of a sweep as HTML.

    Args:
        members: the runs; directory: where their names begin; out: where the page is to go.
        curves, sequences: what it shows over the number of centers.

    Raises:
        UserError: if no run has a setup with finite centers and scores.
    """
    shown = [
        Shown(
            member.name,
            Path(os.path.relpath(directory / member.name, out)).as_posix(),
            directory / member.name,
            member.record,
            member.settings,
        )
        for member in members
    ]
    meshes = [member.settings["mesh"] for member in members]
    numbers = numbers_of_centers(curves, sequences, list(dict.fromkeys(meshes)))
    shown_content = content(shown, meshes) | {"sweep": comparison(members) | {"numbers": numbers}}
    setups = sum(len(member.record.usable) for member in members)
    facts = [f"{len(members):,} run{'s' * (len(members) != 1)}", f"{setups:,} setups"]
    if shown_content["left_out"]:
        facts.append(f"{shown_content['left_out']:,} of them, dominated within their run, left out here")
    return assembled({**shown_content, "title": f"Sweep {directory.resolve().name}", "subtitle": " · ".join(facts)})


def assembled(shown_content: dict[str, Any]) -> str:
    """The parts of the page and its content, as one file that loads nothing else."""
    from plotly.offline import get_plotlyjs

    scripts = [path.read_text(encoding="utf-8") for path in sorted((PARTS / "js").glob("*.js"))]
    parts = {
        "title": _escaped(f"{shown_content['title']} · rbfevo"),
        "style": (PARTS / "page.css").read_text(encoding="utf-8"),
        "content": json.dumps({**shown_content, "version": _version()}, allow_nan=False).replace("<", "\\u003c"),
        "plotly": get_plotlyjs().replace("</script", "<\\/script"),
        "script": _wrapped(scripts),
    }
    text = (PARTS / "page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: parts[mark[1]], text)


def _wrapped(scripts: Sequence[str]) -> str:
    return "(() => {\n'use strict';\n" + "\n".join(scripts) + "\n})();\n"


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _version() -> str:
    try:
        return importlib.metadata.version("rbfevo")
    except importlib.metadata.PackageNotFoundError:
        return ""
