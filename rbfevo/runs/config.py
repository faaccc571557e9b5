"""From a composed configuration to checked settings: types from the signatures of what the yaml files point at.

Keys that belong to no group are checked without importing torch.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra.utils
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from rbfevo import names
from rbfevo.choices import DEVICES, EVALUATORS, MANIPULATIONS, refuse_others
from rbfevo.errors import UserError

CONF = next(path for path in (Path(__file__).parents[1] / "conf", Path(__file__).parents[2] / "conf") if path.is_dir())
CENTERS = 25  # the default
OWN_CENTERS = 0  # as many as the setups of the method or of the representation have by themselves


@dataclasses.dataclass
class RunConfig:
    """The keys that belong to no group; `preference` is null, a number, or a list of numbers in [0, 1]."""

    scenario: Any
    kernel: Any
    manipulation: Any
    method: Any
    representation: Any = None
    experiment: Any = None
    criterion: Any = None
    seed: int = 0
    centers: int = CENTERS
    keep: Any = None
    preference: Any = None
    device: str = "auto"
    evaluator: str = "auto"
    figures: bool = True
    checkpoint: Any = None
    quiet: bool = False


RBF = {"_target_": "rbfevo.scoring.representations.rbf"}  # of configurations that name no representation
ROOTS = ("hydra", *(field.name for field in dataclasses.fields(RunConfig)))  # where a path in the configuration begins


@dataclasses.dataclass(frozen=True)
class Settings:
    """Checked settings of one run; the four nodes, plain dictionaries, are what `build` makes their objects of.

    `centers` is `OWN_CENTERS` where method or representation has its own number and nobody has asked for another.
    """

    scenario: dict[str, Any]
    kernel: dict[str, Any]
    method: dict[str, Any]
    representation: dict[str, Any]
    manipulation: str
    seed: int
    centers: int
    preferences: tuple[float, ...] | None
    device: str
    evaluator: str
    figures: bool
    quiet: bool
    checkpoint_every: float | None
    criterion_norm: float = 2.0
    keep: str | None = None


def check(config: DictConfig, overrides: Sequence[str] = ()) -> Settings:
    """Check every key's type and range.

    Args:
        config: the composed configuration.
        overrides: of the command line; `centers=25` among them is asked for, and otherwise the default.

    Raises:
        UserError: one line that names the key, what is wrong with it, and what there is.
    """
    top = check_top(config)
    asked = top.centers != CENTERS or any(text.lstrip("+").startswith("centers=") for text in overrides)
    return Settings(
        scenario=checked_target(top.scenario, "scenario"),
        kernel=checked_target(top.kernel, "kernel"),
        method=checked_target(top.method, "method"),
        representation=checked_target(top.representation or RBF, "representation"),
        manipulation=str(top.manipulation["name"]),
        seed=top.seed,
        centers=top.centers if asked or not any(map(brings_centers, (top.method, top.representation))) else OWN_CENTERS,
        preferences=preferences(top.preference),
        device=top.device,
        evaluator=top.evaluator,
        figures=top.figures,
        quiet=top.quiet,
        checkpoint_every=checkpoint_every(top.checkpoint),
        criterion_norm=criterion_norm(top.criterion),
        keep=kept_file(top.keep),
    )


def check_top(config: DictConfig) -> RunConfig:
    """The keys with their types and ranges checked, but for those within the groups; all interpolations filled in.

    Raises:
        UserError: as `check`.
    """
    try:
        values = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        what = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"{error.full_key}: {what}; a ${{ that stands for itself is written \\${{") from None
    top = typed(typing.cast(dict[str, Any], values), RunConfig, "")
    if top.centers < 1:
        raise UserError(f"centers={top.centers}: give at least 1")
    if not 0 <= top.seed < 2**63:
        raise UserError(f"seed={top.seed}: choose a whole number from 0 to 2^63 - 1")
    refuse_others("device", top.device, DEVICES)
    refuse_others("evaluator", top.evaluator, EVALUATORS)
    if not isinstance(top.manipulation, dict) or top.manipulation.get("name") not in MANIPULATIONS:
        raise UserError(f"manipulation={top.manipulation}: choose one of {', '.join(MANIPULATIONS)}")
    preferences(top.preference)
    checkpoint_every(top.checkpoint)
    criterion_norm(top.criterion)
    kept_file(top.keep)
    return top


def checkpoint_every(node: Any) -> float | None:
    """Seconds between checkpoints, from the keys below `checkpoint`; None for the first and the last alone.

    Raises:
        UserError: for another key, or another value than null or a number of at least 0.
    """
    keys = node if isinstance(node, dict) else {} if node is None else {"": node}
    unknown = [key for key in keys if key != "every"]
    if unknown:
        raise UserError(f"checkpoint.{unknown[0]}: there is no such key; the only one is checkpoint.every")
    every = keys.get("every")
    number = isinstance(every, int | float) and not isinstance(every, bool)
    if every is not None and not (number and 0 <= every < math.inf):
        raise UserError(f"checkpoint.every={every}: give null, or a number of seconds of at least 0")
    return None if every is None else float(every)


def criterion_norm(node: Any) -> float:
    """p of the potential that is searched, from the keys below `criterion`; 2 is the paper's.

    Raises:
        UserError: for another key, or another value than a number of at least 2.
    """
    if node is not None and not isinstance(node, dict):
        raise UserError(f"criterion={node}: write criterion.norm={node}")
    keys = {} if node is None else node
    unknown = [key for key in keys if key != "norm"]
    if unknown:
        raise UserError(f"criterion.{unknown[0]}: there is no such key; the only one is criterion.norm")
    p = keys.get("norm", 2)
    number = isinstance(p, int | float) and not isinstance(p, bool)
    if not (number and 2 <= p < math.inf):
        raise UserError(f"criterion.norm={p}: give a number of at least 2; 2 is the paper's potential")
    return float(p)


def kept_file(value: Any) -> str | None:
    """The file with the centers that every setup begins with, or None.

    Raises:
        UserError: unless it is null or the name of a file.
    """
    if value is None or (isinstance(value, str) and value):
        return value
    raise UserError(f"keep={value}: give a file with the control points that stay, or null")


def preferences(value: Any) -> tuple[float, ...] | None:
    """None, or the list of preferences that `preference=` asks for.

    Raises:
        UserError: unless it is null, a number in [0, 1], or a list of such numbers, none of them twice.
    """
    if value is None:
        return None
    values = list(value) if isinstance(value, list | tuple) else [value]
    for entry in values:
        number = isinstance(entry, int | float) and not isinstance(entry, bool)
        if not number or not math.isfinite(entry) or not 0 <= entry <= 1:
            raise UserError(
                f"preference={value}: {entry} is not a number from 0 (improvement potential) to 1 (regularity)"
            )
    if not values:
        raise UserError("preference=[]: the list is empty; null takes the method's own preferences")
    if len(set(map(float, values))) < len(values):
        raise UserError(f"preference={value}: the list holds a preference twice")
    return tuple(float(entry) for entry in values)


# Where the targets of configurations that older runs left in their directories are now.
MOVED = {f"rbfevo.kernels.{name}": f"rbfevo.scoring.kernels.{name}" for name in ("wendland", "triharmonic")}


def target_of(path: str) -> Any:
    """What a `_target_` points at, also one of a configuration that an older run left behind."""
    return hydra.utils.get_object(MOVED.get(path, path))


def brings_centers(node: Any) -> bool:
    """Whether the settings of a method or a representation determine the number of centers."""
    return isinstance(node, dict) and "_target_" in node and bool(getattr(target_of(node["_target_"]), "brings", False))


def checked_target(node: Any, path: str) -> dict[str, Any]:
    """The node with every value converted to the type that its `_target_` declares, nested nodes included."""
    if not isinstance(node, dict) or "_target_" not in node:
        raise UserError(f"{path}={node}: this is not an option of {path}")
    target = target_of(node["_target_"])
    hints = hints_of(target.__init__ if inspect.isclass(target) else target)
    parameters = inspect.signature(target).parameters
    plain = {key: value for key, value in node.items() if not isinstance(value, dict)}
    fields = []
    for key in plain:
        if key != "_target_" and key not in parameters:
            raise UserError(f"{path}.{key}: there is no such key; choose one of {', '.join(parameters)}")
        kind = str if key == "_target_" else omegaconf_type(hints.get(str(key), Any))
        fields.append((str(key), kind, dataclasses.field(default=dataclasses.MISSING)))
    values = vars(typed(plain, dataclasses.make_dataclass("Options", fields), f"{path}."))
    nested = {key: checked_target(value, f"{path}.{key}") for key, value in node.items() if isinstance(value, dict)}
    return {**values, **nested}


def hints_of(function: Any) -> dict[str, Any]:
    """The types of a function's arguments; Any for those that its module imports for a type checker only."""
    try:
        return typing.get_type_hints(function)
    except NameError:
        found = {}
        for name, annotation in inspect.get_annotations(function).items():
            try:
                found[name] = eval(annotation, function.__globals__) if isinstance(annotation, str) else annotation
            except NameError:
                found[name] = Any
        return found


