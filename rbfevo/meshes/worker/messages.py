"""Messages between the worker and its parent: .npz archives after their length."""

from __future__ import annotations

import io
import struct
from typing import IO, Any

import numpy as np

LENGTH = struct.Struct("<Q")


def send(stream: IO[bytes], arrays: dict[str, Any]) -> None:
    """Write one message."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    stream.write(LENGTH.pack(len(buffer.getbuffer())))
    stream.write(buffer.getbuffer())
    stream.flush()


def receive(stream: IO[bytes]) -> dict[str, Any]:
    """Read one message.

    Raises:
        EOFError: if the other side has ended.
    """
    header = stream.read(LENGTH.size)
    body = stream.read(LENGTH.unpack(header)[0]) if len(header) == LENGTH.size else b""
    if not body:
        raise EOFError
    with np.load(io.BytesIO(body), allow_pickle=False) as archive:
        return dict(archive)


def packed(title: str, arrays: dict[str, Any]) -> dict[str, Any]:
    """Named arrays as entries of a message: names may be any text, which entries of an archive may not."""
    names = list(arrays)
    return {f"{title}s": np.array(names, np.str_), **{f"{title} {i}": arrays[name] for i, name in enumerate(names)}}


def unpacked(title: str, message: dict[str, Any]) -> dict[str, Any]:
    """Named arrays from a message."""
    return {str(name): message[f"{title} {i}"] for i, name in enumerate(message[f"{title}s"])}
