"""File names on the command line: any legal one can be given, and Hydra and OmegaConf hand it on as it is.

The value of a key that is a path (`KEYS`, and `resume`) is read by these rules:

1. A value in quotes of either kind is what stands between them; a backslash before such a quote, or before the closing
   one, is written twice, and the quote inside with one before it. Any other value is the name as it stands: blanks,
   quotes, brackets, `=`, `#` and backslashes are part of it.
2. `${...}` is filled in where it names a resolver (`${now:%Y}`, `${unique:}`, `${oc.env:HOME}`) or begins with a key of
   the configuration (`${seed}`, `${kernel.support}`, `${hydra.job.num}`), in quotes or not; everywhere else it is part
   of the name. `\\${` always is; a backslash right before `${` is written twice.
3. With -m a comma separates values unless it stands in quotes or in a `${...}` that is filled in. In the directory of a
   run or a sweep, of which there is one, it is part of the name.
4. Unquoted, `null` is no name, `scenario.fixed=[...]` a box, `method.centers=[...]` a list of files,
   `scenario.sensitivity=[...]` one of sensitivities, and with -m `choice(...)` and the like are Hydra's.
5. A leading `~` or `~user` is that user's home, where there is such a user, and else part of the name.

Hydra records its working directory in its configuration, so the path of a run or a sweep may hold `${x}`, but no `${`
that cannot be parsed, such as `${.`: that is refused.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rbfevo.errors import UserError

DIRECTORIES = ("hydra.run.dir", "hydra.sweep.dir")
STARTS = tuple(f"method.{part}start" for part in ("", "nsga2.", "cmaes."))
# A name, a box, or a list of patches, of files, of boxes or of sensitivities:
LISTED = (
    *("scenario.fixed", "scenario.hold", "scenario.inside", "scenario.outside", "scenario.sensitivity"),
    *("method.centers", *STARTS),
)
FILES = ("template", "target", "scan")  # keys of a scenario that name a file
# May also name an array of the template, or be boxes or numbers:
MAYBE_FILES = (*FILES, "sensitivity", "fixed", "hold", "max_displacement", "inside", "outside")
KEYS = (
    *DIRECTORIES,
    *(f"scenario.{name}" for name in MAYBE_FILES),
    "keep",
    "method.centers",
    *STARTS,
)
SWEEP = ("-m", "--multirun")
MISSING = "???"  # what stands for a missing value, to OmegaConf

_QUOTED = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""", re.DOTALL)
_PLAIN = re.compile(r"[\w./+:%@?|*-]+", re.ASCII)  # what Hydra reads without quotes, as text or as a number
_INTERPOLATION = re.compile(r"(\\*)\$\{(?:\s*(?P<name>[A-Za-z_]\w*(?:\.\w+)*)\s*(?P<end>[:}\[]))?", re.ASCII)
_SWEEP = re.compile(r"\s*(?:choice|range|interval|glob|sort|shuffle|tag)\s*\(.*\)\s*", re.DOTALL)


def quoted(arguments: Sequence[str], roots: Collection[str]) -> list[str]:
    """The arguments of a command line, with the names in them written so that Hydra reads them unchanged.

    Args:
        arguments: as the shell hands them over.
        roots: the keys at the top of the configuration, to which interpolations may refer.
    """
    sweep, found = is_sweep(arguments), []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        plain = key.lstrip("+")
        if equals and plain in DIRECTORIES:
            argument = f"{key}={_written(plain, value, roots)}"
        elif equals and plain in KEYS and not (sweep and _SWEEP.fullmatch(value)):
            parts = _parts(plain, value, roots) if sweep else [value]
            parts = [part.strip() for part in parts] if len(parts) > 1 else parts
            argument = f"{key}={','.join(_written(plain, part, roots) for part in parts)}"
        found.append(argument)
    return found


def is_sweep(arguments: Sequence[str]) -> bool:
    """Whether a command line asks for a sweep."""
    return any(argument in SWEEP for argument in arguments)


def override(key: str, name: str | Path) -> str:
    """The override that gives a key exactly this name, whatever it is."""
    text = str(name)
    text = f"./{text}" if text.startswith("~") else text
    return f"{key}={_hydra(literal(text), always=text.lower() == 'null')}"


def given(arguments: Sequence[str], key: str) -> list[str]:
    """The names that arguments, once `quoted`, give a key; without those that Hydra has to fill in first."""
    parts = [argument.partition("=") for argument in arguments]
    values = [value for name, _, value in parts if name.lstrip("+") == key]
    texts = [_unquoted(value) for value in values if value.lower() != "null"]
    return [_plain(text) for text in texts if all(len(part[1]) % 2 for part in _INTERPOLATION.finditer(text))]


