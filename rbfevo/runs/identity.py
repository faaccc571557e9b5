"""Which run a checkpoint belongs to: a hash of the settings that count, and what has changed since it was written."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from rbfevo.choices import WITHOUT_EFFECT
from rbfevo.errors import UserError
from rbfevo.methods.method import Method
from rbfevo.runs.checkpoint import digest, load
from rbfevo.runs.config import MOVED, RBF, Settings, build

ADDED = {"objective_weights": None, "objective_names": None, "combine": "mean"}  # later keys of scenario=mesh


def checkpoint_for(settings: Settings, directory: Path) -> dict[str, Any] | None:
    """The checkpoint that the run is to go on from; None if it was made before the search began.

    Raises:
        UserError: if there is none, or it is damaged, of other settings, or of a run that is done.
    """
    saved = load(directory)
    progress = saved.get("progress")
    if saved.get("settings") != identity(settings):
        raise UserError(
            f"{directory}: the settings differ from those of its checkpoint: only method.*generations, "
            f"{', '.join(WITHOUT_EFFECT)} can change on resume"
        )
    if progress is None:
        return None
    budgets = [stage.steps for stage in stages_of(build(settings.method))]
    if saved.get("finished") and budgets == progress["steps"]:
        raise UserError(f"{directory} is finished; to lengthen it, give a larger method.generations")
    return saved


def changes_since(saved: dict[str, Any], facts: dict[str, Any]) -> list[str]:
    """What is no longer as it was when the run was saved, and may change last digits."""
    before, now = saved.get("versions") or {}, facts["versions"]
    changed = [
        f"{name} {before[name]} then, {now[name]} now" for name in now if before.get(name, now[name]) != now[name]
    ]
    return (
        [f"resumed with {'; '.join(changed)}: last digits may differ from those of a run in one piece"]
        if changed
        else []
    )


def identity(settings: Settings, whole: bool = False) -> str:
    """A hash of the settings that a result depends on; the numbers of generations count only if it is to be `whole`."""
    plain = dataclasses.asdict(settings)
    plain["checkpoint"] = plain.pop("checkpoint_every")
    for free in WITHOUT_EFFECT:
        del plain[free]
    if plain["criterion_norm"] == 2.0:  # checkpoints from before there were others
        del plain["criterion_norm"]
    if plain["keep"] is None:  # checkpoints from before there was the key
        del plain["keep"]
    if plain["representation"] in (RBF, {**RBF, "polynomial": None}):  # checkpoints from before there were others
        del plain["representation"]
    plain["scenario"] = {  # of checkpoints from before there were these keys
        key: value for key, value in plain["scenario"].items() if key not in ADDED or value != ADDED[key]
    }
    before = {now: then for then, now in MOVED.items()}
    plain["kernel"] = {
        **plain["kernel"],
        "_target_": before.get(plain["kernel"]["_target_"], plain["kernel"]["_target_"]),
    }
    method = _without_starts(plain["method"])
    return digest({**plain, "method": method if whole else _without_generations(method)})


def _without_generations(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    return {key: _without_generations(value) for key, value in node.items() if key != "generations"}


def _without_starts(node: Any) -> Any:
    """The settings of a method without starts where there are none, as in checkpoints from before there was the key."""
    if not isinstance(node, dict):
        return node
    return {key: _without_starts(value) for key, value in node.items() if (key, value) != ("start", None)}


def stages_of(method: Any) -> list[Method]:
    """The methods that are carried out one after the other."""
    return getattr(method, "stages", [method])
