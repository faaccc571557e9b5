"""The jobs of a sweep over the options of a group: a key of the group goes to the options that have it.

Hydra combines every value of every key, and refuses a key that one of the options lacks. Here such a key is left out of
the jobs of the options without it, and `centers` out of those of methods that bring their own; of jobs that are then
alike one is left.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType, ValueType
from hydra.core.plugins import Plugins
from omegaconf import DictConfig, OmegaConf

from rbfevo.commands import overrides
from rbfevo.errors import UserError

BASIC = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
SET = (OverrideType.CHANGE, OverrideType.FORCE_ADD)
LISTED = (ValueType.SIMPLE_CHOICE_SWEEP, ValueType.CHOICE_SWEEP)  # glob(*) is left to Hydra
OWN = "centers"  # a key of methods that bring their centers


class Swept(NamedTuple):
    """The groups of which a sweep tries several options: by group and option the keys that there are, dotted."""

    keys: dict[str, dict[str, set[str]]]

    def lacks(self, key: str, choices: dict[str, str]) -> bool:
        """Whether the options that a job chooses have no use for a key."""
        group, _, name = key.partition(".")
        if key == OWN:  # unless all methods bring their own: then the number is compared with theirs
            own = {option: OWN in keys for option, keys in self.keys.get("method", {}).items()}
            return not all(own.values()) and own.get(choices.get("method", ""), False)
        return bool(name) and group in self.keys and name not in self.keys[group].get(choices.get(group, ""), {name})


def held_back(arguments: Sequence[str], conf: Path) -> tuple[list[str], list[str], Swept]:
    """The arguments for Hydra, those that only some of the jobs get, and the groups that are swept.

    Raises:
        UserError: for a key of a group that none of its options has.
        HydraException: for arguments that Hydra cannot read, or an option that there is not.
    """
    parsed = OverridesParser.create().parse_overrides(list(arguments))
    groups = {path.name for path in conf.iterdir() if path.is_dir()}
    several = {
        override.key_or_group: [str(value) for value in override.sweep_string_iterator()]
        for override in parsed
        if override.key_or_group in groups and override.value_type in LISTED
    }
    searched = [str(override.input_line) for override in parsed if override.key_or_group == "hydra.searchpath"]
    own = [override for override in parsed if override.key_or_group.partition(".")[0] in several and _is_set(override)]
    concerned = {override.key_or_group.partition(".")[0] for override in own}
    if any(override.key_or_group == OWN for override in parsed):
        concerned |= {"method"} & set(several)
    swept = Swept({group: _keys(group, several[group], searched, conf) for group in several if group in concerned})
    apart = []
    for override in own:
        group, _, name = override.key_or_group.partition(".")
        keys = swept.keys[group]
        if all(name not in known for known in keys.values()):
            raise UserError(_unknown(override.key_or_group, keys))
        apart.append(str(override.input_line))
    return [argument for argument in arguments if argument not in apart], apart, swept


def _is_set(override: Override) -> bool:
    return "." in override.key_or_group and override.type in SET


def _keys(group: str, options: Sequence[str], searched: Sequence[str], conf: Path) -> dict[str, set[str]]:
    """The keys of each option of a group.

    Raises:
        HydraException: for an option that there is not.
    """
    found = {}
    for option in options:
        with overrides.initialized(conf):
            node = hydra.compose("config", overrides=[*searched, f"{group}={option}"])[group]
        found[option] = set(_dotted(node))
    return found


def _dotted(node: DictConfig, prefix: str = "") -> Iterator[str]:
    """The keys of a node, and those within it."""
    for key in node:
        if not str(key).startswith("_"):
            yield f"{prefix}{key}"
            inner = None if OmegaConf.is_missing(node, key) else node[key]
            if isinstance(inner, DictConfig):
                yield from _dotted(inner, f"{prefix}{key}.")


def _unknown(key: str, keys: dict[str, set[str]]) -> str:
    """The line for a key that none of the options has."""
    group, _, name = key.partition(".")
    there = sorted(set.union(*keys.values()))
    near = difflib.get_close_matches(name, there, n=1)
    meant = f" (did you mean {group}.{near[0]}?)" if near else ""
    choice = ", ".join(f"{group}.{known}" for known in there)
    return f"{key}: none of {group}={','.join(keys)} has such a key{meant}; choose one of {choice}"


def jobs(combined: Sequence[Sequence[str]], swept: Swept) -> tuple[list[list[str]], list[str]]:
    """The overrides of each job, and a line for each key that only some of the jobs get.

    Args:
        combined: overrides of every combination of values.
    """
    found: dict[tuple[str, ...], None] = {}
    without: dict[str, dict[str, None]] = {}
    for job in combined:
        named = [text.partition("=")[::2] for text in job]
        choices = {key: value for key, value in named if key in swept.keys}
        kept = []
        for text, (key, _) in zip(job, named, strict=True):
            plain = key.lstrip("+")
            if swept.lacks(plain, choices):
                group = "method" if plain == OWN else plain.partition(".")[0]
                without.setdefault(plain, {})[f"{group}={choices[group]}"] = None
            else:
                kept.append(text)
        found.setdefault(tuple(kept))
    alike: dict[str, list[str]] = {}
    for key, others in without.items():
        alike.setdefault(", ".join(others), []).append(key)
    notes = [
        f"{', '.join(keys)}: left out for {others}, which {'has' if ',' not in others else 'have'} no use for "
        f"{'it' if len(keys) == 1 else 'them'}"
        for others, keys in alike.items()
    ]
    return [list(job) for job in found], notes


@contextlib.contextmanager
def apart(given: Sequence[str], held: Sequence[str], swept: Swept | None) -> Iterator[None]:
    """Let Hydra's sweeper make the jobs of all arguments, of which `held` were held back from it.

    Args:
        given: in the order of the command line.
    """
    if swept is None or not swept.keys:
        yield
        return
    place = {argument: number for number, argument in enumerate(given)}
    sweeper: Any = Plugins.instance().class_name_to_class[BASIC]
    original = sweeper.split_arguments

    def split_arguments(overrides: list[Override], max_batch_size: int | None) -> list[list[list[str]]]:
        """The overrides of each job, in batches."""
        every = [*overrides, *OverridesParser.create().parse_overrides(list(held))]
        every.sort(key=lambda override: place.get(str(override.input_line), -1))
        (combined,) = original(every, None)
        made, notes = jobs(combined, swept)
        if not _is_quiet(every):
            for note in notes:
                print(note, flush=True)
        return list(sweeper.split_overrides_to_chunks(made, max_batch_size))

    sweeper.split_arguments = staticmethod(split_arguments)
    try:
        yield
    finally:
        sweeper.split_arguments = staticmethod(original)


def _is_quiet(parsed: Sequence[Override]) -> bool:
    values = [override.value() for override in parsed if override.key_or_group == "quiet"]
    return bool(values) and values[-1] is True
