"""What `rbfevo.advise` leaves in its directory, read back without torch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from rbfevo.errors import UserError

ADVICE = "advice.json"
GAINS = ("nested", "optimized", "lloyd")


class Advice(NamedTuple):
    """The study of one design, as advice.json holds it.

    Attributes:
        design: the template or scenario in one line; norm: p of the bound; smooth: length, model units, or None.
        trials: for each kernel, support radius and number of centers its gains (None where none was tried).
        chosen: kernel, support, centers, gain; reasons: sentences; commands: what makes the setup and takes a step.
    """

    design: str
    norm: float
    smooth: float | None
    trials: list[dict[str, Any]]
    chosen: dict[str, Any]
    reasons: list[str]
    commands: list[str]


def read_advice(directory: Path) -> Advice:
    """Read advice.json.

    Raises:
        UserError: if it is missing, damaged, or not complete.
    """
    path = directory / ADVICE
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return Advice(**{name: found[name] for name in Advice._fields})
    except FileNotFoundError:
        raise UserError(f"{path} is missing: is {directory} a directory of rbfevo.advise?") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read: damaged? ({' '.join(str(error).split())})") from None


def label(kernel: str, support: float | None) -> str:
    """A kernel and its radius in a legend."""
    return kernel if support is None else f"{kernel}, radius {support:.4g}"


def curves(advice: Advice) -> dict[tuple[str, float | None], list[dict[str, Any]]]:
    """Trials by kernel and support radius, by number of centers."""
    found: dict[tuple[str, float | None], list[dict[str, Any]]] = {}
    for trial in advice.trials:
        found.setdefault((trial["kernel"], trial["support"]), []).append(trial)
    return {key: sorted(trials, key=lambda trial: trial["centers"]) for key, trials in found.items()}
