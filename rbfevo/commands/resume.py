"""`resume=RUN`: the overrides of a run, from its checkpoint, with those that may change on the way."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from rbfevo import names
from rbfevo.choices import WITHOUT_EFFECT
from rbfevo.errors import UserError
from rbfevo.runs.directory import CHECKPOINT

FREE = re.compile(rf"\+{{0,2}}(({'|'.join(WITHOUT_EFFECT)})(\.\w+)?|method(\.\w+)*\.generations)")


def split(words: Sequence[str]) -> tuple[Path | None, list[str]]:
    """The run directory of `resume=RUN`, None without one, and the other overrides.

    Raises:
        UserError: for two of them, for one beside a sweep, or an override that may not change on the way.
    """
    runs = [word for word in words if word.partition("=")[0] == "resume"]
    others = [word for word in words if word.partition("=")[0] != "resume"]
    if not runs:
        return None, others
    if len(runs) > 1:
        raise UserError("resume: one run at a time")
    if names.is_sweep(others):
        raise UserError("resume goes on with one run; to go on with a sweep, start it again in its hydra.sweep.dir")
    for word in others:
        if not FREE.fullmatch(word.partition("=")[0]):
            raise UserError(
                f"{word}: this may not change while a run goes on; only method.*generations, "
                f"{', '.join(WITHOUT_EFFECT)} may"
            )
    value = names.name_of(runs[0].partition("=")[2])
    if not value:
        raise UserError("resume=: the directory of a run is expected")
    run = Path(value)
    if not run.is_dir():
        raise UserError(f"resume={value}: {'this is a file, not a' if run.exists() else 'there is no such'} directory")
    if not (run / CHECKPOINT).exists():
        raise UserError(f"{run} holds no checkpoint: there is nothing to resume; start the run anew")
    return run.resolve(), others


def began_in(run: Path) -> Path:
    """The directory that a run was begun in, if it is still there, else the present one: paths are seen from there."""
    from rbfevo.runs import checkpoint

    told = Path(str(checkpoint.head(run).get("cwd") or "."))
    return told if told.is_dir() else Path.cwd()


def recorded(run: Path, others: Sequence[str]) -> list[str]:
    """The overrides that a run was made with, `others` in the place of those with the same key.

    Raises:
        UserError: if there is no checkpoint, or it does not hold them.
    """
    from rbfevo.runs import checkpoint

    words = checkpoint.head(run).get("words")
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise UserError(f"{run / CHECKPOINT} does not hold how the run was made: start a new run")
    changed = {_key(word) for word in others}
    kept = [word for word in words if _key(word) not in changed]
    return [*kept, *others, names.word("hydra.run.dir", run)]


def _key(word: str) -> str:
    return word.partition("=")[0].lstrip("+~")
