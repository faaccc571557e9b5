"""The runs of a sweep: finding and reading them, their settings, and which of them share mesh and gradient."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.choices import WITHOUT_EFFECT
from rbfevo.errors import UserError
from rbfevo.names import natural
from rbfevo.recorded import hydra_files
from rbfevo.recorded.record import PLAIN, Record, read

# How and where a run was carried out: settings on which its results do not depend.
IRRELEVANT = (*WITHOUT_EFFECT, "checkpoint.every", "evaluator", "experiment", "manipulation.name")
DIGITS = 2.0**-24  # of the largest number: smaller differences of two meshes are rounding


class Member(NamedTuple):
    """One run of a sweep: its path relative to the sweep's directory, its files, and its settings by dotted key."""

    name: str
    record: Record
    settings: dict[str, Any]


def find(directory: Path) -> list[Path]:
    """Every run directory at or below `directory`, in natural order (2 before 10).

    Links are followed, but to no directory twice and to none that holds `directory`; hidden directories and those
    within a run are not looked into.
    """
    return [path for path, reason in _walk(directory, set()) if reason is None]


def _walk(directory: Path, seen: set[Path]) -> Iterator[tuple[Path, str | None]]:
    """Run directories (None), and those that look like one, with the reason why they cannot be used."""
    place = directory.resolve()
    if place in seen or (seen and directory.is_symlink() and directory.parent.resolve().is_relative_to(place)):
        return
    seen.add(place)
    try:
        inside = {path.name: path.is_dir() for path in directory.iterdir()}
        configured = (directory / ".hydra" / "config.yaml").is_file()
    except OSError as error:
        yield directory, f"cannot be read: {error.strerror or error}"
        return
    held = [name in inside for name in ("setups.npz", "summary.json")]
    if all(held):
        yield directory, None
        return
    if any(held) or configured:
        yield directory, "has no results, or not all of them: it failed, or is still running"
    for name in sorted(inside, key=natural):
        if inside[name] and not name.startswith("."):
            yield from _walk(directory / name, seen)


def members(directory: Path) -> tuple[list[Member], list[str]]:
    """All runs at or below `directory` that can be read, and for each that cannot a line with the reason.

    Arrays of the mesh are shared by runs on the same one.

    Raises:
        UserError: if there is no such directory, no run below it, or none that can be read.
    """
    if not directory.is_dir():
        raise UserError(f"{directory}: {'is a file, not a' if directory.exists() else 'there is no such'} directory")
    found: list[Member] = []
    unread: list[str] = []
    meshes: dict[str, dict[str, Array]] = {}
    files: dict[bytes, dict[str, Array]] = {}
    known: dict[tuple[Any, ...], str] = {}
    for path, reason in _walk(directory, set()):
        name = path.relative_to(directory).as_posix()
        try:
            if reason is not None:
                raise UserError(reason)
            record = read(path, files)
            arrays = (record.vertices, record.faces, record.gradient, record.weights, record.blend)
            same = (*map(id, arrays), record.potential_name)  # of arrays that `files` keeps
            if same not in known:
                known[same] = mesh_of(record)
            settings = _settings(record, path, known[same])
        except UserError as error:
            unread.append(f"{name}: {error}")
            continue
        names = ("vertices", "faces", "gradient", "weights", "gradients")
        mesh = meshes.setdefault(settings["mesh"], {key: getattr(record, key) for key in names})
        found.append(Member(name, dataclasses.replace(record, **mesh), settings))
    if not found:
        why = f"no run can be read: {unread[0]}" if unread else "there is no run here or below"
        raise UserError(f"{directory}: {why}")
    return found, unread


def _settings(record: Record, run: Path, mesh: str) -> dict[str, Any]:
    """The settings of one run: from summary.json, and all others from .hydra/config.yaml if it exists."""
    entry = record.summary.get
    settings = {key: entry(key) for key in ("scenario", "kernel", "support", "manipulation", "method")}
    settings |= {"centers": int(record.centers.shape[1]), "seed": entry("seed"), "mesh": mesh}
    leaves = dict(_leaves(hydra_files.configuration(run) or {}))
    if leaves.get("criterion.norm") == 2:  # as of runs from before there were others
        del leaves["criterion.norm"]
    settings |= {key: leaf for key, leaf in leaves.items() if key not in settings and key not in IRRELEVANT}
    return settings


def _leaves(node: dict[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of a configuration by dotted key; lists and truth values as they are typed."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        elif key != "_target_":
            yield f"{prefix}{key}", typed(value) if isinstance(value, list | bool) else value


def typed(value: Any) -> str:
    """A value as it is typed on the command line."""
    if isinstance(value, list):
        return f"[{','.join(map(typed, value))}]"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return str(int(value))  # 1.0 is no other setting than 1
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def mesh_of(record: Record) -> str:
    """A fingerprint of vertices, faces, gradient, weights, blend, and of the potential that is searched instead of P.

    Eight hexadecimal digits, the same on any machine. Runs that searched different potentials do not compare.

    Numbers count to seven digits of the largest of their array, since a norm's last bits depend on the threads.
    """
    digest = hashlib.blake2b(digest_size=4)
    for array in (record.vertices, record.gradient, record.weights, *([] if record.blend is None else [record.blend])):
        largest = float(np.abs(array).max(initial=0.0))
        digest.update(f"{array.shape} {largest:.6g} ".encode())
        step = largest * DIGITS if 0 < largest < math.inf else 1.0
        digest.update((np.round(array / step) + 0.0).astype("<f8").tobytes())  # + 0.0: there is one zero
    digest.update(np.asarray(record.faces).astype("<i8").tobytes())
    if record.potential_name != PLAIN:
        digest.update(record.potential_name.encode())
    return digest.hexdigest()
