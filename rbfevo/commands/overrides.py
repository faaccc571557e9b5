"""Mistakes in the arguments of the command line, each explained in one line."""

from __future__ import annotations

import contextlib
import difflib
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rbfevo import names
from rbfevo.errors import UserError
from rbfevo.runs.config import ROOTS
from rbfevo.runs.directory import refuse_results


def look_over(arguments: Sequence[str], conf: Path) -> None:
    """Refuse, before Hydra starts, arguments with which it would fail or do harm.

    These are an argument without a key, a group without an option, a directory with a name that Hydra cannot handle,
    and `hydra.run.dir=DIR` where DIR holds results: Hydra would overwrite `.hydra/`.

    Raises:
        UserError: naming the argument or the directory.
    """
    for before, argument in itertools.pairwise(["", *arguments]):
        key, equals, value = argument.partition("=")
        if equals and (value.lower() == "null" or value[:1] in ("[", "{")) and (conf / key).is_dir():
            there = ", ".join(sorted(path.stem for path in (conf / key).glob("*.yaml")))
            raise UserError(f"{argument}: choose one of {there}, or leave it out")
        option = argument.startswith(("-", "~")) or (before.startswith("-") and before not in names.SWEEP)
        if not key.strip("+~ ") or not (equals or option):
            raise UserError(f"{argument or 'an empty argument'}: write an override as key=value")
    names.refuse_unheld(Path.cwd(), f"the current directory, {Path.cwd()}")
    for key in names.DIRECTORIES:
        for directory in names.given(arguments, key):
            names.refuse_unheld(directory, f"{key}={directory}")
    for directory in names.given(arguments, "hydra.run.dir"):
        refuse_results(Path(directory))


def explain(error: Exception, arguments: Sequence[str], conf: Path) -> str:
    """One line for an error of Hydra or OmegaConf, with the valid options."""
    if isinstance(error, MissingConfigException) and error.options is not None:
        group, _, option = (error.missing_cfg_file or "").rpartition("/")
        return f"{group}={option}: there is no such {group}; choose one of {', '.join(error.options)}"
    cause: BaseException = error
    while isinstance(cause.__cause__, OmegaConfBaseException | HydraException):
        cause = cause.__cause__
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    first = lines[0] if lines else type(error).__name__
    unknown = re.search(r"Could not (?:override|append|delete)[^']*'([^'=]+)", first)
    if unknown is None:
        unknown = re.search(r"full_key: (\S+)", str(cause)) if "not in struct" in str(cause) else None
    if unknown is not None:
        return unknown_key(unknown.group(1).rstrip("."), arguments, conf)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}; choose another hydra.run.dir" if error.filename else str(error)
    message = re.sub(r"\s+", " ", first)
    if re.search(r"mismatched input|LexerNoViableAlt|extraneous input|no viable alternative|Ambiguous value", message):
        message += "; put a value with spaces, brackets or commas into two pairs of quotes: 'key=\"value\"'"
    return message


def unknown_key(key: str, arguments: Sequence[str], conf: Path) -> str:
    """The line for a key that does not exist: the valid keys in its place, and the most similar of them."""
    if key == "kernel.support":
        return "kernel.support: this kernel reaches everywhere and has no support radius; use kernel=wendland"
    parent, _, name = key.rpartition(".")
    config, keys = None, [root for root in ROOTS if root not in ("hydra", "experiment")]
    if parent:
        with contextlib.suppress(HydraException, OmegaConfBaseException):
            config = composed(arguments, conf)
    while parent:
        node = None if config is None else OmegaConf.select(config, parent)
        if isinstance(node, DictConfig):
            keys = [str(k) for k in node if not str(k).startswith("_")]
            break
        parent, _, name = parent.rpartition(".")
    path = f"{parent}." if parent else ""
    near = difflib.get_close_matches(name, keys, n=1)
    meant = f" (did you mean {path}{near[0]}?)" if near else ""
    there = f"choose one of {', '.join(path + k for k in keys)}" if keys else f"{parent} has no keys"
    return f"{key}: there is no such key{meant}; {there}"


def composed(arguments: Sequence[str], conf: Path) -> DictConfig:
    """The configuration with no other arguments than the choices of groups among `arguments`.

    Raises:
        HydraException, OmegaConfBaseException: if that cannot be composed.
    """
    groups = {path.name for path in conf.iterdir() if path.is_dir()}
    choices = [given for given in arguments if given.partition("=")[0] in groups and "," not in given]
    with initialized(conf):
        return hydra.compose("config", overrides=choices)


@contextlib.contextmanager
def initialized(conf: Path) -> Iterator[Any]:
    """Let Hydra find the configuration, whatever it did before in this process; yields what composes overrides."""
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(conf), job_name="rbfevo", version_base="1.3"):
        yield GlobalHydra.instance().hydra