def name_of(value: str) -> str:
    """The name that a value is where nothing is filled in, as in `resume=`."""
    return os.path.expanduser(_plain(_unquoted(value)))  # noqa: PTH111


def refuse_unheld(path: str | Path, what: str) -> None:
    """Raise UserError where Hydra cannot work in a directory, since its path holds a `${` that it chokes on."""
    try:
        OmegaConf.create({"path": str(Path(path).absolute())})
    except OmegaConfBaseException:
        raise UserError(f"{what}: Hydra cannot use a path with this ${{ in it; choose a path without it") from None


def literal(name: str) -> str:
    """What OmegaConf resolves to this very text."""
    return _INTERPOLATION.sub(lambda part: f"{part[1]}{part[1]}\\{part[0][len(part[1]) :]}", name)


def existing_home(path: str | Path) -> Path:
    """A path with a user's home in place of a leading `~` or `~user`, where there is such a user."""
    return Path(os.path.expanduser(path))  # noqa: PTH111 - `Path.expanduser` raises where there is none


def natural(text: str) -> tuple[list[str | int], str]:
    """A key that sorts numbers within words by their size."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", text)], text


def file_and_name(source: str) -> tuple[str, str]:
    """A file and the name of one of its arrays or columns, of `FILE:NAME`; without a name, or such a file, as it is."""
    text, colon, name = source.rpartition(":")
    if not colon or not text or not name:
        return source, ""
    try:
        whole, part = existing_home(source).exists(), existing_home(text).is_file()
    except (OSError, ValueError):
        return source, ""
    return (text, name) if part and not whole else (source, "")


def _written(key: str, value: str, roots: Collection[str]) -> str:
    """A value of a path as Hydra reads it."""
    bare = _QUOTED.fullmatch(value) is None
    if bare and (not value or value.lower() == "null" or (key in LISTED and value[0] == "[" and value[-1] == "]")):
        return value
    text = _escaped(_unquoted(value), roots)
    if key in DIRECTORIES:
        text = os.path.expanduser(text)  # noqa: PTH111
    return _hydra(text, always=text.lower() == "null")


def _parts(key: str, value: str, roots: Collection[str]) -> list[str]:
    """The values that commas separate."""
    ends, depth, i = [], 0, 0
    while i < len(value):
        begins = i == 0 or (ends and ends[-1] == i - 1)
        quoted = _QUOTED.match(value, i) if begins else None
        reference = _INTERPOLATION.match(value, i)
        if quoted is not None and value[quoted.end() : quoted.end() + 1] in ("", ","):
            i = quoted.end()
        elif reference is not None and _meant(reference, roots):
            i = max(value.find("}", i), reference.end() - 1) + 1
        else:
            if key in LISTED:
                depth += (value[i] == "[") - (value[i] == "]")
            if value[i] == "," and depth == 0:
                ends.append(i)
            i += 1
    return [value[begin + 1 : end] for begin, end in zip([-1, *ends], [*ends, len(value)], strict=True)]


def _unquoted(value: str) -> str:
    """What stands in quotes, without the backslashes that Hydra takes away; a value without quotes as it is."""
    if _QUOTED.fullmatch(value) is None:
        return value
    quote = value[0]
    return re.sub(rf"(\\+)({quote}|\Z)", lambda part: part[1][: len(part[1]) // 2] + part[2], value[1:-1])


def _hydra(text: str, always: bool = False) -> str:
    """A text as a value of Hydra's, in quotes where it could not be read without, or as something else."""
    if text == MISSING:
        text = f"./{text}"
    special = always or text.lower() in ("true", "false") or not _PLAIN.fullmatch(text) or _is_number(text)
    if not special:
        return text
    return "'" + re.sub(r"(\\*)('|\Z)", lambda part: part[1] * 2 + ("\\'" if part[2] else ""), text) + "'"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _escaped(text: str, roots: Collection[str]) -> str:
    """A text for OmegaConf, with a backslash before each `${` that names nothing to be filled in."""

    def sign(part: re.Match[str]) -> str:
        if len(part[1]) % 2 or _meant(part, roots):
            return part[0]
        return f"{part[1]}\\{part[0][len(part[1]) :]}"

    return _INTERPOLATION.sub(sign, text)


def _meant(part: re.Match[str], roots: Collection[str]) -> bool:
    """Whether an interpolation names what there is."""
    if len(part[1]) % 2 or part["name"] is None:
        return False
    if part["end"] == ":":
        return OmegaConf.has_resolver(part["name"])
    return part["name"].partition(".")[0] in roots


def _plain(text: str) -> str:
    """What OmegaConf makes of a text in which nothing is filled in."""
    return _INTERPOLATION.sub(lambda part: part[1][: len(part[1]) // 2] + part[0][len(part[1]) :], text)
