"""The text of `python -m rbfevo --help`: the groups with their options, and every key with its value."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from rbfevo.commands import overrides

HEAD = """python -m rbfevo [KEY=VALUE ...]            one run
python -m rbfevo -m KEY=VALUE,VALUE ...     a sweep: one run for each combination of the values
python -m rbfevo resume=RUN [KEY=VALUE ...] continue a run that was stopped

hydra.run.dir=DIR or, with -m, hydra.sweep.dir=DIR is the directory for the results (default: outputs/DATE/TIME).
Names may hold spaces, quotes, commas and other signs: hydra.run.dir='a (1)' in a shell."""
TAIL = """--cfg job prints the configuration of a run, --hydra-help the options of Hydra.
Which kernel, radius and number of centers: python -m rbfevo.advise.
For a run: python -m rbfevo.show, .figures, .export, .apply and .fit; for a sweep: python -m rbfevo.collect."""


def text(arguments: Sequence[str], conf: Path) -> str:
    """The help for some arguments: the keys are those of the options that they choose."""
    config = OmegaConf.to_container(overrides.composed(arguments, conf), resolve=False)
    groups = [_group(path) for path in sorted(conf.iterdir()) if path.is_dir()]
    return "\n\n".join([HEAD, *groups, f"Keys, with the values of these options:\n{_lines(config)}", TAIL])


def _group(directory: Path) -> str:
    """A group and its options, each with the first comment of its file."""
    lines = [f"{directory.name}=..."]
    for path in sorted(directory.glob("*.yaml")):
        comments = (line.partition("#")[2].strip() for line in path.read_text().splitlines())
        summary = next((comment for comment in comments if comment and comment[0] != "@"), "")
        lines.append(f"  {path.stem:<12} {summary}".rstrip())
    return "\n".join(lines)


def _lines(node: Any, path: str = "") -> str:
    """Keys and values as text."""
    lines = []
    for key, value in node.items():
        if isinstance(value, dict):
            lines.append(_lines(value, f"{path}{key}."))
        elif not key.startswith("_"):
            lines.append(f"  {path}{key}={_value(value)}")
    return "\n".join(line for line in lines if line)


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{','.join(map(_value, value))}]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
