"""The files that Hydra's `.hydra/` of a run directory holds, as plain values: a sweep has thousands of them.

OmegaConf reads the same values, and takes ten times as long.
"""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml
from omegaconf._utils import get_yaml_loader

from rbfevo.errors import UserError

_FASTEST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_FASTEST):
    """PyYAML's fastest loader, which takes the same texts for numbers as OmegaConf's, and refuses a key given twice."""

    yaml_implicit_resolvers = get_yaml_loader().yaml_implicit_resolvers

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """A mapping of a YAML file; a key that stands twice is an error of PyYAML, with its place."""
        keys = [key.value for key, _ in node.value]
        twice = next((key for key in keys if keys.count(key) > 1), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(None, None, f"found duplicate key {twice}", node.start_mark)
        return super().construct_mapping(node, deep=deep)


def configuration(run: Path) -> dict[str, Any] | None:
    """The composed configuration of a run, interpolations as they are written; None if the run did not save it.

    Raises:
        UserError: if it cannot be read.
    """
    values = _values(run / ".hydra" / "config.yaml")
    return values if isinstance(values, dict) else None


def overrides(run: Path) -> list[str] | None:
    """The overrides of a run's command line; None if the run did not save them.

    Raises:
        UserError: if they cannot be read.
    """
    values = _values(run / ".hydra" / "overrides.yaml")
    return [str(value) for value in values] if isinstance(values, list) else None


def _values(path: Path) -> Any:
    try:
        return yaml.load(path.read_bytes(), Loader=_Loader)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise UserError(f"{path} cannot be read: damaged? ({' '.join(str(error).split())})") from None
