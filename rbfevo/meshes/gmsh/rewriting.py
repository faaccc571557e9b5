"""A file written again with moved points: each coordinate in its place, text or binary."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rbfevo.arrays import Array
from rbfevo.meshes.gmsh.parsed import Parsed
from rbfevo.meshes.places import Places
from rbfevo.meshes.precision import narrowed


def rewriter(content: bytes, parsed: Parsed, places: Places) -> Callable[[Array], bytes]:
    """A function from moved points [n, 3] to the bytes of the file with them."""

    def rewritten(moved: Array) -> bytes:
        """The bytes of the file with moved points [n, 3]."""
        if not parsed.where:
            return places.rewritten(moved)
        changed, start = bytearray(content), 0
        for begin, dtype, count in parsed.where:
            rows = np.frombuffer(changed, dtype, count, begin)
            rows["place"] = narrowed(moved[start : start + count], np.dtype("f8"))
            start += count
        return bytes(changed)

    return rewritten
