"""`resume=RUN`: the overrides of a run, from its checkpoint, and those that may change."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from rbfevo import names
from rbfevo.choices import WITHOUT_EFFECT
from rbfevo.errors import UserError
from rbfevo.runs.directory import CHECKPOINT

FREE = re.compile(rf"\+{{0,2}}(({'|'.join(WITHOUT_EFFECT)})(\.\w+)?|method(\.\w+)*\.generations)")


def split(arguments: Sequence[str]) -> tuple[Path | None, list[str]]:
    """The run directory of `resume=RUN`, None without one, and the other overrides.

    Raises:
        UserError: for two of them, for one with a sweep, or an override that may not change.
    """
    runs = [given for given in arguments if given.partition("=")[0] == "resume"]
    others = [given for given in arguments if given.partition("=")[0] != "resume"]
    if not runs:
        return None, others
    if len(runs) > 1:
        raise UserError("resume=: give one run, not several")
    if names.is_sweep(others):
        raise UserError("resume= continues one run; to continue a sweep, start it again with the same hydra.sweep.dir")
    for override in others:
        if not FREE.fullmatch(override.partition("=")[0]):
            raise UserError(
                f"{override}: this cannot change when a run is resumed; only method.*generations, "
                f"{', '.join(WITHOUT_EFFECT)} can"
            )
    value = names.name_of(runs[0].partition("=")[2])
    if not value:
        raise UserError("resume=: give the directory of a run")
    run = Path(value)
    if not run.is_dir():
        raise UserError(f"resume={value}: {'this is a file, not a' if run.exists() else 'there is no such'} directory")
    if not (run / CHECKPOINT).exists():
        raise UserError(f"{run} holds no checkpoint to resume from; start a new run")
    return run.resolve(), others


def began_in(run: Path) -> Path:
    """The directory that a run was started in, if it still exists, else the current one: paths are relative to it."""
    from rbfevo.runs import checkpoint

    directory = Path(str(checkpoint.head(run).get("cwd") or "."))
    return directory if directory.is_dir() else Path.cwd()


def recorded(run: Path, others: Sequence[str]) -> list[str]:
    """The overrides that a run was started with; `others` replace those with the same key.

    Raises:
        UserError: if there is no checkpoint, or it does not hold them.
    """
    from rbfevo.runs import checkpoint

    saved = checkpoint.head(run).get("words")
    if not isinstance(saved, list) or not all(isinstance(override, str) for override in saved):
        raise UserError(f"{run / CHECKPOINT} does not hold the overrides of the run; start a new run")
    changed = {_key(override) for override in others}
    kept = [override for override in saved if _key(override) not in changed]
    return [*kept, *others, names.override("hydra.run.dir", run)]


def _key(override: str) -> str:
    return override.partition("=")[0].lstrip("+~")
