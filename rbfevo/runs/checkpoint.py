"""The state of a run in one file, from which it goes on bit for bit: arrays, numbers and text, nothing that is code.

The file is an .npz archive: every array under its path in the state, and `state`, JSON with all else. It is written
whole or not at all, and its checksums show a damaged one.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.errors import UserError
from rbfevo.files import write_whole
from rbfevo.runs.directory import CHECKPOINT as NAME

FORMAT = 2
_ARRAY = "\0array"  # the key of a JSON object that stands for an array


def save(directory: Path, state: dict[str, Any]) -> None:
    """Write `state`, nested dicts and lists of arrays, tensors, numbers, text and None, as the directory's checkpoint.

    Raises:
        UserError: if it cannot be written; an older checkpoint then stays as it is.
    """
    arrays: dict[str, np.ndarray] = {}
    text = json.dumps({"format": FORMAT, **_flat(state, "", arrays)})
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, state=np.frombuffer(text.encode(), np.uint8), **arrays)
    write_whole(directory / NAME, buffer.getvalue())


def head(directory: Path) -> dict[str, Any]:
    """What the checkpoint holds beside its progress; no array of it is read.

    Raises:
        UserError: as `load`.
    """
    state = _read(directory, whole=False)
    return {key: value for key, value in state.items() if key != "progress"}


def load(directory: Path) -> dict[str, Any]:
    """The state that `save` was given, tensors and arrays as arrays.

    Raises:
        UserError: if there is no checkpoint, or it is damaged, or not one of this program's.
    """
    return _read(directory, whole=True)


def _read(directory: Path, whole: bool) -> dict[str, Any]:
    path = directory / NAME
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in (archive.files if whole else ["state"])}
        state = json.loads(arrays.pop("state").tobytes())
        if not isinstance(state, dict) or state.get("format") != FORMAT:
            raise UserError(f"{path} is a checkpoint of another format ({state.get('format')}): start a new run")
        return _nested(state, arrays) if whole else state
    except UserError:
        raise
    except FileNotFoundError:
        raise UserError(f"{directory} holds no checkpoint to resume from; start a new run") from None
    except (OSError, ValueError, KeyError, EOFError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is damaged or no checkpoint ({_line(error)}): start a new run") from None
    except (RuntimeError, MemoryError) as error:  # from zipfile, for a member that claims to be encrypted, or huge
        raise UserError(f"{path} is damaged ({_line(error)}): start a new run") from None


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _flat(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """`value` as JSON has it, its arrays moved to `arrays` under their path."""
    if isinstance(value, dict):
        return {str(key): _flat(part, f"{path}{key}.", arrays) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_flat(part, f"{path}{index}.", arrays) for index, part in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    name = f"a.{path}"
    arrays[name] = _array(value)
    return {_ARRAY: name}


def _array(value: Any) -> np.ndarray:
    """An array, or a tensor as one; tensors are known by `detach`, so that torch need not be imported."""
    detach = getattr(value, "detach", None)
    return np.asarray(value) if detach is None else detach().cpu().numpy()


def _nested(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, dict):
        return arrays[value[_ARRAY]] if _ARRAY in value else {key: _nested(part, arrays) for key, part in value.items()}
    return [_nested(part, arrays) for part in value] if isinstance(value, list) else value


def tensors(value: Any) -> Any:
    """The same nested state with tensors in place of arrays."""
    if isinstance(value, np.ndarray):
        import torch

        return torch.from_numpy(value)
    if isinstance(value, dict):
        return {key: tensors(part) for key, part in value.items()}
    return [tensors(part) for part in value] if isinstance(value, list) else value


def digest(*parts: Any) -> str:
    """A short hash of arrays (bit for bit) and of anything that JSON can hold."""
    made = hashlib.blake2b(digest_size=12)
    for part in parts:
        if hasattr(part, "detach") or isinstance(part, np.ndarray):
            array = np.ascontiguousarray(_array(part))
            made.update(f"{array.dtype.str}{array.shape}".encode())
            made.update(array.tobytes())
        else:
            made.update(json.dumps(part, sort_keys=True).encode())
    return made.hexdigest()
