"""OpenFOAM's dictionaries: nested entries, lists, `#include` and `$name`; what is computed in them is unknown here."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from rbfevo.meshes.mesh import FormatError

UNKNOWN = "#?"  # the value of an entry that OpenFOAM computes: #calc, #eval, #codeStream, an undefined $name
_TOKEN = re.compile(
    r"""(?P<skip>\s+|//[^\n]*|/\*.*?\*/)|(?P<code>\#\{.*?\#\})|(?P<text>"(?:[^"\\]|\\.)*")"""
    r"""|(?P<sign>[{}()\[\];])|(?P<word>[^\s{}()\[\];"]+)""",
    re.DOTALL,
)
_TRUE, _FALSE = ("true", "yes", "on", "y", "t"), ("false", "no", "off", "n", "f", "none")
_DEEPEST = 20  # files that include each other


def read_dictionary(path: Path, known: dict[str, Any] | None = None, depth: int = 0) -> dict[str, Any]:
    """The entries of a dictionary file: text, lists of text, or dictionaries; the header is one of them.

    Args:
        known: entries that stand before it, which `$name` may refer to.

    Raises:
        OSError: if it, or a file that it includes, cannot be read.
        FormatError: if its brackets do not match.
    """
    if depth > _DEEPEST:
        raise FormatError(f"{path.name}: files include each other without end")
    return entries_of(path.read_text(encoding="utf-8", errors="replace"), path, known, depth)


def entries_of(text: str, path: Path, known: dict[str, Any] | None = None, depth: int = 0) -> dict[str, Any]:
    """The entries of a text, as `read_dictionary`; `path` is where it stands."""
    found: dict[str, Any] = dict(known or {})
    _entries(_tokens(text, path.name), [found], path, depth)
    return found


def boolean(value: Any) -> bool | None:
    """What a switch is set to; None for anything else."""
    word = value.lower() if isinstance(value, str) else ""
    return True if word in _TRUE else False if word in _FALSE else None


def _tokens(text: str, name: str) -> list[str]:
    """Words, quoted text and signs, the last one first."""
    found, at = [], 0
    while at < len(text):
        token = _TOKEN.match(text, at)
        if token is None:
            raise FormatError(f"{name}: {text[at : at + 20]!r} cannot be read")
        at = token.end()
        if token["skip"] is None:
            found.append(token[0] if token["code"] is None else UNKNOWN)
    return found[::-1]


def _entries(tokens: list[str], scopes: list[dict[str, Any]], path: Path, depth: int) -> None:
    """Take entries up to the bracket that closes the dictionary `scopes[-1]`."""
    here = scopes[-1]
    while tokens:
        key = tokens.pop()
        if key == "}":
            if len(scopes) == 1:
                raise FormatError(f"{path.name}: a bracket closes what none has opened")
            return
        if key.startswith(("#include", "#sinclude")):
            _include(key, tokens, scopes, path, depth)
        elif key.startswith("#"):
            _statement(tokens, path)
        elif key.startswith("$"):
            meant = _meant(key, scopes)
            _statement(tokens, path)
            here |= meant if isinstance(meant, dict) else {}
        elif tokens and tokens[-1] == "{":
            tokens.pop()
            before = here.get(_plain(key))
            own: dict[str, Any] = dict(before) if isinstance(before, dict) else {}
            here[_plain(key)] = own
            _entries(tokens, [*scopes, own], path, depth)
        elif key != ";":
            here[_plain(key)] = _value(_statement(tokens, path), scopes)
    if len(scopes) > 1:
        raise FormatError(f"{path.name} is cut off: a dictionary does not end")


def _include(key: str, tokens: list[str], scopes: list[dict[str, Any]], path: Path, depth: int) -> None:
    """Take the entries of another file; those of OpenFOAM's own installation are left out."""
    name = _plain(tokens.pop()) if tokens else ""
    if key.startswith(("#includeEtc", "#includeFunc")):
        return
    other = path.parent / name
    if not other.is_file() and key != "#include":  # #includeIfPresent, #sinclude
        return
    scopes[-1] |= read_dictionary(other, {key: value for scope in scopes for key, value in scope.items()}, depth + 1)


def _statement(tokens: list[str], path: Path) -> list[str]:
    """The tokens up to the semicolon that ends an entry, or to the end of a block in braces."""
    found, level = [], 0
    while tokens:
        token = tokens.pop()
        if token == ";" and level == 0:
            return found
        level += (token in "([{") - (token in ")]}")
        if level < 0:
            raise FormatError(f"{path.name}: an entry does not end with a semicolon")
        found.append(token)
        if token == "}" and level == 0:
            return found
    if found:
        raise FormatError(f"{path.name} is cut off: an entry does not end")
    return found


def _value(tokens: list[str], scopes: list[dict[str, Any]]) -> Any:
    """The value of an entry: text, or a list of it where it has more than one part."""
    if any(token.startswith("#") for token in tokens):
        return UNKNOWN
    parts = []
    for token in tokens:
        meant = _meant(token, scopes) if token.startswith("$") else _plain(token)
        parts += meant if isinstance(meant, list) else [meant]
    parts = [part for part in parts if not (isinstance(part, str) and part in ("(", ")"))]
    listed = "(" in tokens
    return parts[0] if len(parts) == 1 and not listed else parts


def _meant(token: str, scopes: list[dict[str, Any]]) -> Any:
    """What a `$name`, `${name}` or `$:a.b` refers to, from the innermost dictionary outwards."""
    name = token.lstrip("$").strip("{}")
    outermost, name = name.startswith(":"), name.lstrip(":.")
    for scope in scopes[:1] if outermost else reversed(scopes):
        found: Any = scope
        for part in [name] if name in scope else name.split("."):
            found = found.get(part) if isinstance(found, dict) else None
        if found is not None:
            return found
    return UNKNOWN


def _plain(token: str) -> str:
    return token[1:-1] if token.startswith('"') else token
