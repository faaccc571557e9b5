"""Which jobs of a sweep are done already, without composing the configuration of each of them.

Hydra takes some 0.2 s to compose a configuration. Jobs that differ in plain values alone (`seed=3`,
`kernel.support=0.2`) have the same one but for these values: one of each kind is composed, and the values are filled
in. A job is done if a finished run has recorded exactly this configuration. What cannot be decided so, each job decides
by itself (`place_of`).
"""

from __future__ import annotations

import copy
import functools
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rbfevo.commands.jobs import State
from rbfevo.errors import UserError
from rbfevo.recorded import hydra_files

Configuration = dict[str, Any]


class Finished:
    """The finished runs of a sweep, by their configuration.

    Args:
        states: runs that have checkpoints.
        loader, master: Hydra's loader of configurations, and the configuration that all jobs of the sweep share.
    """

    def __init__(self, states: Iterable[State], loader: ConfigLoader, master: DictConfig) -> None:
        self._loader, self._master = loader, master
        self._parsed = functools.cache(OverridesParser.create(config_loader=loader).parse_override)
        self._groups = set(loader.list_groups(""))
        self._directories: dict[str, Path] = {}
        for state in states:
            key = _key(_recorded(state.directory), state.overrides) if state.finished else None
            if key is not None:
                self._directories.setdefault(key, state.directory)
        self._kinds: dict[tuple[str, ...], tuple[Configuration, set[str]] | None] = {}

    def directory(self, overrides: Sequence[str]) -> tuple[Path, Configuration] | None:
        """Where the job with these overrides is done, and its configuration; None if it is not, or that is not sure."""
        if not self._directories:
            return None
        composed = self._composed(overrides)
        key = _key(composed, overrides)
        if key not in self._directories or composed is None:
            return None
        return self._directories[key], composed

    def _composed(self, overrides: Sequence[str]) -> Configuration | None:
        """The configuration of a job; None unless its overrides are options of groups and plain values alone."""
        try:
            parsed = [self._parsed(text) for text in overrides]
        except HydraException:  # the launcher will say what is wrong
            return None
        options = [override for override in parsed if self._is_option(override)]
        values = {override.key_or_group: override for override in parsed if not self._is_option(override)}
        if len(values) + len(options) < len(parsed) or not all(map(_is_plain, parsed)):
            return None
        kind = (*(str(override.input_line) for override in options), *values)
        if kind not in self._kinds:
            self._kinds[kind] = self._composed_by_hydra(overrides)
        found = self._kinds[kind]
        if found is None or not found[1].isdisjoint(values):
            return None
        made = copy.deepcopy(found[0])
        for key, override in values.items():
            *path, last = key.split(".")
            node: Any = made
            for name in path:
                node = node.get(name) if isinstance(node, dict) else None
            if not isinstance(node, dict) or last not in node or isinstance(node[last], dict):
                return None
            node[last] = override.value()
        return made

    def _composed_by_hydra(self, overrides: Sequence[str]) -> tuple[Configuration, set[str]] | None:
        """The configuration of a job without Hydra's own part, and the groups from which something was chosen."""
        try:
            config = self._loader.load_sweep_config(self._master, list(overrides))
        except (HydraException, OmegaConfBaseException):
            return None
        plain = cast(Configuration, OmegaConf.to_container(config, resolve=False))
        choices = plain.pop("hydra")["runtime"]["choices"]
        return plain, set(choices)

    def _is_option(self, override: Override) -> bool:
        return override.key_or_group in self._groups or "/" in override.key_or_group


def _is_plain(override: Override) -> bool:
    """Whether it replaces what is there by a number, text, null, or a list of them."""
    value = override.value()
    values = value if isinstance(value, list) else [value]
    return (
        override.type == OverrideType.CHANGE
        and override.package is None
        and not override.is_sweep_override()
        and all(part is None or isinstance(part, bool | int | float | str) for part in values)
    )


def _recorded(run: Path) -> Configuration | None:
    try:
        return hydra_files.configuration(run)
    except UserError:
        return None


def _key(configuration: Configuration | None, overrides: Iterable[str]) -> str | None:
    """What two jobs with the same settings share; None where interpolations have to be filled in first.

    The number of centers counts as asked for where it is among the overrides, whatever it is.
    """
    asked = any(text.lstrip("+").startswith("centers=") for text in overrides)
    try:
        key = json.dumps([asked, configuration], sort_keys=True)
    except TypeError:
        return None
    return None if configuration is None or "${" in key else key