def omegaconf_type(hint: Any) -> Any:
    """The nearest type that OmegaConf can check: Sequence becomes list, unions of more than None become Any."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (tuple, list) or (inspect.isclass(origin) and issubclass(origin, typing.cast(type, typing.Sequence))):
        inner = [a for a in arguments if a is not ...]
        return list[inner[0]] if inner and inner[0] in (int, float, str, bool) else list[Any]
    others = [a for a in arguments if a is not type(None)]
    if arguments and len(others) < len(arguments):
        return typing.Optional[omegaconf_type(others[0])] if len(others) == 1 else Any  # noqa: UP045
    return hint if hint in (int, float, str, bool) else Any


def typed(values: dict[str, Any], schema: Any, path: str) -> Any:
    """An instance of the schema, a dataclass, with its fields converted to their types.

    Raises:
        UserError: naming the key whose type does not fit, or that does not exist.
    """
    for key, value in values.items():
        if value == names.MISSING:
            raise UserError(f"{path}{key}={value}: the value is missing; give one")
    try:
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.create(_literal(values))))
    except ConfigKeyError as error:
        there = ", ".join(field.name for field in dataclasses.fields(schema))
        raise UserError(f"{path}{error.key}: there is no such key; choose one of {there}") from error
    except OmegaConfBaseException as error:
        key = re.split(r"[.\[]", str(error.full_key or error.key))[0]
        if key not in values:
            raise UserError(f"{path}{key}: this key is missing") from error
        kinds = {field.name: field.type for field in dataclasses.fields(schema)}
        raise UserError(f"{path}{key}={values[key]}: {in_words(kinds[key])} is expected") from error


def _literal(value: Any) -> Any:
    """A nested value of which OmegaConf resolves nothing once more: what is filled in may look like `${x}` itself."""
    if isinstance(value, dict):
        return {key: _literal(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_literal(part) for part in value]
    return names.literal(value) if isinstance(value, str) else value


def in_words(kind: Any) -> str:
    """A type in the terms of a user."""
    labels = {int: "a whole number", float: "a number", str: "text", bool: "true or false"}
    plain = {name if isinstance(name, str) else name.__name__: text for name, text in labels.items()}
    arguments = [a for a in typing.get_args(kind) if a is not type(None)]
    if typing.get_origin(kind) is list:
        return f"a list, each entry {labels.get(arguments[0], 'a value')},"
    if arguments:
        return f"null or {in_words(arguments[0])}"
    return labels.get(kind, plain.get(str(kind), "another type"))


def build(node: dict[str, Any], *arguments: Any) -> Any:
    """Call what a node's `_target_` points at, with the other values, and objects in place of nested nodes."""
    values = {key: build(value) if isinstance(value, dict) else value for key, value in node.items()}
    return target_of(values.pop("_target_"))(*arguments, **values)
